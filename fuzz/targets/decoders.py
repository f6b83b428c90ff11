"""Splat files of every format, changed as they are or under their compression, for the readers and the report."""

from __future__ import annotations

from pathlib import Path

from sparklod_cli.io import examine_scene, read_scene

from .. import laws
from ..case import Case, Rng
from ..containers import folder_seed, mutated_part, mutated_scene, seeds, valid_seeds
from ..mutate import pick

THREADS = (1, 2)


def make(rng: Rng) -> Case:
    """Changes one of the seeds; one case in thirty is an unpacked SOG."""
    threads = pick(rng, THREADS)
    if rng.integers(30) == 0:
        files = folder_seed()
        name = pick(rng, list(files))
        files[name] = mutated_part(rng, name, files[name])
        return Case(f"sh1-sog, {name}", files, {"path": pick(rng, (".", "meta.json")), "threads": threads})
    name = pick(rng, valid_seeds() if rng.integers(5) else list(seeds()))
    other = pick(rng, list(seeds()))
    changed, data = mutated_scene(rng, seeds()[name], seeds()[other])
    # Keep the suffix: it decides the format of files whose content does not tell.
    file = f"scene{Path(name).suffix}"
    return Case(f"{name}, {changed}", {file: data}, {"path": file, "threads": threads})


def check(case: Case, folder: Path) -> None:
    """The file has a report; the readers return a scene that can be drawn, or refuse it with an error."""
    path, threads = Path(case.run["path"]), case.run["threads"]
    laws.check_report(path)
    examine_scene(path, columns=("center", "scale"), threads=threads)
    laws.check_scene(read_scene(path, threads=threads))
