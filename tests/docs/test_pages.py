"""Pages hold together: links, navigation, and figures and names that they share with the code."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sparklod_cli.cameras import camera
from sparklod_cli.cameras.camera_formats import PLAYCANVAS
from sparklod_cli.codecs import compression
from sparklod_cli.inspection import tree
from sparklod_cli.io import files
from sparklod_cli.system import untrusted
from tests.conftest import ROOT

DOCS = ROOT / "docs"

PAGES = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md")])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_leads_to_a_file_or_the_web(page: Path) -> None:
    prose = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    for link in re.findall(r"\]\(([^)#]+)[^)]*\)", prose):
        assert link.startswith("https://") or (page.parent / link).exists(), link


def test_every_page_of_the_documentation_is_in_its_navigation_once() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2]
    listed = re.findall(r"^ *- (?:[^:\n]+: )?(\S+\.md)$", navigation, re.MULTILINE)
    assert sorted(listed) == sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))


@pytest.mark.parametrize("page", ["README.md", "docs/index.md"])
def test_tutorials_are_linked_from_the_first_pages(page: str) -> None:
    folder = (DOCS / "tutorials").relative_to((ROOT / page).parent).as_posix()
    text = (ROOT / page).read_text(encoding="utf-8")
    assert [name for name in (DOCS / "tutorials").glob("*.md") if f"]({folder}/{name.name})" not in text] == []


def test_contributing_names_files_that_exist_and_every_package() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    names = re.findall(r"`([\w./]+/[\w.]*|\w+\.py)`", text)
    assert len(names) > 40
    missing = [name for name in names if not any((ROOT / top / name).exists() for top in ("", "sparklod_cli"))]
    assert set(missing) <= {"kernels/"}
    packages = [path.parent.name for path in (ROOT / "sparklod_cli").glob("*/__init__.py")]
    assert [name for name in packages if f"| `{name}/` |" not in text] == []


def test_decisions_are_dated_and_in_the_index() -> None:
    folder = DOCS / "decisions"
    index = (folder / "README.md").read_text(encoding="utf-8")
    for record in folder.glob("[0-9]*.md"):
        (date,) = re.findall(r"^Status: accepted.* Date: ([\d-]{10})\.", record.read_text("utf-8"), re.MULTILINE)
        assert re.search(rf"\]\({record.name}\) \| accepted.* \| {date} \|", index), record.name


def test_the_world_transform_of_the_cameras_page_is_that_of_the_note() -> None:
    transform = re.search(r"--world-transform [-01,]+", PLAYCANVAS)
    assert transform and transform.group() in (DOCS / "cameras.md").read_text(encoding="utf-8")


def test_the_figures_of_security_are_those_of_the_code() -> None:
    text = " ".join((ROOT / "SECURITY.md").read_text(encoding="utf-8").split())
    for figure in (
        f"promises more than {compression.TRUSTED_SIZE >> 20} MiB",
        f"at most {compression.MAX_RATIO} times the size of the file",
        f"read up to {files.MAX_TEXT >> 20} MiB and {untrusted.MAX_DEPTH} levels deep",
        f"shorten texts to {untrusted.MOST} characters",
    ):
        assert figure in text
    assert (tree.MAX_DEPTHS, camera.MAX_FRAMES) == (1000, 1 << 20)
    assert "a thousand levels" in text
