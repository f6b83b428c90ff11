"""Shares of the stages of a bake in its time, for one progress bar that tells the time left."""

from __future__ import annotations

from ..codecs.file_names import META, RAD_SUFFIX
from ..lod.builders import METHODS
from .settings import BakeSettings

#: Suffix of a SOG, which has a palette of spherical harmonics.
SOG = ".sog"


def stage_shares(settings: BakeSettings) -> dict[str, float]:
    """Return the stages of a bake, as its progress names them, in order, with the relative time of each.

    Estimates, from bakes of 500,000 splats on two threads. A stage that an input turns out not to need is passed over.
    """
    is_quick = settings.method == METHODS[0]
    is_file = settings.detail is None and settings.tiles is None
    has_chunks = is_file and settings.suffix == RAD_SUFFIX
    has_palette = is_file and (settings.options.rad.sh_codes is not None or settings.suffix in (SOG, META))
    rows = [
        ("reading", 1.0, True),
        ("building", 2.0 if is_quick else 5.0, True),
        ("pruning", 1.0, not is_quick),
        ("ordering", 1.0, not (is_quick and has_chunks)),
        ("simplifying", 10.0, settings.simplify is not None),
        ("refining", 100.0, settings.refine is not None),
        ("arranging", 2.0, has_chunks),
        ("dividing", 5.0, not is_file),
        ("errors", 10.0, settings.detail is not None),
        ("bisecting", 5.0, has_palette),
        ("clustering", 15.0, has_palette),
        ("encoding", 2.0, is_file),
        ("writing", 1.0 if has_chunks else 4.0, True),
    ]
    return {stage: share for stage, share, occurs in rows if occurs}
