"""Where the splats of Streamed SOG are: the chunk file of each run, and how many bytes the files have."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..codecs.streamed_sog.manifest import MAX_MANIFEST, parse
from ..io import companions, in_folder, opened
from ..lod.detail_loading import DetailFiles
from ..support.stdin import DASH


def has_levels(path: Path) -> bool:
    """Whether a file, or what a folder stands for, has a scene at several detail levels.

    Raises:
        FormatError: it cannot be read, or is of no known format.
    """
    if path == DASH:
        return False
    with opened(path) as (_, form, _):
        return form.detailed


def detail_files(path: Path) -> DetailFiles:
    """The chunk files of a manifest, or of the folder that holds it; all of it has been read before."""
    first = Path(in_folder(path)) if path.is_dir() else path
    manifest = parse(first.read_bytes()[: MAX_MANIFEST + 1])
    sizes: dict[Path, int] = {}
    for file in companions(first, ()):
        sizes[file.parent] = sizes.get(file.parent, 0) + file.stat().st_size
    names = manifest.names()
    regions = [node.runs or {} for _, node in manifest.regions()]
    of_run = np.array(
        [
            [runs[level].file if level in runs and runs[level].count else -1 for level in range(manifest.levels)]
            for runs in regions
        ],
        np.int64,
    )
    return DetailFiles(
        of_run.reshape(-1, manifest.levels),
        np.array([sizes.get((first.parent / name).parent, 0) for name in names], np.int64),
        None if manifest.environment is None else len(names) - 1,
        first.stat().st_size,
    )
