"""Whatever the API writes passes our own check, however extreme the scene is; or it is refused."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

import sparklod_cli as sparklod
from fuzz.laws import check_passes
from sparklod_cli.codecs.formats import MANIFEST
from sparklod_cli.codecs.options import RAD_ENCODINGS, RadOptions, SogOptions
from sparklod_cli.lod.tree_settings import METHODS, DetailSettings
from sparklod_cli.model.gaussian import normalized_quat
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import COEFFICIENTS
from sparklod_cli.system.errors import SparklodError

LARGEST = float(np.finfo(np.float32).max)
TINIEST = float(np.finfo(np.float32).smallest_subnormal)

#: Magnitudes of coordinates, scales, colours and SH.
SIZES = st.sampled_from([0.0, TINIEST, 1e-30, 1e-6, 1e-3, 1.0, 1.0, 100.0, 70_000.0, 1e9, 1e20, 1e30, 1e38, LARGEST])


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """Splats of a few magnitudes, some of them alike."""
    count, rng = draw(st.sampled_from([1, 2, 3, 17, 150, 300])), np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    degree, different = draw(st.integers(0, 3)), draw(st.sampled_from([1, 2, count]))

    def spread(*shape: int) -> np.ndarray:
        """Values up to a magnitude, or up to two of them."""
        sizes = np.array([draw(SIZES), draw(SIZES)])[rng.integers(0, 1 + draw(st.booleans()), (count, *shape[1:]))]
        return np.clip(sizes * rng.uniform(-1, 1, shape), -LARGEST, LARGEST)

    columns = {
        "center": spread(count, 3),
        "scale": np.abs(spread(count, 3)),
        "quat_xyzw": normalized_quat(rng.normal(size=(count, 4)).astype(np.float32)),
        "opacity": np.clip(
            rng.normal(draw(st.sampled_from([0.0, 0.5, 1.0])), draw(st.sampled_from([0, 0.3])), count), 0, 1
        ),
        "rgb": spread(count, 3),
        "sh": spread(count, COEFFICIENTS[degree], 3),
    }
    return Scene.from_arrays(**{name: values[np.arange(count) % different] for name, values in columns.items()})


def passes(path: Path, scene: Scene, **options: object) -> None:
    """Writes a scene and checks the files; a refusal leaves none."""
    try:
        sparklod.write(path, scene, **options)
    except SparklodError:
        assert not list(path.parent.iterdir())
        return
    check_passes(path)
    shutil.rmtree(path.parent)
    path.parent.mkdir()


@pytest.mark.filterwarnings("error")
@given(scenes(), st.data())
@settings(max_examples=25, phases=[Phase.explicit, Phase.generate])  # shrinking takes minutes, and any scene will do
def test_what_is_written_passes_the_check(scene: Scene, data: st.DataObject) -> None:
    rad = RadOptions(**{name: data.draw(st.sampled_from(["auto", *RAD_ENCODINGS[name]])) for name in RAD_ENCODINGS})
    shares = data.draw(st.sampled_from([(0.5,), (0.9, 0.5, 0.01), (0.3, 0.1)]))
    detail = DetailSettings(
        shares, data.draw(st.sampled_from([20, 40, 9999])), data.draw(st.sampled_from([1e-3, 16])), 1
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for ending in (".ply", ".splat", ".sog", ".spz"):
            passes(folder / f"plain{ending}", scene)
        passes(folder / "plain.rad", scene, rad=rad)
        with contextlib.suppress(SparklodError):
            tree = sparklod.build_lod(scene, method=data.draw(st.sampled_from(METHODS)))
            passes(folder / "tree.spz", tree)
            passes(folder / "tree.rad", tree, rad=rad)
            passes(folder / MANIFEST, tree, detail=detail, sog=SogOptions(sh_codes=16))
            passes(folder / "leaves.rad", sparklod.extract_leaves(tree), rad=rad)
