"""Settings of fitting a tree. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..render import DEVICES
from ..system.setting_fields import CheckedSettings, setting
from . import FIT_DEVICE_HELP, SEED, SEED_HELP, STEPS

if TYPE_CHECKING:
    from ..cameras.sources import CameraPath

#: Sizes of the cuts by which trees are scored, as shares of the leaves.
SHARES = (0.02, 0.05, 0.1, 0.25, 0.5)


@dataclass(frozen=True)
class FitSettings(CheckedSettings):
    """Settings of fitting the merged splats of a tree.

    Attributes:
        path: training cameras; None for random cameras around and inside the scene.
    """

    steps: int | None = setting(
        "Pictures of cuts that are drawn and compared; None for a number that suits the size of the tree.", STEPS
    )
    seed: int = setting(SEED_HELP, SEED, 0)
    path: CameraPath | None = None
    device: str = setting(FIT_DEVICE_HELP, DEVICES, "cpu")


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
class Refined:
    """Result of fitting merged splats, as reported by `--json`.

    Attributes:
        psnr_before, psnr_after: share of the leaves -> mean PSNR in dB of the held-out cameras.
        kept: share of the splats fitted that have new values.
        is_complete: False if it was interrupted.
        seed: of the cameras and budgets drawn at random.
    """

    steps: int
    stages: tuple[FitStage, ...]
    psnr_before: Mapping[float, float]
    psnr_after: Mapping[float, float]
    kept: float
    is_complete: bool = True
    seed: int = 0
    seconds: float = 0.0
