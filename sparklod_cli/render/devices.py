"""Devices that draw and fit: the processor, or an NVIDIA card. Imports nothing heavy."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable

from ..system.errors import BackendError

#: Devices that can be requested: a card if there is one; the processor; a card.
DEVICES = ("auto", "cpu", "cuda")

#: Help of a setting of one of them; {} is what computes on it.
DEVICE_HELP = (
    "What {} computes with: an NVIDIA card if there is one (auto), the processor, or a card (cuda). Cards are tested in"
    " a simulator only."
)


def uses_card(device: str, say: Callable[[str], None] = lambda text: None) -> bool:
    """Return True if a card is used for one of `DEVICES`; say so, or why not, in a line.

    "auto" does without a word where the extra is not installed.

    Raises:
        BackendError: a card is requested, and none is usable.
    """
    if device == "cpu" or (device == "auto" and importlib.util.find_spec("numba_cuda") is None):
        return False
    from .cuda.card import find_card  # loads numba

    try:
        card = find_card()
    except BackendError as error:
        if device == "cuda":
            raise
        say(f"uses the processor: {error}")
        return False
    slowly = "; sorts on the processor, which is slow, as cupy is not installed" if card.sorter == "numpy" else ""
    say(f"uses the card {card}{slowly}")
    return True
