"""Bakes out of core: memory, blocks, tasks, and the bytes, reports and errors of a bake in memory."""

from __future__ import annotations

import contextlib
import dataclasses
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from sparklod_cli.bake import estimate, order, store
from sparklod_cli.bake.built_tree import BuiltTree, output_of
from sparklod_cli.bake.cluster import bake_side_by_side
from sparklod_cli.bake.flow import bake
from sparklod_cli.bake.in_blocks import InBlocks
from sparklod_cli.bake.job import Job, LocalEngine, Task, cut_into_blocks
from sparklod_cli.bake.settings import LARGE, Baked, BakeSettings, Resources
from sparklod_cli.bake.store import Store
from sparklod_cli.codecs import ply
from sparklod_cli.codecs.formats import RadOptions, WriteOptions
from sparklod_cli.codecs.statistics import ALL
from sparklod_cli.fitting.fit_settings import FitSettings
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import chunk_order, quick
from sparklod_cli.lod.tree_settings import METHODS, bytes_of
from sparklod_cli.model import MAX_SH_DEGREE
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.selection import Selection
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.model.transforms import Transform
from sparklod_cli.system import machine
from sparklod_cli.system.errors import InvalidSplatsError, OutOfMemoryError, SparklodError
from sparklod_cli.system.progress import Progress, silent
from tests.bake.jobs import Loop, reader_of
from tests.conftest import FIXTURES, real_scene
from tests.scenes import random_splats

#: Builder, splats, and SH degree.
BAKES = (st.sampled_from(METHODS), st.integers(1, 10**9), st.integers(0, MAX_SH_DEGREE))


@given(*BAKES, st.integers(0, 1 << 40))
def test_a_block_is_the_largest_power_of_two_that_fits_into_memory(
    method: str, splats: int, degree: int, memory: int
) -> None:
    least = estimate.out_of_core_bytes(method, splats, degree, estimate.LEAST_BLOCK_SPLATS)
    if memory < least:
        with pytest.raises(OutOfMemoryError, match="too little even out of core"):
            estimate.block_splats_within(memory, method, splats, degree)
        memory = least
    size = estimate.block_splats_within(memory, method, splats, degree)
    assert size & (size - 1) == 0
    assert estimate.LEAST_BLOCK_SPLATS <= size <= estimate.MOST_BLOCK_SPLATS
    assert estimate.out_of_core_bytes(method, splats, degree, size) <= memory
    if size < estimate.MOST_BLOCK_SPLATS:
        assert estimate.out_of_core_bytes(method, splats, degree, 2 * size) > memory
    assert estimate.block_splats_within(None, method, splats, degree) == estimate.MOST_BLOCK_SPLATS


@given(*BAKES, st.booleans())
def test_memory_grows_with_splats_and_sh_and_its_largest_scene_fills_it(
    method: str, splats: int, degree: int, refines: bool
) -> None:
    settings = BakeSettings(method, refine=FitSettings() if refines else None)
    for of, recipe in ((estimate.in_memory_bytes, settings), (estimate.scratch_bytes, method)):
        assert of(recipe, splats, degree) <= of(recipe, splats + 1, degree)
        assert of(recipe, splats, degree) <= of(recipe, splats, MAX_SH_DEGREE)
    memory = estimate.in_memory_bytes(settings, splats, degree)
    assert estimate.most_in_memory(memory, settings, degree) == splats
    assert estimate.most_in_memory(memory - 1, settings, degree) == splats - 1


@given(st.integers(1, 10**9), st.integers(0, MAX_SH_DEGREE), st.integers(0, 1 << 40), st.integers(1, 64))
def test_windows_that_are_encoded_together_fit_into_memory(splats: int, degree: int, memory: int, threads: int) -> None:
    windows = estimate.windows_within(memory, splats, degree, threads)
    window = bytes_of(estimate.OF_WINDOW, min(2 * splats, estimate.WINDOW), degree)
    assert 1 <= windows <= threads
    assert windows == 1 or estimate.PROCESS + windows * window <= memory


@pytest.mark.parametrize("method", METHODS)
def test_five_million_splats_are_baked_in_600_mb(method: str) -> None:
    estimate.block_splats_within(600_000_000, method, 5_000_000, 0, in_chunks=True, threads=2)


def test_by_default_a_bake_takes_a_share_of_the_available_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "available_memory", lambda: 8_000_000_000)
    assert estimate.default_memory() == 6_000_000_000
    monkeypatch.setattr(machine, "available_memory", lambda: None)
    assert estimate.default_memory() is None


