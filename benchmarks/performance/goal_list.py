"""The goals of docs/performance*.md, each with the figure that meets or misses it; they stand here only."""

from __future__ import annotations

from collections.abc import Sequence

from performance.goals import Figure, Goal
from performance.rows import Row


def of(name: str, per: float = 1.0) -> Figure:
    """The median of some runs, divided by `per`."""
    return lambda row: None if (value := row.value(name)) is None else value / per


def over(top: str, bottom: str, per: float = 1.0) -> Figure:
    """The ratio of two medians, divided by `per`."""
    return lambda row: None if (value := row.ratio(top, bottom)) is None else value / per


def growth(values: Sequence[float]) -> float:
    """The largest of some figures, over the smallest."""
    return max(values) / min(values)


#: Bytes that a process has before it reads a scene.
INTERPRETER = 130e6

BIKER, HALF_MILLION = "biker.ply", "playbot-500k.ply"


def _large(row: Row) -> bool:
    return (row.value("nodes") or 0) > 9e6


def _tiled(row: Row) -> bool:
    return str(row.labels["scene"]).startswith("tiled")


def _million_more(row: Row) -> bool:
    """Scenes with SH whose interpreter no longer counts."""
    return _tiled(row) and (row.value("splats") or 0) >= 2e6


GOALS: tuple[Goal, ...] = (
    *(
        Goal("short", text, "bakes", over("wall_s", "native_wall_s"), most=most, where={**where, "output": "RAD"})
        for text, most, where in (
            (
                "`build-lod` of 152,746 splats, quick builder: at most the native program's time",
                1.0,
                {"scene": BIKER, "method": "quick"},
            ),
            ("500,000 splats: at most 0.3 of it", 0.3, {"scene": HALF_MILLION, "method": "quick"}),
            (
                "500,000 splats, quality builder: at most 0.15 of the native `--quality`",
                0.15,
                {"scene": HALF_MILLION, "method": "quality"},
            ),
        )
    ),
    *(
        Goal(
            "short",
            f"500,000 splats to LoD SPZ, which is gzip, quick builder: at most {what} of the native program",
            "bakes",
            figure,
            most=1,
            where={"scene": HALF_MILLION, "method": "quick", "output": "SPZ"},
        )
        for what, figure in (
            ("the time", over("wall_s", "native_wall_s")),
            ("the size", over("output_bytes", "native_output_bytes")),
        )
    ),
    Goal(
        "short",
        "`build-lod --help` within 0.06 s",
        "short",
        of("wall_s"),
        most=0.06,
        where={"command": "build-lod --help"},
        form="{:.3f} s",
    ),
    Goal(
        "baking",
        "the quick builder alone: 3 million splats a second, SH 2, 0.5 to 5 million splats",
        "quick",
        over("splats", "warm_s", 1e6),
        least=3,
        only=lambda row: _tiled(row) and (row.value("splats") or 0) >= 5e5,
        name=("scene",),
    ),
    Goal(
        "baking",
        "near-linear growth: at most 1.25 times the time a splat from 0.5 to 5 million splats",
        "quick",
        over("warm_s", "splats"),
        most=1.25,
        only=lambda row: _tiled(row) and (row.value("splats") or 0) >= 5e5,
        across=growth,
    ),
    Goal(
        "baking",
        "peak of memory at most 3 times the PLY, SH 2, from 2 million splats on",
        "quick",
        over("peak_bytes", "input_bytes"),
        most=3,
        only=_million_more,
        form="{:.1f}",
        name=("scene",),
    ),
    Goal(
        "quality",
        "half the memory that 10 million splats of SH 0 took: 180 bytes a splat, measured at 2 million, less 130 MB of"
        " the interpreter",
        "quality",
        lambda row: ((row.value("peak_bytes") or 0) - INTERPRETER) / (row.value("splats") or 1),
        most=180,
        where={"scene": "tiled-2M-sh0.ply"},
        form="{:.0f} bytes",
    ),
    *(
        Goal(
            "sizes",
            f"{method}: a tree's SPZ takes at most {most:.2f} times the plain one",
            "sizes",
            over("spz_bytes", "plain_spz_bytes"),
            most=most,
            where={"method": method},
            name=("scene",),
        )
        for method, most in (("quick", 1.30), ("quality", 1.45))
    ),
    Goal(
        "busy",
        "four bakes at once take no longer than one after another",
        "busy",
        over("at_once_s", "in_turn_s"),
        most=1,
        where={"way": "all"},
    ),
    Goal(
        "rad",
        "RAD is at most as large as Spark's native RAD",
        "rad-sizes",
        over("RAD bytes", "Spark's RAD bytes"),
        most=1,
        name=("scene", "method"),
    ),
    *(
        Goal(
            "rad",
            f"RAD of 500,000 splats, {method} builder, in at most half of the native program's time",
            "bakes",
            over("wall_s", "native_wall_s"),
            most=0.5,
            where={"scene": HALF_MILLION, "method": method, "output": "RAD"},
        )
        for method in ("quick", "quality")
    ),
    Goal(
        "compiling",
        "the first `build-lod` compiles in under 10 s",
        "compiling",
        of("wall_s"),
        most=10,
        where={"command": "build-lod"},
        form="{:.1f} s",
    ),
    Goal(
        "compiling",
        "all commands, one after another, within 40 s",
        "compiling",
        of("wall_s"),
        most=40,
        where={"command": "all of these"},
        form="{:.1f} s",
    ),
    Goal(
        "decoding",
        "2 million splats a second or better, every format",
        "decoding",
        over("splats", "read_s", 1e6),
        least=2,
        name=("file",),
    ),
    Goal(
        "decoding",
        "a SOG of 5 million splats at twice splat-transform's speed",
        "decoding",
        over("transform_s", "read_s"),
        least=2,
        where={"file": "tiled-5M-sh0.sog"},
        form="{:.1f}x",
    ),
    Goal(
        "decoding",
        "peak while decoding: the decoded size and at most 256 MB",
        "decoding",
        lambda row: ((row.value("peak_bytes") or 0) - (row.value("decoded_bytes") or 0)) / 1e6,
        most=256,
        form="{:.0f} MB",
        name=("file",),
    ),
    *(
        Goal(
            "inspecting",
            f"`{way}` on 10 million nodes within {most} s",
            "inspecting",
            of("wall_s"),
            most=most,
            where={"way": way},
            only=_large,
            name=("SH",),
            form="{:.2f} s",
        )
        for way, most in (("--json", 1.5), ("--json --stats", 6.0), ("--check", 3.0))
    ),
    Goal(
        "inspecting",
        "`--json` on 10 million nodes within 1 GB",
        "inspecting",
        of("peak_bytes", 1e9),
        most=1,
        where={"way": "--json"},
        only=_large,
        name=("SH",),
        form="{:.2f} GB",
    ),
    Goal(
        "gradients",
        "gradients take at most 3 times as long as the picture",
        "gradients",
        over("gradients_cpu_s", "picture_cpu_s"),
        most=3,
        form="{:.1f}",
        name=("splats",),
    ),
    Goal(
        "gradients",
        "gradients of 20,000 splats within 25 ms",
        "gradients",
        of("gradients_cpu_s", 1e-3),
        most=25,
        where={"splats": 20_000},
        form="{:.1f} ms",
    ),
    *(
        Goal(
            "rendering",
            f"{count:,} scattered splats, 1280 x 720, within {most} ms",
            "rendering-scattered",
            of("draw_s", 1e-3),
            most=most,
            where={"splats": count},
            form="{:.1f} ms",
        )
        for count, most in ((100_000, 20), (500_000, 120), (1_500_000, 250))
    ),
    Goal(
        "rendering",
        "the whole command, a view of biker's tree at 1280 x 720, within 1 s",
        "rendering-commands",
        of("wall_s"),
        most=1,
        where={"command": "render, one view"},
        form="{:.2f} s",
    ),
    *(
        Goal(
            "cuts",
            f"{what}: {least} times Spark's speed at a budget of {budget:,}",
            "cuts-tiled",
            over("spark_s", figure),
            least=least,
            where={"budget": budget},
            name=("tree",),
            form="{:.1f}x",
        )
        for what, figure in (("a path", "path_s"), ("a first frame", "first_s"))
        for budget, least in ((200_000, 4), (1_500_000, 8))
    ),
    Goal(
        "cuts",
        "a first frame of real scenes, at a budget of 200,000: 4 times Spark's speed",
        "cuts-views",
        over("spark_s", "first_s"),
        least=4,
        where={"budget": 200_000},
        name=("tree",),
        form="{:.1f}x",
    ),
    Goal(
        "cuts",
        "statistics of a cut take at most a third of the time of finding it",
        "cuts-tiled",
        over("measure_s", "alone_s"),
        most=1 / 3,
        name=("tree", "budget"),
    ),
    Goal(
        "cuts",
        "the cost depends on the splats drawn, not on the tree: a cut of 200,000 takes at most 1.25 times as long in"
        " one tree as in another",
        "cuts-tiled",
        of("path_s"),
        most=1.25,
        where={"budget": 200_000},
        across=growth,
    ),
)
