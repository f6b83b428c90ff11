"""Fits the merged splats of a finished tree to pictures of full detail: begin with `fit.fit`.

`fit_settings` has the settings and the report. Imports nothing heavy: `--help` reads the constants below.
"""

from ..render import DEVICE_HELP
from ..system.setting_fields import whole

#: Ranges of numbers of steps, the largest far beyond use and hours of work, and of seeds.
STEPS, SEED = whole(1, 1_000_000), whole(0, (1 << 32) - 1)

#: Help of the options of fitting.
SEED_HELP, FIT_DEVICE_HELP = (
    "Seed of the cameras and budgets that --refine draws at random.",
    DEVICE_HELP.format("--refine"),
)
