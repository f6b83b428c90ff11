"""What all tests share."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import settings

# Machines differ by a factor of a hundred in speed, and the first example of a kernel compiles it.
settings.register_profile("sparklod", deadline=None)
settings.load_profile("sparklod")

ROOT = Path(__file__).resolve().parents[1]
FIXTURES = ROOT / "fixtures"
#: Real scenes, which are not part of the repository.
SCENES = ROOT.parent / "shared" / "scenes"


def real_scene(name: str) -> Path:
    """A real scene's path; skips the test where the folder is absent."""
    path = SCENES / name
    if not path.is_file():
        pytest.skip(f"the real scene {name} is not beside this checkout")
    return path
