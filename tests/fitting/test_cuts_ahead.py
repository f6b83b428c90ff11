"""Cuts that are found ahead depend on the steps taken, not on when threads find them."""

from __future__ import annotations

import threading
from typing import Any

import pytest

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.fitting import fit as fit_module
from sparklod_cli.fitting.fit import AHEAD, fit
from sparklod_cli.fitting.pictures import FittedNodes, Index, Optimiser
from sparklod_cli.fitting.settings import FitSettings
from sparklod_cli.lod import quality
from tests.scenes import random_splats

#: Stages, and their steps: the last group is half of one.
STAGES, STEPS = 2, 2 * AHEAD + AHEAD // 2


class CountingOptimiser(Optimiser):
    """An optimiser that counts its steps, and those that the nodes of cuts have seen."""

    taken = placed = 0

    def step(self, *arguments: Any) -> None:
        super().step(*arguments)
        self.taken += 1

    def place(self) -> None:
        super().place()
        self.placed = self.taken


class RecordedNodes(FittedNodes):
    """Nodes that record after how many steps the cuts of steps are found."""

    def cut(self, camera: Camera, share: float) -> Index:
        if threading.current_thread() is not threading.main_thread():  # which scores the nodes
            self.found_after.append(self.optimiser.placed)
        return super().cut(camera, share)

    found_after: list[int]
    optimiser: CountingOptimiser


@pytest.mark.parametrize("threads", [1, 3])
def test_cuts_are_found_before_the_steps_of_the_group_before(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[RecordedNodes] = []

    def optimiser_on(device: str, nodes: RecordedNodes, say: object) -> Optimiser:
        nodes.found_after, nodes.optimiser = [], CountingOptimiser(nodes)
        made.append(nodes)
        return nodes.optimiser

    monkeypatch.setattr("sparklod_cli.fitting.pictures.SIZE", (64, 36))
    monkeypatch.setattr(fit_module, "STAGES", STAGES)
    monkeypatch.setattr(fit_module, "TRAINING", 4)
    monkeypatch.setattr(fit_module, "HELD_OUT", 2)
    monkeypatch.setattr(fit_module, "FittedNodes", RecordedNodes)
    monkeypatch.setattr(fit_module, "_optimiser_on", optimiser_on)
    monkeypatch.setattr(fit_module, "FLAT", -1.0)  # no stage is left out
    fit(*quality.build(random_splats(300, sh_degree=0)), FitSettings(steps=STAGES * STEPS), threads=threads)
    expected = [0] * 2 * AHEAD + [AHEAD] * (STEPS - 2 * AHEAD)
    found = made[0].found_after
    assert found == [stage * STEPS + steps for stage in range(STAGES) for steps in expected]
    assert made[0].optimiser.placed == STAGES * STEPS
