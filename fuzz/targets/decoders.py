"""Splat files of every format, changed as they are or under their compression, for the readers and the report."""

from __future__ import annotations

from pathlib import Path

from sparklod_cli.io.reading import read_scene

from .. import laws
from ..case import Case, Rng
from ..containers import FOLDERS, folder_seed, mutated_part, mutated_scene, seeds, valid_seeds
from ..mutate import pick

THREADS = (1, 2)


def make(rng: Rng) -> Case:
    """Changes one of the seeds; one case in twenty is a folder of files that belong together."""
    threads = pick(rng, THREADS)
    if rng.integers(20) == 0:
        folder = pick(rng, list(FOLDERS))
        files = folder_seed(folder)
        name = pick(rng, list(files) if rng.integers(2) else [FOLDERS[folder][-1]])
        if Path(name).suffix in (".rad", ".radc"):
            files[name] = mutated_scene(rng, files[name], files[pick(rng, list(files))])[1]
        else:
            files[name] = mutated_part(rng, name, files[name])
        return Case(f"{folder}, {name}", files, {"path": pick(rng, FOLDERS[folder]), "threads": threads})
    name = pick(rng, valid_seeds() if rng.integers(5) else list(seeds()))
    other = pick(rng, list(seeds()))
    changed, data = mutated_scene(rng, seeds()[name], seeds()[other])
    # Keep the suffix: it decides the format of files whose content does not tell.
    file = f"scene{Path(name).suffix}"
    return Case(f"{name}, {changed}", {file: data}, {"path": file, "threads": threads})


def check(case: Case, folder: Path) -> None:
    """The file has a report; the readers return a scene that can be drawn, or refuse it; a stream does the same."""
    path, threads = Path(case.run["path"]), case.run["threads"]
    laws.check_report(path)
    laws.check_stream(path, threads)
    if path.is_dir() or path.suffix == ".json":
        laws.check_levels(path, threads)
    read_scene(path, columns=("center", "scale"), threads=threads, validate=False)
    laws.check_scene(read_scene(path, threads=threads))
