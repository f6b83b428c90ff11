"""A card that fails while splats are fitted, as an optimiser that does."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sparklod_cli.fitting import fit as fit_module
from sparklod_cli.fitting.fit import fit
from sparklod_cli.fitting.kernels.adam import Rates
from sparklod_cli.fitting.pictures import FittedNodes, FullDetailPicture, Index, Optimiser
from sparklod_cli.fitting.settings import FitSettings, Refined
from sparklod_cli.lod import quality
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.errors import BackendError
from tests.scenes import random_splats

STEPS, LAST = 40, 7

REASON = "the card has too little memory for 400 splats; about 200 fit"


class FailingOptimiser(Optimiser):
    """A card whose memory does not suffice for step number LAST."""

    taken = 0

    def step(self, picture: FullDetailPicture, index: Index, rates: Rates) -> None:
        self.taken += 1
        if self.taken == LAST:
            raise BackendError(REASON)
        super().step(picture, index, rates)


def optimiser_on(device: str, nodes: FittedNodes, say: Callable[[str], None]) -> Optimiser:
    return Optimiser(nodes) if device == "cpu" else FailingOptimiser(nodes)


def fitted(device: str, said: list[str]) -> tuple[Splats, Refined]:
    tree = quality.build(random_splats(400, sh_degree=0))
    return fit(*tree, FitSettings(steps=STEPS, device=device), say=said.append)


@pytest.fixture(autouse=True)
def failing_card(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparklod_cli.fitting.pictures.SIZE", (64, 36))
    monkeypatch.setattr(fit_module, "TRAINING", 4)
    monkeypatch.setattr(fit_module, "HELD_OUT", 2)
    monkeypatch.setattr(fit_module, "_optimiser_on", optimiser_on)


def test_auto_starts_again_on_the_processor_with_its_result() -> None:
    said: dict[str, list[str]] = {"auto": [], "cpu": []}
    (found, report), (reference, expected) = (fitted(device, lines) for device, lines in said.items())
    assert report == expected
    assert all(np.array_equal(getattr(found, name), getattr(reference, name)) for name in COLUMNS)
    line = f"starts again on the processor: {REASON}"
    assert line in said["auto"]
    assert said["auto"][said["auto"].index(line) + 1 :] == said["cpu"]


def test_a_card_that_was_asked_for_ends_with_its_line() -> None:
    with pytest.raises(BackendError, match=REASON):
        fitted("cuda", [])
