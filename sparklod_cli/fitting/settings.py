"""Settings of fitting a tree. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..render.devices import DEVICE_HELP, DEVICES
from ..system.setting_fields import CheckedSettings, setting, whole

if TYPE_CHECKING:
    from ..cameras.sources import CameraPath

#: Numbers of steps, up to far more than pay, and hours of work; and seeds.
STEPS, SEED = whole(1, 1_000_000), whole(0, (1 << 32) - 1)

#: Shares of the leaves at which trees are judged.
SHARES = (0.02, 0.05, 0.1, 0.25, 0.5)


@dataclass(frozen=True)
class FitSettings(CheckedSettings):
    """Settings of fitting the merged splats of a tree.

    Attributes:
        path: training cameras; None for cameras that are placed around and inside the scene.
    """

    steps: int | None = setting(
        "Pictures of cuts that are drawn and compared; None for a number that suits the size of the tree.", STEPS
    )
    seed: int = setting("Seed of the cameras and budgets that --refine draws at random.", SEED, 0, needs="refine")
    path: CameraPath | None = None
    device: str = setting(DEVICE_HELP.format("--refine"), DEVICES, "cpu", needs="refine")
