"""Checkpoints whose pickles run other programs than PyTorch writes, in zips of several of them."""

from __future__ import annotations

import io
import zipfile

from fixtures import by_hand_sog

from ..case import Case, Rng
from ..containers import mutated_part, seeds
from ..mutate import pick
from .decoders import check as check


def make(rng: Rng) -> Case:
    """Changes the pickle of a checkpoint, or in one case of eight another member; some zips have two checkpoints."""
    names = [name for name in seeds() if name.endswith((".pt", ".ckpt"))]
    name = pick(rng, names)
    parts = members(seeds()[name])
    what, kind = "pickle", int(rng.integers(8))
    if kind == 0:
        what = pick(rng, list(parts))
        parts[what] = mutated_part(rng, what, parts[what])
    else:
        pickle = next(each for each in parts if each.endswith("data.pkl"))
        parts[pickle] = mutated_part(rng, pickle, parts[pickle])
    if kind == 1:
        parts |= {f"other/{each}": data for each, data in members(seeds()[pick(rng, names)]).items()}
    file = f"scene{pick(rng, ('.pt', '.ckpt'))}"
    return Case(f"{name}, {what}", {file: by_hand_sog.zipped(parts)}, {"path": file, "threads": pick(rng, (1, 2))})


def members(data: bytes) -> dict[str, bytes]:
    """The members of a zip by their names."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}
