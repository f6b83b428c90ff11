"""What a process may use of its machine, as Linux tells it in either version of cgroups."""

from __future__ import annotations

from pathlib import Path

import pytest

from sparklod_cli.system import machine

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


def test_without_limits_memory_is_that_of_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, {"/proc/meminfo": MEMINFO, "/sys/fs/cgroup/memory.max": "max"})
    assert machine.total_memory() == pytest.approx(16 * GB, rel=1e-6)
    assert machine.available_memory() == pytest.approx(8 * GB, rel=1e-6)
    assert machine.processor_quota() is None


@pytest.mark.parametrize("folder", ["", "/user", "/user/job"])
def test_the_least_limit_of_any_group_above_counts(folder: str, monkeypatch: pytest.MonkeyPatch) -> None:
    group = f"/sys/fs/cgroup{folder}"
    files = {"/proc/meminfo": MEMINFO, "/proc/self/cgroup": V2, "/sys/fs/cgroup/user/job/memory.max": str(15 * GB)}
    files |= {
        f"{group}/memory.max": str(4 * GB),
        f"{group}/memory.current": str(GB),
        f"{group}/cpu.max": "150000 100000",
    }
    pretend(monkeypatch, files)
    assert (machine.total_memory(), machine.available_memory(), machine.processor_quota()) == (4 * GB, 3 * GB, 1.5)


def test_limits_of_cgroup_version_1_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    memory, cpu = "/sys/fs/cgroup/memory", "/sys/fs/cgroup/cpu/job"
    files = {"/proc/meminfo": MEMINFO, "/proc/self/cgroup": V1, f"{memory}/memory.limit_in_bytes": str(2**63 - 4096)}
    files |= {f"{memory}/job/memory.limit_in_bytes": str(2 * GB), f"{memory}/job/memory.usage_in_bytes": str(3 * GB)}
    files |= {f"{cpu}/cpu.cfs_quota_us": "50000", f"{cpu}/cpu.cfs_period_us": "100000"}
    pretend(monkeypatch, files)
    assert (machine.total_memory(), machine.available_memory(), machine.processor_quota()) == (2 * GB, 0, 0.5)


def test_no_quota_and_nonsense_are_no_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    files = {"/sys/fs/cgroup/cpu.max": "max 100000", "/sys/fs/cgroup/cpu/cpu.cfs_quota_us": "-1"}
    pretend(monkeypatch, {**files, "/sys/fs/cgroup/cpu/cpu.cfs_period_us": "100000", "/proc/meminfo": "MemTotal: x kB"})
    assert machine.processor_quota() is None
    assert machine.available_memory() is None
