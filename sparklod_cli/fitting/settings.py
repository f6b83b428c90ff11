"""Settings of fitting a tree, and its report. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..cameras.path import CameraPath

#: The most steps that can be asked for, far more than pay, and hours of work; and the largest seed.
MOST_STEPS, MOST_SEED = 1_000_000, (1 << 32) - 1

#: Shares of the leaves at which trees are judged.
SHARES = (0.02, 0.05, 0.1, 0.25, 0.5)


@dataclass(frozen=True)
class FitSettings:
    """Settings of fitting the merged splats of a tree.

    Attributes:
        steps: pictures of cuts that are drawn and compared; None for a number that suits the size of the tree.
        seed: of the cameras and budgets that are drawn at random; 0 or more.
        path: training cameras; None for cameras that are placed around and inside the scene.
    """

    steps: int | None = None
    seed: int = 0
    path: CameraPath | None = None


@dataclass(frozen=True)
class FitStage:
    """Result of a stage.

    Attributes:
        name: for display.
        steps: that were done.
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
        steps: that were done.
        stages: those that were finished, in order.
        psnr_before, psnr_after: share of the leaves -> mean PSNR in dB of the held-out cameras.
        kept: share of the merged splats that have new values.
        is_complete: False if it was interrupted.
    """

    steps: int
    stages: tuple[FitStage, ...]
    psnr_before: Mapping[float, float]
    psnr_after: Mapping[float, float]
    kept: float
    is_complete: bool = True
