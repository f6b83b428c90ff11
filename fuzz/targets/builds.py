"""Bakes scenes of extreme values with both builders and all encodings; the output must pass `inspect --check`."""

from __future__ import annotations

import re
from pathlib import Path

from sparklod_cli.lod.tree_settings import MAX_BASE, MAX_GROWTH, METHODS, MIN_BASE, MIN_GROWTH

from .. import laws, scenes
from ..case import Case, LawError, Rng
from ..command import command
from ..mutate import pick


def make(rng: Rng) -> Case:
    """Makes a scene and the options to bake it with."""
    columns = scenes.extreme(rng)
    file, data = (
        ("scene.splat", scenes.splat_of(columns)) if rng.integers(4) == 0 else ("scene.ply", scenes.ply_of(columns))
    )
    method = pick(rng, METHODS)
    options = ["--method", method, "--on-invalid", pick(rng, ("error", "drop")), "--threads", str(pick(rng, (1, 2)))]
    if rng.integers(3) == 0:
        low, high, name = (MIN_BASE, MAX_BASE, "--base") if method == "quick" else (MIN_GROWTH, MAX_GROWTH, "--growth")
        options += [name, str(pick(rng, (low, high)))]
    options += ["--spz-version", pick(rng, ("2", "3"))]
    if rng.integers(3) == 0:
        options += ["--fractional-bits", str(int(pick(rng, (0, 1, 8, 12, 16, 20, 23, 24))))]
    what = f"{len(columns['center'])} splats, {' '.join(options)}"
    return Case(what, {file: data}, {"file": file, "output": "baked.spz", "options": options})


def check(case: Case, folder: Path) -> None:
    """Bakes; if that succeeds, the output passes `inspect --check --leaves-of` without a warning about its tree."""
    file, output = case.run["file"], folder / case.run["output"]
    done = command(["build-lod", file, "-o", output.name, *case.run["options"]])
    if done.code:
        if output.exists():
            raise LawError(f"exit code {done.code}, but the output was written")
        return
    laws.check_output(output)
    if output.suffix == ".spz":
        checked = command(["inspect", output.name, "--check", "--leaves-of", file])
        said = checked.out.decode(errors="replace")
        found = re.search(r"(error|warning): (tree\.[\w-]+):", said)
        if "-clamped:" in said and not checked.code:
            found = None  # SPZ clamped the sizes that the builder chose, which explains warnings about the tree
        if checked.code or found:
            findings = checked.out.decode(errors="replace") + checked.err
            lines = findings.splitlines() or ["nothing"]
            first = next((line for line in lines if "error:" in line), lines[0])
            code = found or re.search(r"(error|warning): ([\w.-]+):", first)
            first = next((line for line in lines if code and code[0] in line), first)
            text = f"our own check of our own bake: {first}\n{case.what}\n{findings}"
            raise LawError(text, f"a bake fails its check: {code[2] if code else first}")