@pytest.mark.parametrize(
    ("count", "block", "blocks"), [(5000, 500, 10), (5000, 5000, 1), (5000, 2500, 2), (1000, 90, 12)]
)
def test_blocks_have_nearly_as_many_splats_each(count: int, block: int, blocks: int) -> None:
    center = np.random.default_rng(5).normal(size=(count, 3))
    division = cut_into_blocks(center, count, block)
    _, ends = division.sort(center)
    sizes = np.diff(ends)
    assert len(sizes) == division.count == blocks
    assert sizes.sum() == count
    assert sizes.max() <= 1.2 * count / blocks


COUNT = 6


@dataclasses.dataclass(frozen=True)
class SumJob:
    """A sum of squares, one of whose tasks raises an error."""

    store: Store
    fails: int = -1
    error: type[BaseException] = KeyboardInterrupt


def put_square(job: SumJob, number: int, *, threads: int, progress: Progress) -> None:
    for step in range(1, 5):
        progress("squaring", step, 4, "splat")
    progress("checking", 1, 4, "splat")
    if number == job.fails:
        raise job.error
    job.store.put(f"number/{number}", {"value": np.array([number**2, threads])})


def put_sum(job: SumJob, *, threads: int, progress: Progress) -> None:
    squares = [int(job.store.get(f"number/{number}")["value"][0]) for number in range(COUNT)]
    job.store.put("sum", {"value": np.array([sum(squares)])})


SQUARES = [Task(f"number/{number}", put_square, (number,), weight=100) for number in range(COUNT)]
TASKS = [*SQUARES, Task("sum", put_sum, needs=tuple(task.name for task in SQUARES), weight=30)]
PAIRED = [dataclasses.replace(task, together=2) for task in SQUARES]


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_an_interrupted_run_is_continued_on_the_given_threads(error: type[BaseException], tmp_path: Path) -> None:
    store, steps = Store(tmp_path), list[tuple[str, int, int, str]]()
    with pytest.raises(error):
        LocalEngine(threads=1).run("building", TASKS, SumJob(store, 3, error), silent)
    assert store.names() == ["number/0", "number/1", "number/2"]
    LocalEngine(threads=2).run("building", TASKS, SumJob(store), lambda *step: steps.append(step))
    assert store.get("sum")["value"].tolist() == [sum(number**2 for number in range(COUNT))]
    assert [int(store.get(task.name)["value"][1]) for task in SQUARES] == [1, 1, 1, 2, 2, 2]
    done = [step[1] for step in steps]
    assert done == sorted(done)
    assert done[:4] == [100, 200, 300, 325]  # those done before count
    assert steps[-1] == ("building", 100 * COUNT + 30, 100 * COUNT + 30, "splat")
    assert {step[0] for step in steps} == {"building"}


def test_tasks_that_fit_into_memory_together_share_the_threads(tmp_path: Path) -> None:
    store, done = Store(tmp_path / "all"), list[int]()
    LocalEngine(threads=4).run("encoding", PAIRED, SumJob(store), lambda stage, now, total, unit: done.append(now))
    values = [store.get(task.name)["value"].tolist() for task in PAIRED]
    assert values == [[number**2, 2] for number in range(COUNT)]
    assert done == [100 * (number + 1) for number in range(COUNT)]
    store = Store(tmp_path / "failing")
    with pytest.raises(MemoryError):
        LocalEngine(threads=2).run("encoding", PAIRED, SumJob(store, 3, MemoryError), silent)
    assert "number/3" not in store.names()


