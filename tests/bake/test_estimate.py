"""Blocks are as large as the memory allows, and nearly the same memory gives the same ones."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.bake import estimate
from sparklod_cli.bake.settings import BakeSettings
from sparklod_cli.fitting.settings import FitSettings
from sparklod_cli.lod.tree_settings import METHODS, bytes_of
from sparklod_cli.model import MAX_SH_DEGREE
from sparklod_cli.system import machine
from sparklod_cli.system.errors import OutOfMemoryError

CASES = (st.sampled_from(METHODS), st.integers(1, 10**9), st.integers(0, MAX_SH_DEGREE))


@given(*CASES, st.integers(0, 1 << 40))
def test_a_block_is_the_largest_power_of_two_that_fits(method: str, splats: int, degree: int, memory: int) -> None:
    least = estimate.out_of_core_bytes(method, splats, degree, estimate.LEAST_BLOCK_SPLATS)
    if memory < least:
        with pytest.raises(OutOfMemoryError, match="too little even out of core"):
            estimate.block_splats_within(memory, method, splats, degree)
        memory = least
    size = estimate.block_splats_within(memory, method, splats, degree)
    assert size & (size - 1) == 0
    assert estimate.LEAST_BLOCK_SPLATS <= size <= estimate.MOST_BLOCK_SPLATS
    assert estimate.out_of_core_bytes(method, splats, degree, size) <= memory
    if size < estimate.MOST_BLOCK_SPLATS:
        assert estimate.out_of_core_bytes(method, splats, degree, 2 * size) > memory


@given(*CASES)
def test_more_splats_and_more_coefficients_take_more(method: str, splats: int, degree: int) -> None:
    for of, what in ((estimate.in_memory_bytes, BakeSettings(method)), (estimate.scratch_bytes, method)):
        assert of(what, splats, degree) <= of(what, splats + 1, degree)
        assert of(what, splats, degree) <= of(what, splats, MAX_SH_DEGREE)
    assert estimate.block_splats_within(None, method, splats, degree) == estimate.MOST_BLOCK_SPLATS


@given(*CASES, st.booleans())
def test_the_most_splats_in_memory_fill_it(method: str, splats: int, degree: int, refines: bool) -> None:
    settings = BakeSettings(method, refine=FitSettings() if refines else None)
    memory = estimate.in_memory_bytes(settings, splats, degree)
    assert estimate.most_in_memory(memory, settings, degree) == splats
    assert estimate.most_in_memory(memory - 1, settings, degree) == splats - 1


@given(st.integers(0, 10**9), st.integers(0, MAX_SH_DEGREE), st.integers(0, 1 << 40), st.integers(1, 64))
def test_windows_that_are_encoded_together_fit(splats: int, degree: int, memory: int, threads: int) -> None:
    windows = estimate.windows_within(memory, splats, degree, threads)
    window = bytes_of(estimate.OF_WINDOW, min(2 * splats, estimate.WINDOW), degree)
    assert 1 <= windows <= threads
    assert windows == 1 or estimate.PROCESS + windows * window <= memory


@pytest.mark.parametrize("method", METHODS)
def test_five_million_splats_are_baked_in_600_mb(method: str) -> None:
    estimate.block_splats_within(600_000_000, method, 5_000_000, 0, in_chunks=True, threads=2)


def test_by_default_a_bake_takes_a_share_of_what_is_available(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "available_memory", lambda: 8_000_000_000)
    assert estimate.default_memory() == 6_000_000_000
    monkeypatch.setattr(machine, "available_memory", lambda: None)
    assert estimate.default_memory() is None
