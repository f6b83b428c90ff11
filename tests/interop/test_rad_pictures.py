"""A RAD file that Spark fetches chunk by chunk gives the picture of the LoD SPZ of the same tree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sparklod_cli.cameras.camera import Camera, look_at
from sparklod_cli.codecs import spz
from sparklod_cli.codecs.options import RadOptions, WriteOptions
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.rad.rad_header import RadHeader, read_header
from sparklod_cli.codecs.spark_codings import SplatEncoding
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quick
from sparklod_cli.model.lod_tree import CHUNK_NODES
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.render.render_settings import RasterSettings
from tests.conftest import FIXTURES
from tests.interop.page import Page, Picture, Request
from tests.interop.pictures import cameras_around
from tests.scenes import random_splats

pytestmark = pytest.mark.slow

SIZE = 240, 136

#: Least PSNR in dB from the picture of the LoD SPZ. Both files round splats, and SPZ rounds SH to 4 or 5 bits.
LEAST = 40

#: Where Spark looks for the header first.
HEAD_BYTES = 65_536


def colourful() -> tuple[Scene, Camera]:
    """A tree of two chunks with SH of degree 3, and a camera for the small things in it, which are in the second."""
    large, small = random_splats(56_000, sh_degree=3), random_splats(3_000, sh_degree=3, seed=1, extent=0.02)
    small = replace(small, center=small.center + np.float32([5, 0, 0]))
    return Scene(*quick.build(Splats.concat([large, small]))), cameras_around(small.center, *SIZE)[2]


@dataclass(frozen=True)
class Files:
    """A tree in three files, and the header of the second."""

    spz: Path
    whole: Path
    chunked: Path
    header: RadHeader

    @classmethod
    def of(cls, scene: Scene, folder: Path, ranges: SplatEncoding | None = None) -> Files:
        options = WriteOptions(rad=RadOptions(ranges=ranges))
        files = cls(folder / "tree.spz", folder / "tree.rad", folder / "parts-lod.rad", RadHeader(0, 0, True, 0, 0, ()))
        files.spz.write_bytes(b"".join(spz.encode(scene, threads=2)))
        files.whole.write_bytes(b"".join(rad.encode(scene, options, threads=2)))
        for name, pieces in rad.encode_chunked(scene, options, "parts-lod", threads=2):
            (folder / name).write_bytes(b"".join(pieces))
        with files.whole.open("rb") as file:
            return replace(files, header=read_header(file))

    def check_ranges(self, requests: Sequence[Request]) -> set[int]:
        """Asserts that Spark asked for the beginning and for whole chunks, each once; returns which chunks."""
        first, *others = requests
        assert first == Request("tree.rad", min(HEAD_BYTES, self.whole.stat().st_size), 0)
        starts = {self.header.bytes + entry.offset: number for number, entry in enumerate(self.header.chunks)}
        numbers = [starts[request.start] for request in others if request.start is not None]
        assert len(numbers) == len(others) == len(set(numbers))
        sizes = [self.header.chunks[number].bytes for number in numbers]
        assert [(request.name, request.bytes) for request in others] == [("tree.rad", size) for size in sizes]
        return set(numbers)

    def check_chunk_files(self, requests: Sequence[Request]) -> set[int]:
        """Asserts that Spark asked for the header and for chunk files, each once; returns of which chunks."""
        first, *others = requests
        assert first == Request("parts-lod.rad", self.chunked.stat().st_size, 0)
        numbers = [int(request.name.removeprefix("parts-lod-").removesuffix(".radc")) for request in others]
        assert len(set(numbers)) == len(numbers)
        sizes = [self.header.chunks[number].bytes for number in numbers]
        assert others == [Request(f"parts-lod-{n}.radc", size, None) for n, size in zip(numbers, sizes, strict=True)]
        return set(numbers)


def drawn(page: Page, file: Path, camera: Camera, budget: int, layout: str, pages: int = 0) -> Picture:
    page.open(file, camera, RasterSettings(), layout=layout, pages=pages)
    return page.draw(camera, RasterSettings(), budget=budget)


def psnr(one: Picture, other: Picture) -> float:
    return float(-10 * np.log10(max(np.square(one.rounded - other.rounded)[..., :3].mean(), 1e-12)))


def chunks_of(nodes: NDArray[np.uint32] | None) -> set[int]:
    assert nodes is not None
    return set((nodes // CHUNK_NODES).tolist())


def check(page: Page, files: Files, expected: Picture, camera: Camera, budget: int, layout: str = "Ext") -> set[int]:
    """Asserts that both RAD files give a picture when they are paged; returns the chunks that Spark fetched."""
    assert (expected.rounded[..., 3] > 0.1).mean() > 0.05, "the view is nearly empty"
    pages = len(files.header.chunks)
    whole = drawn(page, files.whole, camera, budget, layout, pages)
    fetched = files.check_ranges(page.requests())
    assert psnr(whole, expected) >= LEAST
    assert chunks_of(whole.nodes) <= fetched
    chunked = drawn(page, files.chunked, camera, budget, layout, pages)
    np.testing.assert_array_equal(chunked.rounded, whole.rounded)
    assert files.check_chunk_files(page.requests()) == fetched
    return fetched


def test_a_view_of_a_part_fetches_some_chunks_and_shows_the_picture_of_the_spz(page: Page, tmp_path: Path) -> None:
    files = Files.of(read_scene(FIXTURES / "traverse/town.spz"), tmp_path)
    near = look_at((-4.8, -0.5, 0.3), (-3.8, 0, 0.5), (0, -1, 0))  # at the border of two chunks
    camera = Camera(near, *SIZE, (400, 400), (SIZE[0] / 2, SIZE[1] / 2))
    fetched = check(page, files, drawn(page, files.spz, camera, 2_000, "Ext"), camera, 2_000)
    assert len(files.header.chunks) == 3
    assert fetched == {0, 1}


def test_spherical_harmonics_of_degree_3_are_paged_as_packed_splats(page: Page, tmp_path: Path) -> None:
    """As ExtSplats Spark 2.2.0 cannot: its pager has no texture for the second array of degree 3.

    The picture is that of the same file loaded whole, as SPZ rounds SH too coarsely for this comparison. The file has
    the ranges of codes that pages always have in Spark, so that these do not round once more.
    """
    scene, camera = colourful()
    files = Files.of(scene, tmp_path, SplatEncoding(lod_opacity=True))
    expected = drawn(page, files.whole, camera, 4_000, "Packed")
    assert check(page, files, expected, camera, 4_000, "Packed") == {0, 1}
