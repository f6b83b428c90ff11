"""The sections that `run_all.py` measures: each makes the rows of one table of docs/performance*.md."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from performance.context import Context
from performance.rows import Row, Table


@dataclass(frozen=True)
class Section:
    """A table and how its rows are measured.

    Attributes:
        name: of the section, in figures.json and in the template of its page.
        module: which has the table.
        table: its name there.
        measure: makes the rows, with settings of a run.
    """

    name: str
    module: str
    table: str
    measure: Callable[[Any, Context], Iterable[Row]]

    def shown(self) -> Table:
        """The table."""
        table: Table = getattr(importlib.import_module(self.module), self.table)
        return table

    def rows(self, context: Context) -> list[Row]:
        """Measures."""
        return list(self.measure(importlib.import_module(self.module), context))


def _short(bench: Any, context: Context) -> Iterable[Row]:
    return bench.rows(context.scene("biker.ply"), context.count(7))


def _bakes(bench: Any, context: Context) -> Iterable[Row]:
    """Whole processes beside the native program; the slow builder has fewer runs, and one format."""
    from performance.made_scenes import half_million

    native = context.native if context.has_native() else None
    scenes = [context.scene("biker.ply")] + ([] if context.quick else [half_million(context)])
    ways = [way for way in (bench.SPZ, bench.RAD, bench.SPARK_SPZ, bench.SPARK_RAD) if native or not way.peer]
    for scene in scenes:
        for method, runs, used in (("quick", 5, ways), ("quality", 2, [way for way in ways if way.suffix == ".rad"])):
            folder = context.scratch / "bakes"
            folder.mkdir(exist_ok=True)
            yield from bench.time_rows([bench.Bakery(scene, method, folder, native)], used, context.count(runs))


def _compiling(bench: Any, context: Context) -> Iterable[Row]:
    return bench.rows(context.scene("biker.ply"), context.count(1), brief=context.quick)


def _quick(bench: Any, context: Context) -> Iterable[Row]:
    return _baking(bench, context, "quick", (0.5, 2, 5), 1e6)


def _quality(bench: Any, context: Context) -> Iterable[Row]:
    from performance.made_scenes import tiled_ply

    yield from _baking(bench, context, "quality", (0.5, 2), 0)
    if not context.quick:
        yield from bench.rows([tiled_ply(context, 2, degree=0)], "quality", context.count(2), warm=False)


def _baking(
    bench: Any, context: Context, method: str, millions: tuple[float, ...], spark_up_to: float
) -> Iterable[Row]:
    from performance.made_scenes import TILED, tiled_ply

    scenes = context.found("biker.ply", *(["biker.spz"] if method == "quick" else []), TILED)
    sizes = (0.1,) if context.quick else (*millions, *((10,) if context.large else ()))
    most = spark_up_to if spark_up_to and context.has_spark() else 0
    yield from bench.rows(scenes, method, context.count(5), spark_up_to=most)
    for each in sizes:
        runs = context.count(5 if each < 1 else 3 if each < 5 else 2)
        yield from bench.rows([tiled_ply(context, each)], method, runs, spark_up_to=most)


def _sizes(bench: Any, context: Context) -> Iterable[Row]:
    names = ("biker.ply",) if context.quick else ("biker.ply", "playbot-125k.ply", "meadow.sog")
    return bench.rows(context.found(*names), ("quick", "quality"))


def _busy(bench: Any, context: Context) -> Iterable[Row]:
    scene = context.scene("biker.ply" if context.quick else "playbot.sog")
    ways = ("all",) if context.quick else bench.WAYS
    return bench.rows(scene, "quick" if context.quick else "quality", ways, context.count(1))


def _rad(bench: Any, context: Context) -> Iterable[Row]:
    native = context.native if context.has_native() else None
    names = ("biker.ply",) if context.quick else ("biker.ply", "playbot-125k.ply", "meadow.sog", "playbot.sog")
    folder = context.scratch / "rad"
    folder.mkdir(exist_ok=True)
    left_out = {bench.CHUNKED, bench.SPARK_PALETTE}
    ways = [way for way in bench.WAYS if way not in left_out and (native or not way.peer)]
    bakeries = [
        bench.Bakery(scene, method, folder, native)
        for scene in context.found(*names)
        for method in ("quick", "quality")
        if scene.name != "playbot.sog" or method == "quick"
    ]
    return bench.size_rows(bakeries, ways)


def _decoding(bench: Any, context: Context) -> Iterable[Row]:
    from performance.made_scenes import TILED

    context.has_splat_transform()
    names = ("biker.ply",) if context.quick else ("playbot.sog", "meadow.sog", "biker.spz", "biker.ply", TILED)
    transform, runs = bench.SplatTransform(), context.count(5)
    try:
        yield from bench.rows(context.found(*names), transform, runs)
        yield from bench.tiled_rows(context.scene(TILED), 0.1 if context.quick else 1, transform, runs)
        if not context.quick:
            yield from bench.tiled_rows(context.scene(TILED), 5, transform, min(runs, 3), bench.LARGE)
    finally:
        transform.close()


def _inspecting(bench: Any, context: Context) -> Iterable[Row]:
    from performance.made_scenes import TILED

    sizes = (0.1,) if context.quick else (10,)
    return bench.rows(context.scene(TILED), (0,) if context.quick else (0, 2), sizes, context.count(3))


def _gradients(bench: Any, context: Context) -> Iterable[Row]:
    return bench.rows(bench.SPLATS[:1] if context.quick else bench.SPLATS, bench.SIZE, context.count(15))


def _scattered(bench: Any, context: Context) -> Iterable[Row]:
    return bench.scattered_rows(bench.SPLATS[:1] if context.quick else bench.SPLATS, bench.SIZE, context.count(15))


#: Scenes of real views.
VIEWED = ("biker.ply", "meadow.sog", "playbot.sog")


def _views(bench: Any, context: Context) -> Iterable[Row]:
    size = (320, 180) if context.quick else bench.SIZE
    return bench.view_rows(context.found(*VIEWED[: 1 if context.quick else None]), size, context.count(5))


def _commands(bench: Any, context: Context) -> Iterable[Row]:
    return bench.command_rows([context.scene("biker.ply")], bench.SIZE, context.count(5))


def _tiled_cuts(bench: Any, context: Context) -> Iterable[Row]:
    from performance.made_scenes import TILED

    sizes = (0.2,) if context.quick else tuple(size for size in bench.MILLIONS if size in (0.5, 2, 5) or context.large)
    flights = bench.tiled_flights(context.scene(TILED), sizes, 4 if context.quick else bench.FRAMES)
    return _cuts(bench, context, flights, bench.BUDGETS)


def _real_cuts(bench: Any, context: Context) -> Iterable[Row]:
    scenes = context.found(*VIEWED[: 1 if context.quick else None])
    return _cuts(bench, context, bench.real_flights(scenes), bench.REAL_BUDGETS)


def _cuts(bench: Any, context: Context, flights: Any, budgets: Any) -> Iterable[Row]:
    spark = bench.Spark() if context.has_spark() else None
    try:
        yield from bench.rows(flights, budgets, context.count(3), spark)
    finally:
        if spark:
            spark.close()


#: In the order of the pages.
SECTIONS = (
    Section("short", "bench_short", "TABLE", _short),
    Section("bakes", "bench_rad", "TIMES", _bakes),
    Section("compiling", "bench_compile", "TABLE", _compiling),
    Section("quick", "bench_build", "TABLE", _quick),
    Section("quality", "bench_build", "TABLE", _quality),
    Section("busy", "bench_busy", "TABLE", _busy),
    Section("sizes", "bench_size", "TABLE", _sizes),
    Section("rad-sizes", "bench_rad", "SIZES", _rad),
    Section("decoding", "bench_decode", "TABLE", _decoding),
    Section("inspecting", "bench_inspect", "TABLE", _inspecting),
    Section("rendering-scattered", "bench_render", "SCATTERED", _scattered),
    Section("rendering-views", "bench_render", "VIEWS", _views),
    Section("rendering-commands", "bench_render", "COMMAND", _commands),
    Section("gradients", "bench_gradients", "TABLE", _gradients),
    Section("cuts-tiled", "bench_traverse", "TILED", _tiled_cuts),
    Section("cuts-views", "bench_traverse", "REAL", _real_cuts),
)

BY_NAME = {section.name: section for section in SECTIONS}
