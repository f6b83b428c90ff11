"""What the documents promise of themselves."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from .conftest import FIXTURES, ROOT


@pytest.mark.parametrize("page", sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("*.md")))
def test_links_lead_somewhere(page: str) -> None:
    for link in re.findall(r"\]\(([^)#]+)\)", (ROOT / page).read_text()):
        assert link.startswith("https://") or (ROOT / link).exists(), link


def test_the_readmes_program_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert code
    (tmp_path / "scene.ply").write_bytes((FIXTURES / "sh1.ply").read_bytes())
    monkeypatch.chdir(tmp_path)
    exec(code[1], {})
    assert (tmp_path / "scene-lod.spz").exists()
