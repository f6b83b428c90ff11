"""Bakes out of core on a cluster: the bytes of one process, for any number of workers."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cryptography")
pytest.importorskip("distributed")

import distributed

from sparklod_cli.bake.flow import bake
from sparklod_cli.bake.out_of_core import cluster as module
from sparklod_cli.bake.out_of_core.cluster import ClusterEngine, cluster
from sparklod_cli.bake.out_of_core.job import Engine
from sparklod_cli.bake.settings import Baked, BakeSettings, Resources
from sparklod_cli.codecs.formats import RAD_SUFFIX as RAD
from sparklod_cli.system.addresses import Address, Place
from sparklod_cli.system.errors import SparklodError
from sparklod_cli.system.progress import Progress, silent
from tests.conftest import FIXTURES

pytestmark = pytest.mark.slow

DEMO = FIXTURES / "demo.ply"

#: What was said of the two processes.
SAID: list[str] = []

#: Some eight blocks.
BLOCKS = Resources(block_splats=4000)


@pytest.fixture(scope="module")
def two() -> Iterator[ClusterEngine]:
    """Two processes."""
    with cluster(workers=2, threads=2, say=SAID.append) as engine:
        yield engine


@pytest.fixture
def running() -> Iterator[Any]:
    """A scheduler and a worker in this process, which sees its addresses."""
    own = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "protocol": "tcp", "dashboard_address": None}
    with module._quiet():
        started = distributed.LocalCluster(**own)
        yield started
        with contextlib.suppress(TimeoutError):  # a test closed it
            started.close(timeout=1)


@pytest.fixture
def one(running: Any) -> Iterator[ClusterEngine]:
    """One worker."""
    with cluster(scheduler=running.scheduler_address) as engine:
        yield engine


def baked(
    source: Place,
    target: Place,
    how: BakeSettings,
    engine: Engine | None,
    progress: Progress = silent,
    **more: object,
) -> tuple[Baked, bytes]:
    """What is told of a bake, and its bytes."""
    resources = dataclasses.replace(BLOCKS, **more)  # type: ignore[arg-type]
    told = bake(source, target, how, resources=resources, engine=engine, threads=2, progress=progress)
    with target.open("rb") as file:
        return dataclasses.replace(told, seconds={}), file.read()


@pytest.mark.parametrize("how", [BakeSettings(), BakeSettings(method="quality", suffix=RAD)])
def test_the_bytes_do_not_depend_on_the_workers(
    how: BakeSettings, one: ClusterEngine, two: ClusterEngine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # workers have other folders
    expected = baked(DEMO, tmp_path / f"none{how.suffix}", how, None)
    assert expected[0].blocks is not None and expected[0].blocks > 4
    for name, engine in (("one", one), ("two", two)):
        found = baked(DEMO, Path(f"{name}{how.suffix}"), how, engine)
        assert found[1] == expected[1]
        assert found[0].blocks == expected[0].blocks and found[0].scratch_bytes_written
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [how.suffix] * 3


class Once:
    """A progress that does something when the first block is built."""

    def __init__(self, act: Callable[[], object]) -> None:
        self.act, self.acted = act, False

    def __call__(self, stage: str, done: int, total: int, unit: str) -> None:
        if stage == "building" and done and not self.acted:
            self.acted = True
            self.act()


def test_a_worker_that_is_killed_changes_no_byte(two: ClusterEngine, tmp_path: Path) -> None:
    expected = baked(DEMO, tmp_path / "none.spz", BakeSettings(), None)
    pids = list(two.client.run(os.getpid).values())
    kill = Once(lambda: os.kill(pids[0], signal.SIGKILL))
    SAID.clear()
    assert baked(DEMO, tmp_path / "killed.spz", BakeSettings(), two, kill)[1] == expected[1]
    assert kill.acted
    for _ in range(600):  # the bake may have ended before the scheduler knew
        two.tell_losses()
        if any("was lost" in text for text in SAID):
            break
        time.sleep(0.1)
    else:
        pytest.fail("nobody says that a worker was lost")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["killed.spz", "none.spz"]


def test_a_bake_goes_on_after_its_scheduler_went_away(running: Any, one: ClusterEngine, tmp_path: Path) -> None:
    expected = baked(DEMO, tmp_path / "none.spz", BakeSettings(), None)
    close = Once(lambda: running.loop.add_callback(running.scheduler.close))
    target = tmp_path / "gone.spz"
    with pytest.raises(SparklodError, match=r"scheduler of the cluster no longer answers; finished work is kept"):
        baked(DEMO, target, BakeSettings(), one, close)
    assert not target.exists()
    stages: list[tuple[str, int]] = []
    found = baked(DEMO, target, BakeSettings(), None, lambda *told: stages.append(told[:2]), resume=True)
    assert found[1] == expected[1]
    assert next(done for stage, done in stages if stage == "building") > 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["gone.spz", "none.spz"]


def test_a_whole_bake_at_addresses_has_the_bytes_of_one_at_paths(one: ClusterEngine, tmp_path: Path) -> None:
    folder = Address(f"memory://{uuid.uuid4().hex}")
    for name, block in (("demo.ply", 6000), ("golden/hand-v4.spz", 20)):  # the latter is unpacked first
        source = folder / Path(name).name
        source.write([(FIXTURES / name).read_bytes()])
        expected = baked(FIXTURES / name, tmp_path / f"{source.stem}.spz", BakeSettings(), None, block_splats=block)
        for engine in (None, one):
            target = folder / f"{source.stem}-{engine is None}-lod.spz"
            found = baked(source, target, BakeSettings(), engine, scratch_dir=folder / "scratch", block_splats=block)
            assert found[1] == expected[1]
    assert not [name for name in folder.files() if name.startswith("scratch")]


def test_scratch_that_processes_do_not_share_is_refused(two: ClusterEngine) -> None:
    folder = Address(f"memory://{uuid.uuid4().hex}")
    with pytest.raises(
        SparklodError, match=r"does not see what was written to memory://.*: give --scratch-dir a folder"
    ):
        baked(DEMO, folder / "lod.spz", BakeSettings(), two, scratch_dir=folder)
    assert folder.files() == []
