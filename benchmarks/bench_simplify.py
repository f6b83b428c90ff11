"""Compares programs that simplify scenes: `python benchmarks/bench_simplify.py --help`.

Every program gets the same PLY, without spherical harmonics, and is measured as a process from its start to its end:
reading, building and writing. Trees are drawn as cuts of so many splats for each camera; the others are one set of
splats for all cameras. GHAP and V3DG are left out, see `LEFT_OUT`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench_fidelity import MADE, scenes_of, size_of, sources
from fidelity_report import add_docs, columns, markdown, merged, put_into
from fidelity_trees import METHODS, spark_command, spark_tree
from fidelity_views import SIZE, Figures, FullDetail, cameras_of, count_of, of_tree
from performance.machine import load, machine
from performance.process import SPARKLOD, CommandError, Took, run
from scenes import write_ply

import sparklod_cli as sparklod

#: Shares of the splats that are left, and those of the table that has all programs.
SHARES = ("50%", "25%", "10%", "5%", "1%")
COMPARED = ("10%", "1%")

#: The set of cameras.
CAMERAS = "around"

#: Simplifiers that build trees, of which each camera gets a cut, by their names in tables.
TREES = {method: METHODS[method] for method in ("spark-tiny", "spark-quality", "quick", "quality", "refined")}

#: Simplifiers that leave one set of splats for all cameras.
SETS = {
    "decimate": "splat-transform --decimate",
    "decimate-adaptive": "splat-transform --decimate-adaptive",
    "nanogs": "NanoGS",
    "simplify": "our simplify",
    "simplify-refined": "our simplify, refined",
}

SIMPLIFIERS = TREES | SETS

#: Simplifiers that take minutes, and are measured only if they are named.
SLOW = ("refined", "simplify-refined")

#: Programs of others: the variable of the environment that names a folder, and what must be there.
SPLAT_TRANSFORM = "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
PEERS = {
    "spark-tiny": ("SPARK_DIR", "node_modules/@sparkjsdev/spark"),
    "spark-quality": ("SPARK_DIR", "node_modules/@sparkjsdev/spark"),
    "decimate": ("ENGINES_DIR", SPLAT_TRANSFORM),
    "decimate-adaptive": ("ENGINES_DIR", SPLAT_TRANSFORM),
    "nanogs": ("NANOGS_DIR", "simplification.py"),
}

#: Why some are not measured.
LEFT_OUT = {
    "GHAP": "its program is a training run, which needs the photographs of the scene and CUDA",
    "V3DG": "its builder optimises each level with gsplat and selects CUDA as the only device",
}

#: Figures by scene and method, each a `Simplified` as a dictionary.
Scenes = dict[str, dict[str, dict[str, Any]]]


@dataclass(frozen=True)
class Simplified:
    """The results of one program for a scene.

    Attributes:
        runs: of the program, one for all shares or one for each.
        figures: by share, how far pictures are from full detail.
        splats: by share, how many are drawn; at most so many of a cut.
    """

    runs: list[Took]
    figures: dict[str, Figures]
    splats: dict[str, int]

    def as_dict(self) -> dict[str, Any]:
        """Return the record of the JSON; `fidelity_report.merged` adds such records up."""
        return {
            "seconds": [took.wall_s for took in self.runs],
            "cpu_seconds": [took.cpu_s for took in self.runs],
            "peak_bytes": [took.peak_bytes for took in self.runs],
            "splats": self.splats,
            "load": load(),  # over the last minute, with what was measured
            "views": {CAMERAS: {share: dataclasses.asdict(each) for share, each in self.figures.items()}},
        }


class Comparison:
    """A scene that is simplified by one program after another.

    Args:
        drawn: full detail, without spherical harmonics.
        size: of the pictures, width and height.
        every: take every so many cameras.
        folder: for what programs write.
        steps: of refining; None for the default.
    """

    def __init__(
        self, drawn: sparklod.Scene, size: tuple[int, int], every: int, folder: Path, steps: int | None = None
    ) -> None:
        self._drawn = drawn
        self._cameras = cameras_of(CAMERAS, drawn, size)[::every]
        self._full = FullDetail(drawn, self._cameras)
        self._folder = folder
        self._ply = folder / "scene.ply"
        self._refine = ["--refine", *([] if steps is None else [str(steps)])]
        write_ply(self._ply, drawn.splats)

    def simplified(self, method: str) -> Simplified:
        """Run a method of `SIMPLIFIERS` and measures what it made.

        Raises:
            CommandError: the program failed.
        """
        if method in SETS:
            return self._sets(method)
        return self._tree(method)

    def _tree(self, method: str) -> Simplified:
        """Measure a tree, of which every camera gets a cut."""
        if method.startswith("spark-"):
            took = run(spark_command(self._ply, method.removeprefix("spark-"), self._folder))
            tree = spark_tree(self._folder)
        else:
            refined = method == "refined"
            file = self._folder / f"{method}.spz"
            took = self._bake(file, "--method", "quality" if refined else method, *(self._refine if refined else []))
            tree = sparklod.read(file)
        assert isinstance(tree, sparklod.Tree)
        tree = dataclasses.replace(tree, antialiased=self._drawn.antialiased)
        figures = of_tree(tree, self._drawn, self._cameras, SHARES)
        return Simplified([took], figures, {share: count_of(share, len(self._drawn)) for share in SHARES})

    def _sets(self, method: str) -> Simplified:
        """Measure the splats that a program leaves, run once for each share; a slow one for `COMPARED` alone."""
        runs, sets = [], {}
        for share in COMPARED if method in SLOW else SHARES:
            output = self._folder / f"{method}-{share[:-1]}.ply"
            runs.append(run(set_command(method, self._ply, output, share)))
            sets[share] = sparklod.read(output).splats
        return self._drawn_whole(runs, sets)

    def _drawn_whole(self, runs: list[Took], sets: Mapping[str, sparklod.Splats]) -> Simplified:
        for share, splats in sets.items():
            if abs(len(splats) / count_of(share, len(self._drawn)) - 1) > 0.01:
                raise CommandError(f"{len(splats):,} splats are not {share} of {len(self._drawn):,}")
        antialiased = self._drawn.antialiased
        figures = {
            share: self._full.of_scene(sparklod.Scene(splats, antialiased=antialiased))
            for share, splats in sets.items()
        }
        return Simplified(runs, figures, {share: len(splats) for share, splats in sets.items()})

    def _bake(self, output: Path, *options: str) -> Took:
        return run([*SPARKLOD, "build-lod", self._ply, "-o", output, "--quiet", *options])


def set_command(method: str, source: Path, output: Path, share: str) -> list[str | Path]:
    """Return the command by which a program leaves a share such as "10%" of the splats of a PLY."""
    if method.startswith("simplify"):
        refine = ["--refine"] if method.endswith("refined") else []
        return [*SPARKLOD, "simplify", source, "--to", share, "-o", output, "--quiet", *refine]
    program = _program(method)
    if method == "nanogs":
        own = program.parent / ".venv" / "bin" / "python"
        python = own if own.is_file() else Path(sys.executable)
        return [python, program, "--ply", source, "-o", output, "-r", str(float(share[:-1]) / 100)]
    return ["node", program, "-q", "-w", "-g", "cpu", source, f"--{method}", share, output]


def why_skipped(method: str) -> str | None:
    """Return why a program cannot be run; None if it can."""
    if method not in PEERS:
        return None
    variable, file = PEERS[method]
    if variable not in os.environ:
        return f"{variable} is not set; it names a folder with {file}"
    return None if _program(method).exists() else f"{variable} has no {file}"


def _program(method: str) -> Path:
    variable, file = PEERS[method]
    return Path(os.environ[variable]).absolute() / file


def tables(scenes: Scenes) -> dict[str, str]:
    """Return the table of all programs on scenes that are not made, and that of the sets at every share."""
    real = {name: methods for name, methods in scenes.items() if Path(name).stem not in MADE}
    return {"simplify": comparison_table(real), "sets": sets_table(scenes)}


def comparison_table(scenes: Scenes) -> str:
    """Return the table of all programs: a row for each scene and program."""
    rows = []
    for scene, methods in scenes.items():
        for method in SIMPLIFIERS:
            if method in methods:
                measured = methods[method]
                seconds = dict(zip(measured["splats"], measured["seconds"], strict=False))
                runs = COMPARED if len(seconds) > 1 else seconds
                peak = f"{max(measured['peak_bytes']) / 1e6:,.0f}"
                cells = [cell for share in COMPARED for cell in _cells(measured["views"][CAMERAS][share])]
                cameras = "all" if method in SETS else "each"
                times = " + ".join(f"{seconds[share]:.1f}" for share in runs)
                rows.append([scene, SIMPLIFIERS[method], cameras, *cells, times, peak])
    names = [f"{share}: {name}" for share in columns(COMPARED) for name in ("PSNR", "edges", "SSIM")]
    return markdown(["scene", "simplified by", "cameras", *names, "s", "peak MB"], rows)


def sets_table(scenes: Scenes) -> str:
    """Return the table of the PSNR of sets for all cameras."""
    rows = [
        [scene, SETS[method], *(_psnr(methods[method]["views"][CAMERAS].get(share)) for share in SHARES)]
        for scene, methods in scenes.items()
        for method in SETS
        if method in methods
    ]
    return markdown(["scene", "simplified by", *columns(SHARES)], rows)


def _psnr(figures: Mapping[str, Any] | None) -> str:
    return "" if figures is None else f"{figures['psnr']:.2f}"


def _cells(figures: Mapping[str, Any]) -> list[str]:
    edge = figures["edge_psnr"]
    return [f"{figures['psnr']:.2f}", "" if edge is None else f"{edge:.2f}", f"{figures['ssim']:.4f}"]


def measure(arguments: argparse.Namespace, scratch: Path) -> dict[str, Any]:
    """Measure all scenes; the JSON is written after each program, so that a long run may end early."""
    record: dict[str, Any] = {
        "machine": machine(),
        "size": arguments.size,
        "every": arguments.every,
        "cameras": [CAMERAS],
        "budgets": SHARES,
        "scenes": {},
    }
    reasons = {method: why_skipped(method) for method in arguments.methods}
    for method, reason in reasons.items():
        if reason:
            print(f"{SIMPLIFIERS[method]} is skipped: {reason}", file=sys.stderr)
    run([*SPARKLOD, "warmup"])  # so that no run compiles
    for path in scenes_of(arguments.scenes, scratch):
        methods = record["scenes"].setdefault(path.name, {})
        with tempfile.TemporaryDirectory(prefix="simplify-") as folder:
            drawn = next(sources(path, arguments)).drawn
            comparison = Comparison(drawn, arguments.size, arguments.every, Path(folder), arguments.steps)
            for method in (method for method, reason in reasons.items() if not reason):
                try:
                    methods[method] = comparison.simplified(method).as_dict()
                except CommandError as error:  # the others go on
                    print(f"{path.name}: {SIMPLIFIERS[method]}: {error}", file=sys.stderr, flush=True)
                    continue
                psnr = ", ".join(f"{each['psnr']:.2f}" for each in methods[method]["views"][CAMERAS].values())
                print(f"{path.name}: {SIMPLIFIERS[method]}: {psnr} dB", file=sys.stderr, flush=True)
                if arguments.json:
                    arguments.json.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    return record


def main() -> None:
    """Print Markdown tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", help="those that bench_fidelity.py takes")
    usual = [method for method in SIMPLIFIERS if method not in SLOW]
    text = f"by default all but {', '.join(SLOW)}; those whose folder is missing are skipped"
    parser.add_argument("--methods", nargs="+", choices=SIMPLIFIERS, default=usual, help=text)
    parser.add_argument("--steps", type=int, help="of refining; by default what suits each tree")
    parser.add_argument("--every", type=int, default=1, help="take every so many cameras, for a quick run")
    parser.add_argument("--size", type=size_of, default=SIZE, help="of the pictures (default 960x540)")
    parser.add_argument("--json", type=Path, help="file for all numbers, with those of each camera")
    text = "JSONs of earlier runs, whose rows the table has as well; of what was measured twice, the later one counts"
    parser.add_argument("--results", type=Path, nargs="+", default=[], help=text)
    add_docs(parser)
    parser.set_defaults(growth=1.4, sh=False, trees=None)  # of `bench_fidelity.sources`
    arguments = parser.parse_args()
    if not (arguments.scenes or arguments.results):
        parser.error("name scenes to measure, or --results to print")
    scenes: Scenes = merged(arguments.results).get("scenes", {})
    if arguments.scenes:
        with tempfile.TemporaryDirectory() as scratch:
            for scene, methods in measure(arguments, Path(scratch))["scenes"].items():
                scenes.setdefault(scene, {}).update(methods)
    made = tables(scenes)
    for name, table in made.items():
        print(f"{name}\n\n{table}\n")
    for name, reason in LEFT_OUT.items():
        print(f"{name} is left out: {reason}.")
    if arguments.docs:
        put_into(arguments.docs, made)


if __name__ == "__main__":
    main()
