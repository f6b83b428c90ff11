"""Measures all tables of docs/fidelity*.md and docs/refine-measured.md, and draws their pictures: two hours.

SPARK_DIR=... ENGINES_DIR=... NANOGS_DIR=... python benchmarks/run_fidelity.py folder-of-scenes --json folder
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from fidelity_report import THIN_SCENES

HERE = Path(__file__).parent
DOCS = HERE.parent / "docs"

#: Real scenes of the table of refining.
REFINED = ("biker.ply", "playbot-125k.ply", "meadow.sog")


def run(program: str, *arguments: str | Path) -> None:
    """Run one benchmark.

    Raises:
        CalledProcessError: it failed.
    """
    subprocess.run([sys.executable, HERE / program, *arguments], check=True)


def main() -> None:
    """Run the benchmarks one after another."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, help="the folder of the real scenes")
    parser.add_argument("--json", type=Path, required=True, help="folder for the figures of each camera")
    arguments = parser.parse_args()
    arguments.json.mkdir(parents=True, exist_ok=True)
    builders, refined, blocks, simplify = (
        arguments.json / f"{name}.json" for name in ("builders", "refined", "blocks", "simplify")
    )
    real, sets = ["biker.ply", "meadow.sog"], ["photo-cloud", "loose-cloud"]
    run("bench_simplify.py", *(arguments.scenes / name for name in real), *sets, "--json", simplify, "--docs", DOCS)
    spark = ["--methods", "spark-tiny", "spark-quality", "quick", "quality"]
    cameras = ["--cameras", "around", "near", "inside", "above", "--popping", "--sh"]
    made = ["glossy-knot", *THIN_SCENES]
    run("bench_fidelity.py", arguments.scenes, *made, *spark, *cameras, "--json", builders)
    run(
        "bench_fidelity.py", arguments.scenes, "fine-structure", "single-floor", "--methods", "blocks", "--json", blocks
    )
    few = [*(arguments.scenes / name for name in REFINED), "fine-structure"]
    run("bench_fidelity.py", *few, "--methods", "refined", "--cameras", "around", "inside", "--json", refined)
    run("fidelity_report.py", builders, blocks, refined, "--docs", DOCS, "--plot", DOCS / "images" / "fidelity.png")
    rounded = ["biker.ply", "playbot-125k.ply", "meadow.sog", "playbot.sog"]
    run("bench_rad_rounding.py", *(arguments.scenes / name for name in rounded), "--docs", DOCS)
    pictured = ["--methods", "spark-quality", "quick", "quality"]
    run("fidelity_pictures.py", "fine-structure", DOCS / "images" / "fine-structure.webp", *pictured)


if __name__ == "__main__":
    main()
