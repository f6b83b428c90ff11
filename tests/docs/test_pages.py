"""The pages hold together: links, navigation, and what the README shows."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from sparklod_cli.cli import run as cli_run
from tests.conftest import FIXTURES, ROOT

#: The README is a front page; what is longer belongs into docs/.
MAX_README = 8192

PAGES = sorted(path for path in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_leads_to_a_file_or_the_web(page: Path) -> None:
    prose = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    for link in re.findall(r"\]\(([^)#]+)[^)]*\)", prose):
        assert link.startswith("https://") or (page.parent / link).exists(), link


def test_every_page_of_the_documentation_is_in_its_navigation_once() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2]
    listed = re.findall(r"^ *- (?:[^:\n]+: )?(\S+\.md)$", navigation, re.MULTILINE)
    docs = ROOT / "docs"
    assert sorted(listed) == sorted(path.relative_to(docs).as_posix() for path in docs.rglob("*.md"))


def test_the_readme_is_a_front_page() -> None:
    assert (ROOT / "README.md").stat().st_size <= MAX_README


def test_the_readmes_program_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert code
    (tmp_path / "scene.ply").write_bytes((FIXTURES / "sh1.ply").read_bytes())
    (tmp_path / "path.json").write_bytes((FIXTURES / "cameras" / "sparklod.json").read_bytes())
    monkeypatch.chdir(tmp_path)
    exec(code[1], {})
    assert (tmp_path / "scene-lod.spz").exists()


def test_the_readmes_first_line_can_be_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its last command at least, in a folder that has our fixtures; what it writes is no news to git."""
    block = re.search(r"## Try it\n.*?```sh\n(.*?)\n```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert block
    command = shlex.split(block[1].rpartition("&&")[2])
    assert command.pop(0).endswith("/sparklod")
    (tmp_path / "fixtures").symlink_to(FIXTURES)
    monkeypatch.chdir(tmp_path)
    assert [cli_run(command), cli_run(command)] == [0, 0]
    (written,) = (path.name for path in tmp_path.iterdir() if path.name != "fixtures")
    assert f"/{written}" in (ROOT / ".gitignore").read_text().splitlines()