@pytest.fixture
def small_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows, and ranges of keys, of which a small scene has several."""
    monkeypatch.setattr(order, "WINDOW_NODES", 64)
    monkeypatch.setattr(store, "GAP", 5)
    monkeypatch.setattr(chunk_order, "FIRST_BAND", 16)
    monkeypatch.setattr(order, "MERGED", 20)
    monkeypatch.setattr(order, "PROBES", 5)


def built(folder: str, splats: Splats, how: BakeSettings, block: int, engine: Loop, *, in_chunks: bool) -> BuiltTree:
    """A tree in a store, of blocks of about this many splats."""
    job = Job(Store(Path(folder)), reader_of(Scene(splats)), how, ALL, in_chunks)
    tree = output_of(Path(folder) / "out", how, overwrite=False)
    blocks = InBlocks(job, engine, block, 1, silent)
    blocks.build(tree)
    blocks.order(tree)
    return tree


def check_same(actual: tuple[Splats, LodTree], expected: tuple[Splats, LodTree]) -> None:
    for name in COLUMNS:
        assert getattr(actual[0], name).tobytes() == getattr(expected[0], name).tobytes(), name
    assert np.array_equal(actual[1].child_count, expected[1].child_count)
    assert np.array_equal(actual[1].child_start, expected[1].child_start)


@given(
    st.integers(1, 400),
    st.integers(0, 2**32 - 1),
    st.sampled_from([15, 40, 200, 1000]),
    st.sampled_from([0, 0, 1, 2]),
    st.sampled_from([1.1, 1.5, 2.0]),
    st.booleans(),
)
# Without shrinking, which takes minutes, as any scene will do.
@settings(max_examples=15, deadline=None, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@pytest.mark.usefixtures("small_windows")
def test_quick_builds_the_nodes_of_a_bake_in_memory_bit_for_bit(
    count: int, seed: int, block: int, degree: int, base: float, in_chunks: bool
) -> None:
    splats = random_splats(count, seed=seed, sh_degree=degree)
    rng = np.random.default_rng(seed)
    expected = quick.build(splats, base)
    expected = chunk_order.arrange(*expected) if in_chunks else expected
    with tempfile.TemporaryDirectory() as folder:
        tree = built(folder, splats, BakeSettings(base=base), block, Loop(rng), in_chunks=in_chunks)
        total = tree.nodes.count
        check_same(tree.nodes.read(0, total), expected)
        start, stop = np.sort(rng.integers(0, total + 1, 2)).tolist()
        if start < stop:
            window = slice(start, stop)
            part = LodTree(expected[1].child_count[window], expected[1].child_start[window])
            check_same(tree.nodes.read(start, stop), (expected[0].take(window), part))
    assert tree.baked.levels == expected[1].depths().max() + 1


#: Splats of the scene that is baked both ways.
SPLATS = 900

SETTINGS: dict[str, dict[str, Any]] = {
    "plain": {},
    "another base": {"base": 1.3},
    "without harmonics": {"max_sh": 0},
    "with fewer harmonics": {"max_sh": 1},
    "in a ball": {"selection": Selection(within=((0.0, 0.0, 0.0), 0.8))},
    "a single one": {"selection": Selection(within=((0.0, 0.0, 0.0), 1e-9))},
    "in a box": {"selection": Selection(min_box=(-1.0, -1.0, -1.0), max_box=(0.5, 0.5, 0.5), min_opacity=0.3)},
    "turned": {"transform": Transform.from_parts(up="z", rotate=(10, 20, 30), scale=3.0, translate=(1, 2, 3))},
    "of chunk files": {"suffix": ".rad", "options": WriteOptions(rad=RadOptions(chunked=True))},
    "with a palette": {"suffix": ".rad", "options": WriteOptions(rad=RadOptions(sh_codes=50))},
}


def file_of(folder: Path, splats: Splats) -> Path:
    path = folder / "scene.ply"
    path.write_bytes(b"".join(ply.encode(Scene(splats))))
    return path


def bake_both_ways(source: Path, folder: Path, how: BakeSettings, block: int) -> Baked:
    """Bake in memory and out of core, and compare the files and the results; return that of out of core."""
    places = [folder / name / f"scene{how.suffix}" for name in ("memory", "blocks")]
    results = [
        bake(source, place, how, resources=resources)
        for place, resources in zip(places, (None, Resources(block_splats=block)), strict=True)
    ]
    files = [{each.name: each.read_bytes() for each in place.parent.iterdir()} for place in places]
    assert files[0] == files[1]
    own = {"seconds", "blocks", "scratch_bytes_written", "scratch_bytes_read"}
    memory, blocks = ({key: value for key, value in vars(each).items() if key not in own} for each in results)
    assert memory == blocks
    return results[1]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene with harmonics, some of whose splats cannot be seen, and one at the origin."""
    splats = random_splats(SPLATS, sh_degree=2, seed=5)
    splats.opacity[::7] = 0
    splats.scale[::11] = 0
    splats.center[100] = 0
    return file_of(tmp_path_factory.mktemp("scene"), splats)


@pytest.mark.slow
@pytest.mark.parametrize("name", SETTINGS)
def test_quick_makes_the_same_file(name: str, scene: Path, tmp_path: Path) -> None:
    settings = {"suffix": ".rad" if len(name) % 2 else ".spz"} | SETTINGS[name]
    blocks = bake_both_ways(scene, tmp_path, BakeSettings(**settings), 100)
    assert blocks.blocks is not None
    assert (blocks.blocks > 1) == (blocks.splats > 100)


@pytest.mark.slow
def test_quick_makes_the_same_file_with_colours_from_another(scene: Path, tmp_path: Path) -> None:
    colours = tmp_path / "rgba.bin"
    colours.write_bytes(np.random.default_rng(0).integers(0, 256, (SPLATS, 4), np.uint8).tobytes())
    bake_both_ways(scene, tmp_path, BakeSettings(rgba=colours), 100)


HARD, REAL = ("coincident.ply", "one.ply", "huge.ply", "sh3.ply"), ("playbot-125k.ply", "biker.spz")


