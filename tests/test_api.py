"""The public interface: laws of its functions, and that the commands draw, count and say the same."""

from __future__ import annotations

import ast
import csv
import dataclasses
import io
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli as sparklod
from sparklod_cli.cli import main
from tests.conftest import FIXTURES
from tests.scenes import random_splats

DEMO = FIXTURES / "demo.ply"
EYE, TARGET = (0.5, -1.0, 4.0), (0.0, 0.0, 0.0)
VIEW = "0.5,-1,4:0,0,0"
SIZE = (160, 120)


@pytest.fixture(scope="module")
def scene() -> sparklod.Scene:
    return sparklod.read(DEMO)


@pytest.fixture(scope="module")
def tree(scene: sparklod.Scene) -> sparklod.Tree:
    return sparklod.build_lod(scene, method="quality")


@pytest.fixture(scope="module")
def file(tree: sparklod.Tree, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tree as a file."""
    path = tmp_path_factory.mktemp("api") / "demo-lod.spz"
    sparklod.write(path, tree)
    return path


@pytest.fixture(scope="module")
def held(file: Path) -> sparklod.Scene:
    """The tree as its file holds it."""
    return sparklod.read(file)


def camera(size: tuple[int, int] = SIZE) -> sparklod.Camera:
    return sparklod.Camera.look_at(EYE, TARGET, size=size)


def command(*arguments: object) -> None:
    """Runs a command, which must succeed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["sparklod", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
    assert not caught.value.code


def without_time(rows: Any) -> list[dict[str, Any]]:
    return [{name: cell for name, cell in row.items() if name != "traverse_ms"} for row in rows]


# The package


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = "import sys, sparklod_cli; print(*(name for name in ('numpy', 'numba', 'click') if name in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split() == []


def test_reading_loads_no_numba() -> None:
    code = f"import sys, sparklod_cli as s; s.read({str(DEMO)!r}); print('numba' in sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.split() == ["False"]


def test_every_public_name_exists_and_is_typed() -> None:
    """What is imported at run time is what type checkers are told."""
    for name in sparklod.__all__:
        assert getattr(sparklod, name).__name__ == name
    assert set(sparklod.__all__) <= set(dir(sparklod))
    assert sparklod.__file__ is not None
    source = ast.parse(Path(sparklod.__file__).read_text())
    (checked,) = (node for node in source.body if isinstance(node, ast.If))
    told = {
        alias.name: node.module for node in checked.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    assert told == sparklod._HOMES
    assert sorted(told) == sorted(sparklod.__all__)
    assert (Path(sparklod.__file__).parent / "py.typed").is_file()
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        sparklod.nothing  # noqa: B018


def test_functions_stay_where_modules_have_their_names() -> None:
    both = "sparklod_cli.render.settings, sparklod_cli.compare"
    code = f"import sparklod_cli as s; import {both}; print(s.render, s.compare)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.count("<function ") == 2


def test_every_public_function_and_class_says_what_it_is() -> None:
    for name in sparklod.__all__:
        assert getattr(sparklod, name).__doc__, name


# Scenes


@pytest.mark.parametrize("suffix", [".ply", ".spz"])
def test_a_written_scene_is_read_back(scene: sparklod.Scene, tmp_path: Path, suffix: str) -> None:
    written = sparklod.write(tmp_path / f"scene{suffix}", scene)
    again = sparklod.read(written.path)
    assert written.bytes == written.path.stat().st_size
    assert len(again) == len(scene)
    steps = {"center": 2e-3, "scale": 0.04, "opacity": 0.01, "rgb": 0.02} if suffix == ".spz" else {}
    for name in ("center", "scale", "opacity", "rgb"):
        ours, theirs = getattr(scene.splats, name), getattr(again.splats, name)
        if name == "scale":
            ours, theirs = np.log(ours), np.log(theirs)
        np.testing.assert_allclose(theirs, ours, atol=steps.get(name, 1e-5), err_msg=name)
    # What has been through the coding once stays as it is.
    once_more = sparklod.write(tmp_path / f"again{suffix}", again)
    third = sparklod.read(once_more.path)
    for name in ("center", "scale", "opacity", "rgb"):
        np.testing.assert_allclose(getattr(third.splats, name), getattr(again.splats, name), rtol=2e-6, atol=1e-7)


def test_a_tree_is_read_as_a_tree(tree: sparklod.Tree, held: sparklod.Scene) -> None:
    assert isinstance(held, sparklod.Tree)
    assert np.array_equal(held.tree.child_start, tree.tree.child_start)
    assert np.array_equal(held.tree.child_count, tree.tree.child_count)
    assert "nodes" in repr(held) and "leaves" in repr(held) and "levels" in repr(held)


def test_leaves_of_a_tree_are_the_scene(scene: sparklod.Scene, tree: sparklod.Tree) -> None:
    leaves = sparklod.extract_leaves(tree)
    assert leaves.tree is None
    order, given = (np.lexsort(each.splats.center.T) for each in (leaves, scene))
    assert np.array_equal(leaves.splats.center[order], scene.splats.center[given])
    with pytest.raises(sparklod.FormatError, match="no Level-of-Detail tree"):
        sparklod.extract_leaves(scene)


@pytest.mark.parametrize("method", ["quick", "quality"])
def test_a_tree_is_what_the_command_bakes(scene: sparklod.Scene, tmp_path: Path, method: str) -> None:
    command("build-lod", DEMO, "--method", method, "-o", tmp_path / "theirs.spz", "-q")
    sparklod.write(tmp_path / "ours.spz", sparklod.build_lod(scene, method=method))
    assert (tmp_path / "ours.spz").read_bytes() == (tmp_path / "theirs.spz").read_bytes()


@pytest.mark.parametrize("encoding", ["packed", "ext", "lodtree", "texture"])
def test_arrays_are_what_the_command_writes(scene: sparklod.Scene, tmp_path: Path, encoding: str) -> None:
    command("build-lod", DEMO, "--encoding", encoding, "-o", tmp_path / "theirs.npz", "-q")
    sparklod.write(tmp_path / "ours.npz", sparklod.build_lod(scene), encoding=encoding)
    assert (tmp_path / "ours.npz").read_bytes() == (tmp_path / "theirs.npz").read_bytes()


@pytest.mark.parametrize("encoding", ["packed", "ext"])
def test_arrays_of_viewers_are_unpacked(scene: sparklod.Scene, tree: sparklod.Tree, encoding: str) -> None:
    words = sparklod.pack(tree, encoding) | sparklod.pack(tree, "lodtree")
    again = sparklod.unpack(words)
    assert isinstance(again, sparklod.Tree)
    assert np.array_equal(again.tree.child_start, tree.tree.child_start)
    near = {"packed": 2**-11, "ext": 0.0}[encoding]
    np.testing.assert_allclose(again.splats.center, tree.splats.center, rtol=near, atol=near and 2**-25)
    coarse = {"packed": 0.045, "ext": 0.006}[encoding]
    np.testing.assert_allclose(np.log(again.splats.scale), np.log(tree.splats.scale), atol=coarse)
    assert again.splats.opacity.max() > 1
    assert sparklod.unpack(sparklod.pack(scene, encoding)).tree is None
    with pytest.raises(sparklod.FormatError, match="nodes but"):
        sparklod.unpack(sparklod.pack(scene, encoding) | sparklod.pack(tree, "lodtree"))
    with pytest.raises(ValueError, match="no encoding 'zip'"):
        sparklod.pack(scene, "zip")


def test_a_scene_is_made_of_arrays() -> None:
    splats = random_splats(50, sh_degree=1)
    columns = {each.name: getattr(splats, each.name) for each in dataclasses.fields(splats)}
    made = sparklod.Scene.from_arrays(**columns)
    for name, column in columns.items():
        assert getattr(made.splats, name) is column, "float32 is not copied"
    wide = sparklod.Scene.from_arrays(**{name: column.astype(np.float64) for name, column in columns.items()})
    assert np.array_equal(wide.splats.sh, splats.sh)
    assert sparklod.Scene.from_arrays(**{**columns, "sh": None}).splats.sh_degree == 0
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
    ],
)
def test_arrays_of_other_shapes_are_refused(wrong: dict[str, Any], message: str) -> None:
    splats = random_splats(50)
    columns = {each.name: getattr(splats, each.name) for each in dataclasses.fields(splats)}
    with pytest.raises(ValueError, match=message):
        sparklod.Scene.from_arrays(**{**columns, **wrong})


def test_invalid_splats_are_refused() -> None:
    splats = random_splats(50)
    columns = {each.name: getattr(splats, each.name) for each in dataclasses.fields(splats)}
    with pytest.raises(sparklod.InvalidSplatsError, match="not finite"):
        sparklod.Scene.from_arrays(**{**columns, "opacity": np.full(50, np.nan)})


def test_errors_are_those_that_are_documented(scene: sparklod.Scene, tree: sparklod.Tree, tmp_path: Path) -> None:
    with pytest.raises(sparklod.FormatError):
        sparklod.read(tmp_path / "missing.ply")
    with pytest.raises(sparklod.FormatError, match=r"written as \.spz"):
        sparklod.write(tmp_path / "tree.ply", tree)
    with pytest.raises(sparklod.FormatError, match="a scene is written as"):
        sparklod.write(tmp_path / "scene.txt", scene)
    sparklod.write(tmp_path / "once.ply", scene)
    with pytest.raises(sparklod.OutputError, match="exists"):
        sparklod.write(tmp_path / "once.ply", scene)
    with pytest.raises(sparklod.FormatError, match="tree already"):
        sparklod.build_lod(tree)
    with pytest.raises(ValueError, match="no method 'fast'"):
        sparklod.build_lod(scene, method="fast")
    with pytest.raises(sparklod.CameraPathError, match="the camera looks at its own position"):
        sparklod.Camera.look_at(EYE, EYE)
    with pytest.raises(ValueError, match="threads is 0"):
        sparklod.read(DEMO, threads=0)
    with pytest.raises(ValueError, match="no column colour"):
        sparklod.read(DEMO, columns=["colour"])


def test_a_report_is_what_inspect_prints(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command("inspect", file, "--json", "--check", "--stats")
    theirs = json.loads(capsys.readouterr().out)
    ours = sparklod.inspect(file, all_quantities=True, check=True).as_dict()
    assert json.loads(json.dumps(ours)) == (theirs["files"][0] if "files" in theirs else theirs)


# Views


def test_a_cut_is_within_its_budget(held: sparklod.Tree) -> None:
    for budget in (1, 37, 500, 10**9):
        cut = sparklod.cut(held, camera(), budget=budget)
        assert len(cut) == len(cut.splats) == len(cut.nodes[0]) <= budget
        assert len(np.unique(cut.nodes[0])) == len(cut)
    leaves = int(held.tree.is_leaf.sum())
    assert len(sparklod.cut(held, camera(), budget=0.25)) <= leaves // 4
    assert repr(sparklod.cut(held, camera(), budget="5%")).startswith("Cut(")


@pytest.mark.parametrize("budget", [0, -3, 1.5, 0.0, "nothing"])
def test_invalid_budgets_are_refused(held: sparklod.Tree, budget: Any) -> None:
    with pytest.raises(ValueError, match=r"budget|neither"):
        sparklod.cut(held, camera(), budget=budget)


def test_cuts_in_half_precision_are_those_of_rounded_numbers(file: Path, held: sparklod.Tree, tmp_path: Path) -> None:
    path = FIXTURES / "cameras" / "sparklod.json"
    half = ["--camera-path", path, "--budget", 300, "--precision", "float16", "--no-timing"]
    command("traverse", file, *half, "-o", tmp_path / "theirs.csv", "-q")
    theirs = list(csv.DictReader(io.StringIO((tmp_path / "theirs.csv").read_text())))
    frames = sparklod.traverse(held, sparklod.read_cameras(path), budget=300, precision="float16")
    assert [str(row["pixel_scale_min"]) for row in frames] == [row["pixel_scale_min"] for row in theirs]
    exact = sparklod.traverse(held, sparklod.read_cameras(path), budget=300)
    assert frames.column("pixel_scale_min") != exact.column("pixel_scale_min")
    with pytest.raises(ValueError, match="no precision"):
        sparklod.cut(held, camera(), precision="float8")


@pytest.mark.parametrize("full", [False, True])
def test_a_picture_is_what_the_command_draws(file: Path, held: sparklod.Tree, tmp_path: Path, full: bool) -> None:
    what = ["--full"] if full else ["--budget", 400]
    size = f"{SIZE[0]}x{SIZE[1]}"
    command("render", file, "--look-at", VIEW, "--size", size, *what, "-o", tmp_path / "theirs.npy", "-q")
    drawn = held if full else sparklod.cut(held, camera(), budget=400)
    ours = sparklod.render(drawn, camera())
    assert ours.shape == (*SIZE[::-1], 4) and ours.dtype == np.float32
    assert ours[..., 3].any()
    assert np.array_equal(ours, np.load(tmp_path / "theirs.npy"))


def test_continuous_cuts_are_those_of_the_command(file: Path, held: sparklod.Tree, tmp_path: Path) -> None:
    size = f"{SIZE[0]}x{SIZE[1]}"
    view = ["--look-at", VIEW, "--size", size, "--budget", 400, "--continuous"]
    command("render", file, *view, "-o", tmp_path / "theirs.npy", "-q")
    ours = sparklod.render(sparklod.cut(held, camera(), budget=400, continuous=True), camera())
    assert np.array_equal(ours, np.load(tmp_path / "theirs.npy"))


def test_more_splats_are_nearer_to_full_detail(scene: sparklod.Scene, held: sparklod.Tree) -> None:
    full = sparklod.render(scene, camera())
    found = [
        sparklod.psnr(sparklod.render(sparklod.cut(held, camera(), budget=share), camera()), full)
        for share in (0.05, 0.3, 1.0)
    ]
    assert found == sorted(found)
    assert sparklod.psnr(full, full) == 100
    assert sparklod.ssim(full, full) == pytest.approx(1)
    with pytest.raises(ValueError, match="shapes"):
        sparklod.psnr(full, full[1:])


def test_rows_are_those_of_the_commands_table(file: Path, held: sparklod.Tree, tmp_path: Path) -> None:
    path = FIXTURES / "cameras" / "sparklod.json"
    command(
        "traverse", file, "--camera-path", path, "--budget", 300, "--no-timing", "-o", tmp_path / "theirs.csv", "-q"
    )
    frames = sparklod.traverse(held, sparklod.read_cameras(path), budget=300)
    theirs = list(csv.DictReader(io.StringIO((tmp_path / "theirs.csv").read_text())))
    columns = [column for column in frames.columns if column.name != "traverse_ms"]
    streamed = ("bytes_new",)  # a tree in memory is as large as its columns, not as its file
    for ours, row in zip(frames, theirs, strict=True):
        for column in columns:
            if column.name not in ("instance", *streamed):
                assert column.text(ours[column.name]) == row[column.name], column.name
    assert frames.summary().frames == len(frames)
    read_anew = sparklod.traverse(sparklod.Instance(file, "demo-lod"), sparklod.read_cameras(path), budget=300)
    assert [row["bytes_new"] for row in read_anew] == [int(row["bytes_new"]) for row in theirs]


def test_rows_do_not_depend_on_threads(held: sparklod.Tree) -> None:
    cameras = sparklod.orbit(held, count=5, size=SIZE)
    one, three = (sparklod.traverse(held, cameras, budget=300, threads=threads) for threads in (1, 3))
    assert without_time(one) == without_time(three)


def test_an_orbit_is_that_of_the_command(file: Path, held: sparklod.Tree, tmp_path: Path) -> None:
    command("traverse", file, "--orbit", 4, "--size", "160x120", "--budget", 300, "-o", tmp_path / "theirs.csv", "-q")
    theirs = list(csv.DictReader(io.StringIO((tmp_path / "theirs.csv").read_text())))
    cameras = sparklod.orbit(held, count=4, size=SIZE)
    assert [f"{camera.position[0]:.6f}" for camera in cameras] == [row["position_x"] for row in theirs]


def test_a_comparison_is_that_of_the_command(file: Path, held: sparklod.Tree, tmp_path: Path) -> None:
    size = f"{SIZE[0]}x{SIZE[1]}"
    view = ["--look-at", VIEW, "--size", size]
    command("render", file, *view, "--compare", "--budget", "5%,300", "-o", tmp_path / "theirs.csv", "-q")
    table = sparklod.compare(held, None, [camera()], budgets=[0.05, 300])
    theirs = list(csv.DictReader(io.StringIO((tmp_path / "theirs.csv").read_text())))
    for ours, row in zip(table, theirs, strict=True):
        assert {column.name: column.text(ours[column.name]) for column in table.columns} == row
    assert [each.text for each in table.summary()] == ["5%", "300"]


def test_full_detail_may_be_another_scene(scene: sparklod.Scene, held: sparklod.Tree) -> None:
    (own,) = sparklod.compare(held, None, [camera()], budgets=[1.0])
    (other,) = sparklod.compare(held, scene, [camera()], budgets=[1.0])
    assert own["psnr"] == 100 > other["psnr"] > 30  # type: ignore[operator]


def test_instances_stand_where_they_are_put(held: sparklod.Tree) -> None:
    there = np.eye(4)
    there[:3, 3] = 1, 0, 0
    both = [sparklod.Instance(held, "here"), sparklod.Instance(held, "there", there)]
    cut = sparklod.cut(both, camera(), budget=500)
    assert len(cut.nodes) == 2 and len(cut) <= 500
    rows = sparklod.traverse(both, [camera()], budget=500, by_instance=True)
    assert [row["instance"] for row in rows] == ["total", "here", "there"]
    assert [row["selected"] for row in rows] == [len(cut), *map(len, cut.nodes)]
    unnamed = sparklod.traverse([held, held], [camera()], budget=500, by_instance=True)
    assert [row["instance"] for row in unnamed] == ["total", "scene", "scene 2"]


def test_instances_are_of_files_or_scenes(file: Path) -> None:
    assert sparklod.Instance(str(file)).file == file  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="not of int"):
        sparklod.Instance(3)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"shape \(3, 3\); give \(4, 4\)"):
        sparklod.Instance(file, object_to_world=np.eye(3))


