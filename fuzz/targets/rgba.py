"""Colour files of `build-lod --rgba`: .npy files of all types, and raw bytes."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from sparklod_cli.io.files import read_rgba

from ..case import Case, LawError, Rng
from ..command import command
from ..containers import seeds
from ..mutate import FLOATS, WORDS, mutated, pick, text_mutated

COUNT = 60  # number of splats in sh0.ply

#: Types and shapes to try; (COUNT, 4) of bytes or floats is right.
KINDS = ("u1", "<f4", ">f4", "<f2", "<f8", "<i4", "<c8", "S4", "<U2", "?")
SHAPES = ((COUNT, 4), (COUNT, 4), (COUNT, 4), (4, COUNT), (COUNT, 3), (COUNT * 4,), (0, 4), (COUNT, 4, 1), ())


def make(rng: Rng) -> Case:
    """Makes an array of any type and shape, writes it with or without a header, and changes some of the files."""
    with np.errstate(all="ignore"):
        values = (rng.random(pick(rng, SHAPES)) * 1.2 - 0.1).astype(pick(rng, KINDS))
    if values.dtype.kind == "f" and values.size and rng.integers(3) == 0:
        with np.errstate(all="ignore"):
            values.reshape(-1)[int(rng.integers(values.size))] = pick(rng, FLOATS)
    file = io.BytesIO()
    if rng.integers(4):
        np.save(file, values)
    else:
        file.write(values.tobytes())
    data = file.getvalue()
    kind = int(rng.integers(4))
    if kind == 1:
        data = mutated(rng, data, header=128)
    elif kind == 2 and data[:6] == b"\x93NUMPY":
        header = text_mutated(rng, data[10:128].decode("latin-1")) + pick(rng, (*WORDS[:12], ""))
        packed = header.encode("latin-1", "replace")[:60_000]
        data = data[:8] + len(packed).to_bytes(2, "little") + packed + data[128:]
    what = f"{values.dtype}{list(values.shape)}"
    return Case(what, {"colors.npy": data, "scene.ply": seeds()["sh0.ply"]}, {"command": int(rng.integers(20)) == 0})


def check(case: Case, folder: Path) -> None:
    """The file is read as colours between 0 and 1, or refused with an error."""
    if case.run["command"]:
        command(["build-lod", "scene.ply", "--rgba", "colors.npy", "-o", "out.spz"])
        return
    rgba = read_rgba(Path("colors.npy"), COUNT)
    if rgba.shape != (COUNT, 4) or not ((rgba >= 0) & (rgba <= 1)).all():
        raise LawError(f"values that are not colours: {rgba.dtype}{list(rgba.shape)}")
