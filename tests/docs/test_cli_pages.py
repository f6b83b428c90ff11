"""docs/cli says what `--help` says."""

from __future__ import annotations

import pytest

from .cli_pages import FOLDER, pages

PAGES = pages()


def test_every_command_has_a_page_and_no_other_is_there() -> None:
    assert {page.name for page in FOLDER.iterdir()} == set(PAGES)


@pytest.mark.parametrize("name", PAGES)
def test_a_page_quotes_the_help(name: str) -> None:
    assert (FOLDER / name).read_text(encoding="utf-8") == PAGES[name], "run python -m tests.docs.cli_pages"


@pytest.mark.parametrize("name", sorted(set(PAGES) - {"index.md"}))
def test_the_index_links_every_page(name: str) -> None:
    assert f"]({name})" in PAGES["index.md"]
