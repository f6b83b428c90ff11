"""Several scenes on a cluster: those that fit a worker there, and larger ones here."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from sparklod_cli.bake.estimate import in_memory_bytes
from sparklod_cli.bake.flow import bake
from sparklod_cli.bake.out_of_core.cluster import bake_side_by_side
from sparklod_cli.bake.settings import LARGE, BakeSettings, Resources
from sparklod_cli.system.errors import SparklodError
from tests.conftest import FIXTURES

#: Splats and SH degree of the largest scene that a worker of these tests holds.
HELD = 1000, 1


class Engine:
    """An engine whose workers are here."""

    def __init__(self) -> None:
        self.checked: list[Path] = []

    def check(self, store: None, files: list[Path]) -> None:
        self.checked += files

    @contextlib.contextmanager
    def map_calls(
        self, stage: str, call: Any, arguments: list[Any], progress: Any, unit: str
    ) -> Iterator[Iterator[Any]]:
        yield (call(*each, threads=1) for each in arguments)


def test_large_scenes_are_left_to_be_baked_here_in_their_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    engine = Engine()
    names = ("sh0.ply", "demo.ply", "sh1.ply")
    pairs = [(FIXTURES / name, Path(name).with_suffix(".spz")) for name in names]
    outcomes = bake_side_by_side(
        pairs,
        make=bake,
        settings=BakeSettings(),
        engine=engine,  # type: ignore[arg-type]
        resources=Resources(memory=in_memory_bytes(BakeSettings(), *HELD)),
    )
    found = list(outcomes)
    assert found[1] is LARGE
    assert [each.splats > 0 for each in (found[0], found[2])] == [True, True]
    assert engine.checked == [source for source, _ in pairs]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sh0.spz", "sh1.spz"]


def test_an_output_that_is_nowhere_to_be_seen_is_an_error(tmp_path: Path) -> None:
    baked = bake(FIXTURES / "one.ply", tmp_path / "there.spz", BakeSettings())
    pair = (FIXTURES / "one.ply", tmp_path / "one.spz")
    how = {"make": lambda *_, **__: baked, "settings": BakeSettings(), "engine": Engine(), "resources": Resources()}
    (found,) = bake_side_by_side([pair], **how)  # type: ignore[arg-type]
    assert isinstance(found, SparklodError)
    assert "wrote" in str(found) and "give --output-dir a folder that all machines share, or a URL" in str(found)
