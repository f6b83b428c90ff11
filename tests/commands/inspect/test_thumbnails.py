"""A page of `inspect --html` shows the scene as a viewer draws it, where it can be drawn."""

from __future__ import annotations

import base64
import io
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.commands.inspect.runs import BROKEN, CORRUPT, PLAIN, inspect
from tests.conftest import FIXTURES, Capture

TREE = FIXTURES / "golden" / "tree-v3.spz"
IMAGE = re.compile(r'<img alt="Drawing of The scene from its front" src="data:image/png;base64,([^"]+)">')


def thumbnails(page: Path) -> list[np.ndarray]:
    found = IMAGE.findall(page.read_text("utf-8"))
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))) for data in found]


@pytest.mark.parametrize("file", [TREE, PLAIN], ids=["tree", "plain"])
def test_a_page_shows_the_scene(file: Path, tmp_path: Path) -> None:
    assert inspect(file, "--html", tmp_path / "page.html", "-q") == 0
    (picture,) = thumbnails(tmp_path / "page.html")
    assert picture.shape[:2] == (384, 512)
    assert np.count_nonzero(picture[..., :3].max(axis=2) > 20) > 500  # it is not black


@pytest.mark.parametrize("file", [BROKEN, CORRUPT, FIXTURES / "faults" / "no-splats.ply"])
def test_what_cannot_be_drawn_gives_a_page_without_one(file: Path, tmp_path: Path, capsys: Capture) -> None:
    inspect(file, "--html", tmp_path / "page.html", "--check")
    assert thumbnails(tmp_path / "page.html") == []
    assert "in a way that it should not" not in capsys.readouterr().err
