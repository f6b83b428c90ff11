"""How kernels are compiled and run."""

from __future__ import annotations

import numba
import pytest
from numba.core.dispatcher import Dispatcher

from sparklod_cli import jit


def add(a: float, b: float) -> float:
    return a + b


def test_a_kernel_works_where_no_cache_can_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Dispatcher) -> None:
        raise RuntimeError("cannot cache function 'add': no locator available for file")

    monkeypatch.setattr(Dispatcher, "enable_caching", refuse)
    assert jit.kernel()(add)(1.0, 2.0) == 3


def test_the_first_compilation_is_told_and_only_that() -> None:
    told = []
    jit.on_first_compile(lambda: told.append(True))
    numba.njit(lambda x: x + 1)(1)
    numba.njit(lambda x: x + 2)(1)
    assert told == [True]


def test_small_work_runs_on_one_thread_and_large_on_all() -> None:
    before = numba.get_num_threads()
    with jit.threads_for(jit.SMALL - 1) as threads:
        assert threads == numba.get_num_threads() == 1
        with jit.threads_for(10 * jit.SMALL) as inner:
            assert inner == 1
    with jit.threads_for(jit.SMALL) as threads:
        assert threads == before
    with pytest.raises(KeyError), jit.threads_for(1):
        raise KeyError
    assert numba.get_num_threads() == before
