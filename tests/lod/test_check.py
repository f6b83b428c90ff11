"""The fast test of what builders take agrees with the definition of a valid and visible splat."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.codecs.reader import check_valid, is_valid_and_visible
from sparklod_cli.model import selection
from sparklod_cli.model.splats import COLUMNS
from sparklod_cli.system.errors import InvalidSplatsError
from tests.lod.trees import hard_cases
from tests.scenes import random_splats

#: Numbers that some column must not have.
FAULTS = {
    **{f"{name} {value}": (name, value) for name in COLUMNS for value in (np.nan, np.inf, -np.inf)},
    "negative scale": ("scale", -1e-30),
    "negative opacity": ("opacity", -1e-30),
    "rotation": ("quat_xyzw", 1.1),
}


@pytest.mark.parametrize("name", hard_cases())
def test_splats_that_can_be_drawn_are_known_as_such(name: str) -> None:
    splats = hard_cases()[name]
    assert is_valid_and_visible(splats, 1) == (True, True)


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("place", [0, 35])
def test_one_fault_is_found(fault: str, place: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(selection, "EXAMINED", 32)
    splats = random_splats(40, sh_degree=1)
    name, value = FAULTS[fault]
    getattr(splats, name)[place] = value
    assert not is_valid_and_visible(splats, 2)[0]
    with pytest.raises(InvalidSplatsError, match=f"1 of 40 splats .* the first is splat {place}"):
        check_valid(splats, 2)


@pytest.mark.parametrize("column", ["opacity", "scale"])
def test_what_cannot_be_seen_is_valid(column: str) -> None:
    splats = random_splats(9)
    getattr(splats, column)[4] = 0
    assert is_valid_and_visible(splats, 1) == (True, False)
    check_valid(splats, 1)


def test_a_rotation_near_the_tolerance_is_left_to_the_definition() -> None:
    splats = random_splats(9)
    splats.quat_xyzw[3] *= np.float32(np.sqrt(1 + 0.8e-3))
    assert not is_valid_and_visible(splats, 1)[0]
    check_valid(splats, 1)
