"""The public interface: its names, arguments that make no sense, arrays of callers, progress, threads, notebooks."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli as sparklod
from sparklod_cli import CameraPathError, FormatError
from sparklod_cli.api.splat_files import Tree
from sparklod_cli.codecs.formats import MANIFEST
from sparklod_cli.lod.tree_settings import METHODS
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from tests.commands.cli import NAMED
from tests.scenes import random_splats

DEMO = NAMED["demo.ply"]
NAN = float("nan")
CAMERA = sparklod.Camera.look_at((0, -1, 4), (0, 0, 0), size=(40, 30))


@pytest.fixture(scope="module")
def small() -> Scene:
    return Scene(random_splats(300, sh_degree=1))


@pytest.fixture(scope="module")
def small_tree(small: Scene) -> Tree:
    return sparklod.build_lod(small)


# --- Names ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("code", "printed"),
    [
        ("import sys, sparklod_cli; print({'numpy', 'numba', 'click'} & {*sys.modules})", "set()"),
        (f"import sys, sparklod_cli as s; s.read({str(DEMO)!r}); print('numba' in sys.modules)", "False"),
        ("import sparklod_cli as s; print([n for n in {*dir(s)} - {*s.__all__} if n[:2] != '__'])", "[]"),
        ("import sparklod_cli as s, sparklod_cli.render.render_settings; print(callable(s.render))", "True"),
    ],
)
def test_the_package_loads_nothing_heavy_and_has_public_names_alone(code: str, printed: str) -> None:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == printed


def test_every_public_name_exists_is_typed_and_documented() -> None:
    for name in sparklod.__all__:
        assert getattr(sparklod, name).__name__ == name
        assert getattr(sparklod, name).__doc__, name
    assert set(sparklod.__all__) <= set(dir(sparklod))
    assert sparklod.__file__ is not None and (Path(sparklod.__file__).parent / "py.typed").is_file()
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        sparklod.nothing  # noqa: B018


# --- Scenes and cameras -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "function",
    [
        lambda wrong: sparklod.build_lod(wrong),
        lambda wrong: sparklod.write("never.ply", wrong),
        lambda wrong: sparklod.extract_leaves(wrong),
        lambda wrong: sparklod.pack(wrong, "packed"),
        lambda wrong: sparklod.cut(wrong, CAMERA),
        lambda wrong: sparklod.render(wrong, CAMERA),
        lambda wrong: sparklod.orbit(wrong, count=2),
    ],
)
def test_an_argument_that_is_no_scene_is_named(small: Scene, function: Callable[[Any], object]) -> None:
    for wrong, name in ((str(DEMO), "demo"), (small.splats, "Splats"), (None, "None")):
        with pytest.raises(TypeError, match=rf"not .*{name}.*from_arrays"):
            function(wrong)


@pytest.mark.parametrize("wrong", [None, "path.json", (0, 0, 4)])
def test_an_argument_that_is_no_camera_is_named(small_tree: Tree, wrong: Any) -> None:
    paths: list[Any] = [wrong if isinstance(wrong, str) else [wrong], [CAMERA, wrong]]
    for call in (
        lambda: sparklod.cut(small_tree, wrong),
        lambda: sparklod.render(small_tree, wrong),
        *(lambda path=path: sparklod.traverse(small_tree, path) for path in paths),
    ):
        with pytest.raises(TypeError, match="is a Camera, not"):
            call()


#: Names of functions and classes, arguments, of which SCENE and TREE stand for fixtures, the error and its message.
NONSENSE: list[tuple[str, tuple[Any, ...], dict[str, Any], Any, str]] = [
    # Cameras.
    *(
        ("Camera.look_at", (), {"eye": (0, 0, 4), "target": (0, 0, 0)} | wrong, CameraPathError, message)
        for wrong, message in (
            *(({"eye": (1, 2)}, "eye is"), ({"eye": "abc"}, "eye is 'abc'"), ({"eye": (0, 0, 0)}, "its own position")),
            *(({"up": (1, 2)}, "up is"), ({"size": (100.5, 5)}, "whole numbers"), ({"fov_y": NAN}, "nan degrees")),
        )
    ),
    *(("orbit", ("SCENE",), {"count": count}, CameraPathError, "count is") for count in (0, -1, 1 << 30)),
    ("read_cameras", (DEMO,), {"format": "nothing"}, CameraPathError, "no format 'nothing'; give auto or one of"),
    # Reading and building.
    ("read", ("missing.ply",), {}, FormatError, "missing.ply: "),
    ("read", (NAMED["ply-cut.ply"],), {}, FormatError, "ply-cut.ply: "),
    ("read", (DEMO,), {"threads": 0}, ValueError, "threads is 0"),
    ("read", (DEMO,), {"columns": ["colour"]}, ValueError, "no column colour"),
    ("build_lod", ("TREE",), {}, FormatError, "tree already"),
    ("build_lod", ("SCENE",), {"method": "fast"}, ValueError, "no method 'fast'"),
    *(
        ("build_lod", ("SCENE",), {"method": method, name: value}, ValueError, f"{name} is")
        for method in METHODS
        for name, value in (("base", 5), ("growth", 9), ("growth", NAN), ("max_sh", -1), ("max_sh", 4))
    ),
    ("extract_leaves", ("SCENE",), {}, FormatError, "no Level-of-Detail tree"),
    ("arrange_chunks", ("SCENE",), {}, FormatError, "no Level-of-Detail tree; build_lod makes"),
    ("pack", ("SCENE", "zip"), {}, ValueError, "no encoding 'zip'"),
    # Cuts, pictures and comparisons.
    *(("cut", ("TREE", CAMERA), {"budget": wrong}, TypeError, "the budget is") for wrong in (True, [5], object())),
    *(
        ("cut", ("TREE", CAMERA), {"budget": wrong}, ValueError, "budget|neither")
        for wrong in (0, -3, 1.5, 0.0, "nothing", 10**20)
    ),
    *(("cut", ("TREE", CAMERA), {"continuous": wrong}, ValueError, "continuous is") for wrong in (0.5, 1.0, -2, NAN)),
    ("cut", ("TREE", CAMERA), {"precision": "float8"}, ValueError, "no precision"),
    ("render", ("TREE", CAMERA), {"backend": "gl"}, ValueError, "no backend 'gl'; give one of numba"),
    *(
        ("compare", ("TREE", None, [CAMERA]), {"budgets": wrong}, (TypeError, ValueError), "budgets")
        for wrong in ("5%", 0.05, [])
    ),
    ("traverse", ("SCENE", [CAMERA]), {}, FormatError, "not a Level-of-Detail tree"),
    ("Instance", (3,), {}, TypeError, "not of int"),
    ("Instance", (DEMO,), {"object_to_world": np.eye(3)}, ValueError, r"shape \(3, 3\); give \(4, 4\)"),
    *(("show", (np.zeros(shape, "f4"),), {}, ValueError, "the image has the shape") for shape in ((5,), (4, 4, 3))),
    *(
        (figure, (wrong, wrong), {}, ValueError, message)
        for figure in ("psnr", "ssim")
        for wrong, message in (
            *((np.full((12, 12, 3), NAN, "f4"), "NaN"), (np.zeros((12, 12, 3), "u1"), "uint8")),
            (np.zeros((0, 12, 3), "f4"), "no pixels"),
        )
    ),
    ("psnr", (np.zeros((4, 4, 3), "f4"), np.zeros((3, 4, 3), "f4")), {}, ValueError, "shapes"),
]


@pytest.mark.parametrize(("name", "arguments", "options", "error", "message"), NONSENSE)
def test_arguments_that_make_no_sense_are_refused(
    name: str, arguments: Any, options: dict[str, Any], error: Any, message: str, small: Scene, small_tree: Tree
) -> None:
    function, fixtures = attrgetter(name)(sparklod), {"SCENE": small, "TREE": small_tree}
    with pytest.raises(error, match=message):
        function(*(fixtures.get(each, each) if isinstance(each, str) else each for each in arguments), **options)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("camera_to_world", np.full((4, 4), np.nan)),
        ("focal", (np.inf, 5.0)),
        ("principal", (1.0, np.nan)),
        ("time", np.nan),
    ],
)
def test_cameras_that_are_not_finite_are_refused(field: str, value: object, small_tree: Tree) -> None:
    path = sparklod.orbit(small_tree, count=2, size=(32, 24))
    camera = dataclasses.replace(path.cameras[0], **{field: value})
    for call in (
        lambda: sparklod.render(small_tree, camera),
        lambda: sparklod.cut(small_tree, camera),
        lambda: sparklod.traverse(small_tree, [camera]),
        lambda: sparklod.traverse(small_tree, dataclasses.replace(path, cameras=(camera,))),
    ):
        with pytest.raises(ValueError, match=f"{field} of a camera is"):
            call()


def test_shares_figures_and_instances_that_are_taken(small_tree: Tree, tmp_path: Path) -> None:
    expected = sparklod.cut(small_tree, CAMERA, budget=0.5)
    for share in (np.float32(0.5), np.float64(0.5), "50%"):
        assert np.array_equal(sparklod.cut(small_tree, CAMERA, budget=share).nodes[0], expected.nodes[0])
    gray = np.full((12, 12, 3), 0.5, np.float32)
    assert (sparklod.psnr(gray, gray), sparklod.ssim(gray, gray)) == (100, pytest.approx(1))
    path = tmp_path / "instances.json"
    path.write_text(json.dumps({"instances": [{"file": str(DEMO)}]}))
    assert [each.file for each in sparklod.read_instances(str(path))] == [DEMO]
    assert sparklod.Instance(str(DEMO)).file == DEMO  # type: ignore[arg-type]


def test_a_picture_is_saved_as_png(tmp_path: Path) -> None:
    picture = sparklod.show(np.zeros((4, 4, 4), np.float32))
    assert repr(picture).startswith("Picture(") and picture._repr_png_().startswith(b"\x89PNG")
    picture.save(tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes() == picture.png
    with pytest.raises(ValueError, match=r"saved as \.png"):
        picture.save(tmp_path / "a.jpg")
    with pytest.raises(sparklod.OutputError, match="is a folder; name a file in it"):
        picture.save(f"{tmp_path}/")
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


# --- Arrays -----------------------------------------------------------------------------------------------------------


def test_a_scene_is_made_of_arrays() -> None:
    splats = random_splats(50, sh_degree=1)
    columns = {name: getattr(splats, name) for name in COLUMNS}
    made = Scene.from_arrays(**columns)
    for name, column in columns.items():
        assert np.shares_memory(getattr(made.splats, name), column), "float32 is not copied"
    wide = Scene.from_arrays(**{name: column.astype(np.float64) for name, column in columns.items()})
    assert np.array_equal(wide.splats.sh, splats.sh)
    assert Scene.from_arrays(**{**columns, "sh": None}).splats.sh_degree == 0
    assert repr(made) == "Scene(50 splats, SH degree 1)"


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"center": np.zeros((50, 2))}, r"center has the shape \(50, 2\); give \(50, 3\)"),
        ({"opacity": np.zeros((50, 1))}, r"opacity has the shape \(50, 1\); give \(50,\)"),
        ({"rgb": np.zeros((49, 3))}, "rgb has the shape"),
        ({"scale": np.zeros((50, 3), complex)}, "scale holds complex128"),
        ({"quat_xyzw": np.full((50, 4), "x")}, "quat_xyzw holds"),
        ({"sh": np.zeros((50, 4, 3))}, "K = 0, 3, 8 or 15"),
        ({"sh": np.zeros((50, 9))}, "K = 0, 3, 8 or 15"),
        ({"opacity": np.full(50, np.nan)}, "not finite"),
    ],
)
def test_arrays_of_other_shapes_and_values_are_refused(wrong: dict[str, Any], message: str) -> None:
    columns = {name: getattr(random_splats(50), name) for name in COLUMNS}
    with pytest.raises((ValueError, sparklod.InvalidSplatsError), match=message):
        Scene.from_arrays(**{**columns, **wrong})


def test_columns_of_scenes_cannot_be_written_to(small_tree: Tree, tmp_path: Path) -> None:
    sparklod.write(tmp_path / "tree.rad", small_tree)
    arrays = {name: getattr(small_tree.splats, name) for name in COLUMNS}
    leaves = sparklod.extract_leaves(small_tree)
    for scene in (small_tree, leaves, sparklod.read(tmp_path / "tree.rad"), Scene.from_arrays(**arrays)):
        for name in COLUMNS:
            with pytest.raises(ValueError, match="read-only"):
                getattr(scene.splats, name)[:] = 0
    splats = random_splats(9)
    scene = Scene(splats)
    splats.center[0] = 5  # arrays of callers keep their flags
    assert np.shares_memory(scene.splats.center, splats.center)
    assert dataclasses.replace(scene, antialiased=True).splats is scene.splats


@pytest.mark.parametrize("method", METHODS)
def test_read_only_columns_are_as_good_as_others(method: str, small: Scene, tmp_path: Path) -> None:
    columns = {}
    for name in COLUMNS:
        np.save(tmp_path / f"{name}.npy", getattr(small.splats, name))
        columns[name] = np.load(tmp_path / f"{name}.npy", mmap_mode="r")
    mapped = sparklod.build_lod(Scene(Splats(**columns)), method=method)
    expected = sparklod.build_lod(small, method=method)
    for name in COLUMNS:
        assert getattr(mapped.splats, name).tobytes() == getattr(expected.splats, name).tobytes()
    # Twice, which is what a tree of read-only arrays of callers is.
    again = Tree(mapped.splats, LodTree(mapped.tree.child_count, mapped.tree.child_start))
    for name in ("tree.spz", "tree.rad", MANIFEST):
        sparklod.write(tmp_path / name, again)
    path = sparklod.orbit(again, count=2, size=(32, 24))
    assert np.array_equal(sparklod.render(again, path.cameras[0]), sparklod.render(expected, path.cameras[0]))
    assert len(sparklod.traverse(again, path).rows) == 2
    assert len(sparklod.extract_leaves(again)) == len(sparklod.arrange_chunks(again).tree.is_leaf.nonzero()[0]) == 300


# --- Progress and threads ---------------------------------------------------------------------------------------------


def test_progress_is_reported_to_a_function_and_to_bars(scene: Scene) -> None:
    calls: list[tuple[str, int, int]] = []
    sparklod.build_lod(scene, progress=lambda stage, done, total, unit: calls.append((stage, done, total)))
    assert calls and all(0 <= done <= total for _, done, total in calls)
    bars: list[Bar] = []

    class Bar:
        def __init__(self, **how: Any) -> None:
            self.n, self.total, self.stage, self.closed = 0, how["total"], how["desc"], False
            bars.append(self)

        def update(self, more: int) -> None:
            self.n += more

        def close(self) -> None:
            self.closed = True

    sparklod.build_lod(scene, progress=Bar)
    assert [bar.stage for bar in bars] == list(dict.fromkeys(stage for stage, *_ in calls))
    assert all(bar.closed and bar.n == bar.total for bar in bars)


def test_work_is_done_on_as_many_threads_as_requested(small_tree: Tree, monkeypatch: pytest.MonkeyPatch) -> None:
    from sparklod_cli.render import rasterizer
    from sparklod_cli.system.threads import threads_in_use

    before, used, draw = threads_in_use(), set(), rasterizer.draw

    def noted(*arguments: Any) -> Any:
        used.add(threads_in_use())
        return draw(*arguments)

    monkeypatch.setattr(rasterizer, "draw", noted)
    sparklod.render(small_tree, CAMERA, threads=1)
    sparklod.compare(small_tree, None, [CAMERA], budgets=[50, 0.5], threads=1)
    assert used == {1} and threads_in_use() == before
