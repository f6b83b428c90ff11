"""A stand-in for the fitting of merged splats, which takes no time and says what it was given."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from sparklod_cli.fitting import fit as fitting
from sparklod_cli.fitting.fit_settings import SHARES, FitSettings, FitStage, Refined
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.splats import COLUMNS, Splats

#: Steps where nobody says how many.
STEPS = 40

BEFORE, AFTER = dict.fromkeys(SHARES, 30.0), dict.fromkeys(SHARES, 32.5)


def changed(nodes: Splats, tree: LodTree, seed: int = 0) -> Splats:
    """Nodes of which all inner ones but each fifth have other values, which are valid."""
    rng = np.random.default_rng(seed)
    inner = np.flatnonzero(~tree.is_leaf)
    some = inner[np.arange(len(inner)) % 5 != 4]
    columns = {name: getattr(nodes, name).copy() for name in COLUMNS}
    count = len(some)
    columns["center"][some] += 0.3 * columns["scale"][some] * rng.normal(size=(count, 3)).astype(np.float32)
    columns["scale"][some] *= np.exp(rng.normal(0, 0.1, (count, 3))).astype(np.float32)
    quat = columns["quat_xyzw"][some] + rng.normal(0, 0.1, (count, 4))
    columns["quat_xyzw"][some] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    columns["opacity"][some] = np.clip(columns["opacity"][some] * rng.uniform(0.8, 1.2, count), 1e-6, 1000)
    columns["rgb"][some] += rng.normal(0, 0.05, (count, 3)).astype(np.float32)
    columns["sh"][some] += rng.normal(0, 0.05, columns["sh"][some].shape).astype(np.float32)
    return Splats(**columns)


@dataclass
class StandIn:
    """Stands in for `fitting.fit.fit`.

    Attributes:
        calls: what it was given: the settings, and what was given by name.
        is_complete: of its reports.
        kept: share of the merged splats that it reports.
    """

    calls: list[tuple[FitSettings, dict[str, Any]]] = field(default_factory=list)
    is_complete: bool = True
    kept: float = 0.8

    def __call__(
        self, nodes: Splats, tree: LodTree, settings: FitSettings, *, say: Callable[[str], None], **how: Any
    ) -> tuple[Splats, Refined]:
        """Changes merged splats."""
        self.calls.append((settings, how))
        steps = settings.steps or STEPS
        how["progress"]("refining", steps, steps, "step")
        say("fit 1 of 1: 2 % 30.0 -> 32.5 dB")
        stages = (FitStage("colours", steps, BEFORE, AFTER),)
        report = Refined(steps, stages, BEFORE, AFTER, self.kept, self.is_complete, settings.seed)
        return changed(nodes, tree, settings.seed) if self.kept else nodes, report


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> StandIn:
    """The fitting of this test."""
    found = StandIn()
    monkeypatch.setattr(fitting, "fit", found)
    return found
