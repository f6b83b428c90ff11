"""Memory, processors, threads and files on this machine, in containers, and on systems that lack what Linux has."""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
import threading
import time
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.system import machine, threads
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
from tests.conftest import FIXTURES, ROOT

GB = 10**9
MEMINFO = f"MemTotal: {16 * GB // 1024} kB\nMemFree: 1 kB\nMemAvailable: {8 * GB // 1024} kB\n"
V2 = "0::/user/job\n"
V1 = "5:memory:/job\n4:cpu,cpuacct:/job\n0::/\n"


def pretend(monkeypatch: pytest.MonkeyPatch, files: dict[str, str]) -> None:
    known = {Path(name): text.strip() for name, text in files.items()}
    monkeypatch.setattr(machine, "_text", lambda path: known.get(path, ""))


def test_memory_and_quota_of_this_machine_are_plausible() -> None:
    total, available, quota = machine.total_memory(), machine.available_memory(), machine.processor_quota()
    assert total is None or total > 0
    assert available is None or total is None or 0 <= available <= total
    assert quota is None or quota > 0


CGROUP = "/sys/fs/cgroup"


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({f"{CGROUP}/memory.max": "max"}, (16 * GB, 8 * GB, None)),
        *(
            (  # the smallest limit of any group above counts
                {
                    "/proc/self/cgroup": V2,
                    f"{CGROUP}/user/job/memory.max": str(15 * GB),
                    f"{CGROUP}{group}/memory.max": str(4 * GB),
                    f"{CGROUP}{group}/memory.current": str(GB),
                    f"{CGROUP}{group}/cpu.max": "150000 100000",
                },
                (4 * GB, 3 * GB, 1.5),
            )
            for group in ("", "/user", "/user/job")
        ),
        (
            {
                "/proc/self/cgroup": V1,
                f"{CGROUP}/memory/memory.limit_in_bytes": str(2**63 - 4096),
                f"{CGROUP}/memory/job/memory.limit_in_bytes": str(2 * GB),
                f"{CGROUP}/memory/job/memory.usage_in_bytes": str(3 * GB),
                f"{CGROUP}/cpu/job/cpu.cfs_quota_us": "50000",
                f"{CGROUP}/cpu/job/cpu.cfs_period_us": "100000",
            },
            (2 * GB, 0, 0.5),
        ),
        (
            {
                f"{CGROUP}/cpu.max": "max 100000",
                f"{CGROUP}/cpu/cpu.cfs_quota_us": "-1",
                f"{CGROUP}/cpu/cpu.cfs_period_us": "100000",
            },
            (16 * GB, 8 * GB, None),
        ),
    ],
)
def test_limits_of_either_version_of_cgroups_are_read(
    files: dict[str, str], expected: tuple[int, int, float | None], monkeypatch: pytest.MonkeyPatch
) -> None:
    pretend(monkeypatch, {"/proc/meminfo": MEMINFO} | files)
    found = machine.total_memory(), machine.available_memory(), machine.processor_quota()
    assert found == (pytest.approx(expected[0], rel=1e-6), pytest.approx(expected[1], rel=1e-6), expected[2])


def test_memory_is_unknown_where_nothing_tells_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sysconf", raising=False)
    for text in ("", "MemTotal: x kB"):
        pretend(monkeypatch, {"/proc/meminfo": text})
        assert (machine.total_memory(), machine.available_memory()) == (None, None)


def test_all_processors_are_used_where_no_affinity_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 5)
    assert threads.processors() == 5


def test_memory_is_released_where_the_c_library_can(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(name: Any) -> None:
        raise TypeError("bad argument type for built-in operation")  # of Windows, for None

    monkeypatch.setattr(ctypes, "CDLL", refuse)
    machine.release_memory()


# --- Threads ----------------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize(("given", "most"), [("3", 3), ("", processors())])
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


# --- Other systems ----------------------------------------------------------------------------------------------------


#: Runs command lines without what Windows lacks, and says at last on standard error how each ended. The standard
#: library needs the name of the system and O_NONBLOCK.
PROGRAM = """
import ctypes, json, os, signal, sys
for name in ("O_TMPFILE", "O_CLOEXEC", "O_NOFOLLOW", "O_DIRECTORY", "fchmod", "fork", "geteuid", "getuid", "killpg",
             "pread", "pwrite", "posix_fadvise", "register_at_fork", "sched_getaffinity", "sysconf"):
    if hasattr(os, name):
        delattr(os, name)
for name in ("SIGHUP", "SIGKILL", "pthread_kill", "pthread_sigmask"):
    delattr(signal, name)
for name in ("fcntl", "grp", "pwd", "resource", "termios"):
    sys.modules[name] = None
from sparklod_cli.cli import run
{more}
print([run(command) for command in json.loads(sys.argv[1])], file=sys.stderr)
"""

#: Lets a scene of 27,800 splats be too large for 3.2 MB of memory.
SMALL_BLOCKS = """
from sparklod_cli.bake import estimate
estimate.PROCESS = estimate.WINDOW = estimate.FAMILIES = 0
estimate.LEAST_BLOCK_SPLATS = 1 << 12
"""


def elsewhere(*commands: tuple[object, ...], more: str = "") -> tuple[list[int], subprocess.CompletedProcess[bytes]]:
    """Return how commands ended, and the process that ran them."""
    environment = os.environ | {"PYTHONIOENCODING": "cp1252", "PYTHONPATH": str(ROOT), "PYTHONUTF8": "0"}
    words = json.dumps([[*map(str, command)] for command in commands])
    line = [sys.executable, "-c", PROGRAM.replace("{more}", more), words]
    done = subprocess.run(line, env=environment, capture_output=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return json.loads(done.stderr.splitlines()[-1]), done


@pytest.mark.parametrize("output", ["out.spz", "out.rad", "set/lod-meta.json"])
def test_bakes_do_without_what_windows_lacks(output: str, tmp_path: Path) -> None:
    target = tmp_path / output
    bake = "build-lod", FIXTURES / "sh1.ply", "-o", target
    codes, done = elsewhere(bake, (*bake, "--overwrite"), ("inspect", target, "--check"), bake)
    assert codes == [0, 0, 0, 1], done.stderr.decode()  # at last, it exists
    assert not list(tmp_path.rglob(".*"))


def test_bakes_out_of_core_do_without_it_too(tmp_path: Path) -> None:
    target = tmp_path / "out.rad"
    arguments = ("build-lod", FIXTURES / "demo.ply", "-o", target, "--memory", "3.2M", "-v")
    codes, done = elsewhere(arguments, more=SMALL_BLOCKS)
    assert codes == [0], done.stderr.decode()
    assert b"out of core" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["out.rad"]


def test_consoles_without_utf8_show_escapes(tmp_path: Path) -> None:
    scene = tmp_path / "caf\u00e9 \u96ea.ply"
    scene.write_bytes((FIXTURES / "sh1.ply").read_bytes())
    codes, done = elsewhere(("inspect", scene), ("build-lod", scene, "-o", tmp_path / "\u96ea" / "out.txt"))
    assert codes == [0, 2], done.stderr
    assert "caf\u00e9 \\u96ea.ply" in done.stdout.decode("cp1252")
    assert "Traceback" not in done.stderr.decode("cp1252")
