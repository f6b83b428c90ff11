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

#: Words of a decision, of a note on measurements, and of CONTRIBUTING.md.
MAX_RECORD, MAX_NOTE, MAX_CONTRIBUTING = 300, 600, 1700

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


def words(path: Path) -> int:
    """Count the words of a page, without the marks of its tables."""
    return len(re.sub(r"\||-{3,}", " ", path.read_text(encoding="utf-8")).split())


def test_contributing_names_files_that_exist() -> None:
    page = ROOT / "CONTRIBUTING.md"
    names = re.findall(r"`([\w./]+/[\w.]*|\w+\.py)`", page.read_text(encoding="utf-8"))
    assert len(names) > 40
    missing = [name for name in names if not any((ROOT / top / name).exists() for top in ("", "sparklod_cli"))]
    assert set(missing) <= {"kernels/"}
    assert words(page) <= MAX_CONTRIBUTING


def test_every_package_is_on_the_map() -> None:
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    packages = [path.parent.name for path in (ROOT / "sparklod_cli").glob("*/__init__.py")]
    assert [name for name in packages if f"| `{name}/` |" not in page] == []


def test_decisions_are_short_dated_and_in_the_index() -> None:
    folder = ROOT / "docs" / "decisions"
    index = (folder / "README.md").read_text(encoding="utf-8")
    for record in folder.glob("[0-9]*.md"):
        text = record.read_text(encoding="utf-8")
        (date,) = re.findall(r"^Status: accepted.* Date: ([\d-]{10})\.", text, re.MULTILINE)
        assert re.search(rf"\]\({record.name}\) \| accepted.* \| {date} \|", index), record.name
        assert words(record) <= MAX_RECORD, record.name
    notes = list((ROOT / "benchmarks" / "notes").glob("*.md"))
    assert notes
    assert [note.name for note in notes if words(note) > MAX_NOTE] == []


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
