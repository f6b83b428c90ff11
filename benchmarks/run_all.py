"""Measures every table of docs/performance*.md and writes the pages: `python benchmarks/run_all.py --help`.

Each section is measured in a process of its own, between two calibrations of the machine; figures.json and the pages
are written after each, so that a run may be interrupted and go on with `--sections`. A section that fails keeps its
earlier figures, and the others go on. At the end stands where figures fell behind the last committed ones.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from datetime import datetime, timezone
from multiprocessing import get_context
from pathlib import Path

from performance import figures as store
from performance.behind import behind
from performance.calibration import calibrate
from performance.context import Context
from performance.figures import Figures, Measured
from performance.goal_list import GOALS
from performance.goals import judged
from performance.machine import load, whole_machine
from performance.page import PAGES, page, template, write_pages
from performance.rows import Row
from performance.sections import BY_NAME, SECTIONS

HERE = Path(__file__).resolve().parent

#: What is written, and where real scenes are looked for.
FIGURES, DOCS = HERE / "figures.json", HERE.parent / "docs"
SCENES = Path(os.environ.get("SPARKLOD_SCENES") or HERE.parents[1] / "shared" / "scenes")


def main() -> int:
    """Measures, and returns 1 if a section failed."""
    arguments = _arguments()
    if arguments.write_page:
        write_pages(arguments.docs, store.read(arguments.figures))
        return 0
    earlier = store.committed(arguments.figures)
    figures = {} if arguments.quick else store.read(arguments.figures)
    started, done, failed = time.perf_counter(), [], {}
    with tempfile.TemporaryDirectory(prefix="benchmarks-") as scratch:
        for name in arguments.sections:
            context = Context(
                scenes=arguments.scenes,
                scratch=arguments.scratch or Path(scratch),
                runs=arguments.runs,
                quick=arguments.quick,
                large=arguments.large,
                native=arguments.native and arguments.native.resolve(),
            )
            print(f"{time.perf_counter() - started:6.0f} s  {name}", file=sys.stderr, flush=True)
            try:
                figures[name] = measured(name, context)
            except Exception as error:  # whatever it is, the other sections go on
                failed[name] = str(error) or type(error).__name__
                print(f"          {name} failed: {failed[name]}", file=sys.stderr, flush=True)
                continue
            done.append(name)
            if not arguments.quick:
                store.write(arguments.figures, figures)
                write_pages(arguments.docs, figures)
    if arguments.quick:
        print("\n".join(page(template(name), figures) for name in PAGES))
    _report(figures, {} if arguments.quick else earlier, done)
    print(f"\n{len(done)} sections in {time.perf_counter() - started:.0f} s")
    for name, error in failed.items():
        print(f"{name} failed: {error}")
    return 1 if failed else 0


def measured(name: str, context: Context) -> Measured:
    """Measures a section in a process of its own, so that its memory and its crashes are its own, too."""
    start, busy, before = time.perf_counter(), load(), calibrate()
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        rows, notes = pool.submit(section_rows, name, context).result()
    date, after = datetime.now(timezone.utc).date().isoformat(), calibrate()
    found = Measured(date, whole_machine(), busy, time.perf_counter() - start, before, after, rows, notes)
    return Measured.of_json(found.as_json())  # rounded as in the file, so that the page is what the file gives


def section_rows(name: str, context: Context) -> tuple[list[Row], list[str]]:
    """The rows of a section, and what it left out."""
    return BY_NAME[name].rows(context), context.notes


def _report(figures: Figures, earlier: Figures, done: list[str]) -> None:
    """Prints goals that were missed, and where figures fell behind."""
    print("\nGoals missed:")
    for goal in GOALS:
        if goal.section in done and (verdict := judged(goal, figures)).met is False:
            print(f"  {goal.group}: {goal.text}: {verdict.text}")
    print("\nBehind the last committed figures by more than noise:")
    for name in done:
        if name in earlier:
            for each in behind(BY_NAME[name].shown(), earlier[name], figures[name]):
                print(f"  {name}: {each}")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [section.name for section in SECTIONS]
    parser.add_argument(
        "--sections", nargs="+", choices=names, default=names, help="sections to measure (default: all)"
    )
    parser.add_argument("--runs", type=int, help="number of runs of each measurement (default: as many as suit it)")
    parser.add_argument("--quick", action="store_true", help="small scenes, one run; print the pages, write no file")
    parser.add_argument("--write-page", action="store_true", help="only make the pages of the figures, measure nothing")
    parser.add_argument("--large", action="store_true", help="also scenes of 10 to 20 million splats")
    parser.add_argument("--scenes", type=Path, default=SCENES, help="folder of real scenes (default: SPARKLOD_SCENES)")
    parser.add_argument("--native", type=Path, help="Spark's native build-lod; left out without")
    parser.add_argument("--scratch", type=Path, help="folder whose tiled scenes are kept (default: a temporary one)")
    parser.add_argument("--figures", type=Path, default=FIGURES, help="file of the figures (default: figures.json)")
    parser.add_argument("--docs", type=Path, default=DOCS, help="folder of the pages (default: docs)")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
