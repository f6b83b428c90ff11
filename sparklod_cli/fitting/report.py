"""Results of fitting a tree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class FitStage:
    """Result of a stage.

    Attributes:
        name: for display.
        psnr_before, psnr_after: share of the leaves -> mean PSNR in dB of the held-out cameras.
    """

    name: str
    steps: int
    psnr_before: Mapping[float, float]
    psnr_after: Mapping[float, float]


@dataclass(frozen=True)
class FitReport:
    """Result of fitting a tree.

    Attributes:
        psnr_before, psnr_after: share of the leaves -> mean PSNR in dB of the held-out cameras.
        kept: share of the splats fitted that have new values.
        is_complete: False if it was interrupted.
    """

    steps: int
    stages: tuple[FitStage, ...]
    psnr_before: Mapping[float, float]
    psnr_after: Mapping[float, float]
    kept: float
    is_complete: bool = True
