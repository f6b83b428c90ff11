"""Where tests of kernels for NVIDIA cards run: on a card, or in numba's simulator, see `tests.test_on_cards`."""

from __future__ import annotations

import os
import shutil

import pytest

from sparklod_cli.system.errors import BackendError

#: The variable that has numba simulate a card, which it reads when it is loaded.
SIMULATE = "NUMBA_ENABLE_CUDASIM"


def _why_not() -> str:
    """Why kernels cannot run in this process; empty if they can."""
    if os.environ.get(SIMULATE) != "1" and not shutil.which("nvidia-smi"):
        return "there is no NVIDIA card"
    from sparklod_cli.render.cuda.card import find_card

    try:
        find_card()
    except BackendError as error:
        return str(error)
    return ""


#: Why kernels cannot run in this process; empty if they can.
MISSING = _why_not()

#: Marks of modules whose tests run kernels on a card.
MARKS = [pytest.mark.cuda, pytest.mark.skipif(bool(MISSING), reason=MISSING)]
