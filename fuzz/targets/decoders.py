"""Splat files of every format, changed outside and inside of their compression, through the readers and the report."""

from __future__ import annotations

from pathlib import Path

from sparklod_cli.io import examine_scene, read_scene

from .. import laws
from ..case import Case, Rng
from ..containers import folder_seed, good, mutated_part, mutated_scene, seeds
from ..mutate import pick

THREADS = (1, 2)


def make(rng: Rng) -> Case:
    """One of the seeds after some changes; one in thirty is an unpacked SOG."""
    threads = pick(rng, THREADS)
    if rng.integers(30) == 0:
        files = folder_seed()
        name = pick(rng, list(files))
        files[name] = mutated_part(rng, name, files[name])
        return Case(f"sh1-sog, {name}", files, {"path": pick(rng, (".", "meta.json")), "threads": threads})
    name = pick(rng, good() if rng.integers(5) else list(seeds()))
    other = pick(rng, list(seeds()))
    how, data = mutated_scene(rng, seeds()[name], seeds()[other])
    # The suffix decides where the content can be anything.
    file = f"scene{Path(name).suffix}"
    return Case(f"{name}, {how}", {file: data}, {"path": file, "threads": threads})


def check(case: Case, folder: Path) -> None:
    """There is a report of it; the readers give a scene that can be drawn, or an error."""
    path, threads = Path(case.run["path"]), case.run["threads"]
    laws.report_holds(path)
    examine_scene(path, columns=("center", "scale"), threads=threads)
    laws.scene_holds(read_scene(path, threads=threads))