@pytest.mark.slow
@pytest.mark.parametrize("name", [*HARD, *REAL])
def test_quick_makes_the_same_file_of_hard_and_real_scenes(name: str, tmp_path: Path) -> None:
    source = FIXTURES / name if name in HARD else real_scene(name)
    block = 1 + len(read_scene(source)) // 8 if name in HARD else 30_000
    bake_both_ways(source, tmp_path, BakeSettings(suffix=".rad"), block)


def with_values(**columns: Any) -> Splats:
    """A scene with other values in some rows of some columns."""
    splats = random_splats(SPLATS, seed=6)
    for name, rows in columns.items():
        for row, value in rows.items():
            getattr(splats, name)[row] = value
    return splats


BAD = {
    "not finite": (with_values(center={700: np.nan, 701: np.inf}), {}),
    "of several kinds": (with_values(center={350: np.nan}, rgb={777: np.inf}), {}),
    "nothing left": (with_values(), {"selection": Selection(min_box=(1e6, 1e6, 1e6))}),
    "invisible": (with_values(opacity=dict.fromkeys(range(SPLATS), 0)), {}),
    "beyond float32": (
        with_values(center={0: 1e30}),
        {"transform": Transform(scale=1e12, translation=(1e12, 0, 0))},
    ),
    "empty": (random_splats(0), {}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BAD)
def test_a_scene_that_cannot_be_baked_is_refused_with_the_same_message(name: str, tmp_path: Path) -> None:
    splats, how = BAD[name]
    source, said = file_of(tmp_path, splats), []
    for resources in (None, Resources(block_splats=100)):
        with pytest.raises(InvalidSplatsError) as error:
            bake(source, tmp_path / "out.spz", BakeSettings(**how), resources=resources)
        said.append(str(error.value))
    assert said[0] == said[1]
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]


@pytest.mark.slow
def test_invalid_splats_are_dropped_and_counted(tmp_path: Path) -> None:
    source = file_of(tmp_path, with_values(center={5: np.nan, 700: np.inf}, opacity={6: 0}))
    bake_both_ways(source, tmp_path, BakeSettings(selection=Selection(drop_invalid=True)), 100)


@pytest.mark.slow
def test_quality_makes_one_file_for_any_order_of_tasks_and_number_of_threads(tmp_path: Path) -> None:
    source, files = file_of(tmp_path, random_splats(4 * SPLATS, sh_degree=1, seed=7)), set()
    settings, resources = BakeSettings(method="quality"), Resources(block_splats=SPLATS)
    for number, threads in enumerate((1, 2, 3)):
        place = tmp_path / f"{number}.spz"
        engine = Loop(np.random.default_rng(number), threads)
        baked = bake(source, place, settings, resources=resources, engine=engine)
        assert (baked.blocks, baked.splats) == (4, 4 * SPLATS)
        files.add(place.read_bytes())
    assert len(files) == 1


class WorkersHere:
    """An engine whose workers are this process."""

    def __init__(self) -> None:
        self.checked: list[Path] = []

    def check(self, store: None, files: list[Path]) -> None:
        self.checked += files

    @contextlib.contextmanager
    def map_calls(
        self, stage: str, call: Any, arguments: list[Any], progress: Any, unit: str
    ) -> Iterator[Iterator[Any]]:
        yield (call(*each, threads=1) for each in arguments)


def side_by_side(pairs: list[tuple[Path, Path]], engine: WorkersHere, memory: int | None, make: Any) -> list[Any]:
    resources = Resources(memory=memory)
    how: dict[str, Any] = {"make": make, "settings": BakeSettings(), "engine": engine, "resources": resources}
    return list(bake_side_by_side(pairs, **how))


def test_scenes_too_large_for_a_worker_are_left_to_this_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    engine, memory = WorkersHere(), estimate.in_memory_bytes(BakeSettings(), 1000, 1)
    pairs = [(FIXTURES / name, Path(name).with_suffix(".spz")) for name in ("sh0.ply", "demo.ply", "sh1.ply")]
    first, large, last = side_by_side(pairs, engine, memory, bake)
    assert large is LARGE
    assert first.splats > 0 and last.splats > 0
    assert engine.checked == [source for source, _ in pairs]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sh0.spz", "sh1.spz"]


def test_an_output_that_a_worker_wrote_elsewhere_is_an_error(tmp_path: Path) -> None:
    baked = bake(FIXTURES / "one.ply", tmp_path / "there.spz", BakeSettings())
    pair = (FIXTURES / "one.ply", tmp_path / "one.spz")
    (error,) = side_by_side([pair], WorkersHere(), None, lambda *_, **__: baked)
    assert isinstance(error, SparklodError)
    assert "wrote" in str(error) and "give --output-dir a folder that all machines share, or a URL" in str(error)
