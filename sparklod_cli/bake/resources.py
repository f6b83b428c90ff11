"""`Resources`, what a bake may use."""

from __future__ import annotations

from dataclasses import dataclass

from ..support.addresses import Place


@dataclass(frozen=True)
class Resources:
    """What a bake may use.

    Attributes:
        memory: bytes that it may take; None for `estimate.MEMORY_SHARE` of what is available.
        scratch_dir: folder for the scratch folder of a bake out of core; None for that of the output.
        resume: go on with what an interrupted bake left there.
        block_splats: splats of a block, out of core; None for as many as the memory allows, at most
            `estimate.MOST_BLOCK_SPLATS`.
    """

    memory: int | None = None
    scratch_dir: Place | None = None
    resume: bool = False
    block_splats: int | None = None