def test_plain_scenes_are_not_traversed(scene: sparklod.Scene) -> None:
    with pytest.raises(sparklod.FormatError, match="not a Level-of-Detail tree"):
        sparklod.traverse(scene, [camera()], budget=300)
    assert len(sparklod.cut(scene, camera(), budget=300)) == len(scene)


def test_tables_become_data_frames(held: sparklod.Tree) -> None:
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    frames = sparklod.traverse(held, [camera()] * 3, budget=300)
    data = frames.to_pandas()
    assert list(data.columns) == [column.name for column in frames.columns]
    assert data["selected"].tolist() == frames.column("selected")
    assert pandas.isna(data["churn"][0]) and not pandas.isna(data["churn"][1])


def test_without_pandas_an_error_says_so(held: sparklod.Tree, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(sparklod.SparklodError, match="pip install pandas"):
        sparklod.traverse(held, [camera()], budget=300).to_pandas()


# Progress, threads and notebooks


def test_progress_is_told_to_a_function_and_to_bars(scene: sparklod.Scene) -> None:
    told: list[tuple[str, int, int]] = []
    sparklod.build_lod(scene, progress=lambda stage, done, total, unit: told.append((stage, done, total)))
    assert told and all(0 <= done <= total for _, done, total in told)

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
    assert [bar.stage for bar in bars] == list(dict.fromkeys(stage for stage, *_ in told))
    assert all(bar.closed and bar.n == bar.total for bar in bars)


def test_work_is_done_on_the_threads_that_are_asked_for(
    scene: sparklod.Scene, held: sparklod.Tree, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sparklod_cli.render import rasterizer
    from sparklod_cli.support import jit

    before, used = jit.threads_in_use(), set()
    draw = rasterizer.draw

    def noted(*arguments: Any) -> Any:
        used.add(jit.threads_in_use())
        return draw(*arguments)

    monkeypatch.setattr(rasterizer, "draw", noted)
    sparklod.render(scene, camera(), threads=1)
    sparklod.compare(held, None, [camera()], budgets=[50, 0.5], threads=1)
    assert used == {1}
    sparklod.build_lod(scene, threads=1)
    assert jit.threads_in_use() == before


def test_notebooks_show_pictures_and_tables(held: sparklod.Tree, tmp_path: Path) -> None:
    picture = sparklod.show(sparklod.render(held, camera()))
    assert picture._repr_png_().startswith(b"\x89PNG")
    picture.save(tmp_path / "picture.png")
    assert (tmp_path / "picture.png").read_bytes() == picture.png
    frames = sparklod.traverse(held, [camera()] * 30, budget=300)
    html = frames._repr_html_()
    assert html.count("<tr>") == 1 + 20 + 1 and "…" in html
    assert repr(frames) in html
