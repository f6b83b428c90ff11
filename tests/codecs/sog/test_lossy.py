"""Images that are compressed with losses: a finding, and a line when baking."""

from __future__ import annotations

import io
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fixtures import by_hand_sog
from sparklod_cli.cli import run
from sparklod_cli.codecs.sog.webp import MOST_BEFORE, pixels_of, read_header
from tests.conftest import FIXTURES, Capture

SOG, STREAMED = FIXTURES / "golden" / "sh1-sog", FIXTURES / "golden" / "sh1-streamed-sog"
TEXT = "its images are lossy WebP"


def recoded(path: Path, **options: object) -> None:
    """Writes an image again, with losses unless `lossless`; the sides stay."""
    with Image.open(io.BytesIO(path.read_bytes())) as image:
        image.load()
    image.save(path, "WEBP", **{"quality": 90, "method": 0} | options)


@pytest.mark.parametrize("name", ["means_l", "means_u", "quats", "scales", "sh0", "shN_labels", "shN_centroids"])
@pytest.mark.parametrize("zipped", [False, True])
def test_a_lossy_image_is_a_finding_and_a_line(name: str, zipped: bool, tmp_path: Path, capsys: Capture) -> None:
    shutil.copytree(SOG, tmp_path, dirs_exist_ok=True)
    recoded(tmp_path / f"{name}.webp")
    path = tmp_path / "meta.json"
    if zipped:
        path = tmp_path / "scene.sog"
        path.write_bytes(by_hand_sog.zipped({each.name: each.read_bytes() for each in tmp_path.iterdir()}))
    assert run(["inspect", "--check", str(path)]) == 3
    out = capsys.readouterr().out
    assert f"{TEXT} ('{name}.webp'), so that values are not those written" in out
    if name == "shN_labels":
        assert "error: container.corrupt: an SH label is beyond the" in out
    else:
        assert "error: container.lossy: " in out
        assert run(["build-lod", str(path), "-o", str(tmp_path / "tree.spz")]) == 0
        assert capsys.readouterr().err.count(TEXT) == 1


@pytest.mark.parametrize("folder", ["0_0", "1_0", "env"])
def test_a_lossy_chunk_is_named(folder: str, tmp_path: Path, capsys: Capture) -> None:
    """Of full detail, of a coarser level, and of the environment."""
    shutil.copytree(STREAMED, tmp_path, dirs_exist_ok=True)
    recoded(tmp_path / folder / "sh0.webp")
    recoded(tmp_path / folder / "scales.webp")
    assert run(["inspect", "--check", str(tmp_path)]) == 3
    out = capsys.readouterr().out
    assert f"container.lossy: '{folder}/meta.json': {TEXT} ('scales.webp', 'sh0.webp')" in out
    assert out.count("container.lossy") == 1
    if folder != "1_0":  # which is not read
        assert run(["build-lod", str(tmp_path), "-o", str(tmp_path / "tree.spz")]) == 0
        assert capsys.readouterr().err.count(TEXT) == 1


@pytest.mark.parametrize("lossless", [False, True])
@pytest.mark.parametrize("more", [{}, {"exif": b"Exif\0\0" + bytes(99)}, {"icc_profile": bytes(70_001)}])
@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_losses_are_told_behind_any_header(mode: str, more: dict[str, bytes], lossless: bool) -> None:
    pixels = np.random.default_rng(1).integers(0, 256, (8, 12, len(mode)), np.uint8)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "WEBP", lossless=lossless, exact=True, **more)
    read = io.BytesIO(file.getvalue()).read
    header = read_header(read, "x")
    assert (header.width, header.height, header.lossy) == (12, 8, not lossless)
    decoded = pixels_of(header, read, "x").view(np.uint8).reshape(8, 12, 4)[..., [2, 1, 0, 3]]
    assert (decoded[..., : len(mode)] == pixels).all() == lossless


def test_only_some_chunks_are_searched_for_the_pixels() -> None:
    start = b"RIFF\0\0\0\0WEBPVP8X\n\0\0\0" + bytes(10)
    for chunks, lossy in ((MOST_BEFORE - 1, True), (MOST_BEFORE, False)):
        data = start + b"ABCD\3\0\0\0abc\0" * chunks + b"VP8 \0\0\0\0"
        assert read_header(io.BytesIO(data).read, "x").lossy == lossy
