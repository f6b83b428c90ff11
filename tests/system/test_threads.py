"""The number of threads, and ranges of rows that are processed on them."""

from __future__ import annotations

import os
import threading
import time
import warnings
from collections import Counter

import numpy as np
import pytest

from sparklod_cli.system import threads as threads_module
from sparklod_cli.system.threads import (
    PARALLEL_ROWS,
    most_threads,
    on_threads,
    processors,
    run_ranges,
    threads_for,
    threads_in_use,
)


@pytest.fixture
def four(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four threads, however many processors there are."""
    monkeypatch.setenv("NUMBA_NUM_THREADS", "4")
    monkeypatch.setattr(threads_module, "_pool", None)


def test_small_work_runs_on_one_thread_and_large_on_all() -> None:
    before = threads_in_use()
    with threads_for(PARALLEL_ROWS - 1) as threads:
        assert threads == threads_in_use() == 1
        with threads_for(10 * PARALLEL_ROWS) as inner:
            assert inner == 1
    with threads_for(PARALLEL_ROWS) as threads:
        assert threads == before
    with pytest.raises(KeyError), threads_for(1):
        raise KeyError
    assert threads_in_use() == before


@pytest.mark.parametrize(("given", "most"), [("3", 3), ("", processors()), ("many", processors()), ("0", 1)])
def test_numbas_variable_limits_the_threads(given: str, most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", given)
    assert most_threads() == threads_in_use() == most
    with on_threads(1000):
        assert threads_in_use() == most


def test_the_number_of_threads_is_that_of_a_thread(four: None) -> None:
    seen = list[int]()
    with on_threads(2):
        other = threading.Thread(target=lambda: seen.append(threads_in_use()))
        other.start()
        other.join()
        assert (threads_in_use(), seen) == (2, [4])
    with pytest.raises(ValueError, match="give 1 or more"), on_threads(0):
        pass


@pytest.mark.parametrize("rows", [0, 1, 3, 1000, 100_003])
@pytest.mark.parametrize("threads", [1, 4])
def test_every_row_is_in_one_range(rows: int, threads: int, four: None) -> None:
    seen = Counter[int]()
    lock = threading.Lock()

    def work(start: int, stop: int, shift: int) -> None:
        with lock:
            seen.update(range(start + shift, stop + shift))

    with on_threads(threads):
        run_ranges(work, rows, 7)
    assert seen == Counter(range(7, rows + 7))


def test_ranges_run_at_once(four: None) -> None:
    """Each of four waits for the three others."""
    together = threading.Barrier(4, timeout=60)
    run_ranges(lambda start, stop: together.wait() and None, 4)


def test_many_threads_may_run_ranges_at_once(four: None) -> None:
    sums = np.zeros(20)

    def add(k: int) -> None:
        def work(start: int, stop: int) -> None:
            parts.append(sum(range(start, stop)))

        for _ in range(20):
            parts = list[int]()
            run_ranges(work, 1000)
            sums[k] += sum(parts)

    callers = [threading.Thread(target=add, args=(k,)) for k in range(20)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert (sums == 20 * 499_500).all()


def test_ranges_may_run_ranges(four: None) -> None:
    """The threads that would help may all be waiting for others; then the caller does it all."""
    done = list[int]()
    run_ranges(lambda start, stop: run_ranges(lambda first, last: done.extend(range(first, last)), 50), 4)
    assert Counter(done) == Counter(list(range(50)) * 4)


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_error_is_raised_when_no_range_runs_any_more(error: type[BaseException], four: None) -> None:
    running, begun = Counter[str](), list[int]()

    def work(start: int, stop: int) -> None:
        begun.append(start)
        running["now"] += 1
        try:
            if threading.current_thread() is caller:
                raise error("of the caller")
            time.sleep(0.05)
        finally:
            running["now"] -= 1

    caller = threading.current_thread()
    with pytest.raises(error, match="of the caller"):
        run_ranges(work, 1_000_000)
    assert running["now"] == 0
    assert len(begun) <= 8  # a range or two of each thread


def test_an_error_of_a_helper_is_raised(four: None) -> None:
    together = threading.Barrier(4, timeout=60)

    def work(start: int, stop: int) -> None:
        together.wait()
        if threading.current_thread() is not caller:
            raise ValueError("of a helper")

    caller = threading.current_thread()
    with pytest.raises(ValueError, match="of a helper"):
        run_ranges(work, 4)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no forks here")
def test_a_forked_process_has_threads_of_its_own(four: None) -> None:
    together = threading.Barrier(4, timeout=60)
    run_ranges(lambda start, stop: together.wait() and None, 4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 advises against forks
        child = os.fork()
    if not child:
        again = threading.Barrier(4, timeout=60)
        run_ranges(lambda start, stop: again.wait() and None, 4)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
