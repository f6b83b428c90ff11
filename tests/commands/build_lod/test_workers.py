"""`sparklod build-lod --workers`: scenes side by side, in a process as a shell starts it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

pytest.importorskip("cryptography")
pytest.importorskip("distributed")

from tests.commands.build_lod.runs import ONE, SMALL, build, sparklod
from tests.conftest import Capture

pytestmark = pytest.mark.slow


def test_scenes_side_by_side_are_those_of_one_after_the_other(tmp_path: Path) -> None:
    small = [shutil.copy(SMALL, tmp_path / f"small-{number}.ply") for number in range(3)]
    broken = tmp_path / "broken.ply"
    broken.write_bytes(b"ply\nnonsense\nend_header\n")
    inputs = [small[0], broken, ONE, *small[1:]]
    done = sparklod("build-lod", *inputs, "--output-dir", tmp_path / "beside", "--workers", 2, "--json")
    said = done.stderr.decode()
    assert done.returncode == 1, said
    assert build(*inputs, "--output-dir", tmp_path / "alone") == 1
    made = sorted(path.name for path in (tmp_path / "alone").iterdir())
    assert made == ["one-lod.spz", "small-0-lod.spz", "small-1-lod.spz", "small-2-lod.spz"]
    for name in made:
        assert (tmp_path / "beside" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [row["input"] for row in rows] == [str(path) for path in inputs]
    assert ["error" in row for row in rows] == [False, True, False, False, False]
    lines = [line for line in said.splitlines() if not line.startswith("baking: ")]  # the progress of a slow machine
    assert f"error: {broken}: bad PLY header" in lines[1]
    assert len(lines) == 5, said


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--workers", 2, "--scheduler", "host:1"], "--workers cannot be used with --scheduler, whose workers run"),
        (["--workers", 0], "0 is not in the range 1<=x<=256"),
    ],
)
def test_what_contradicts_itself_is_refused(options: list[object], said: str, capsys: Capture) -> None:
    assert build(ONE, *options) == 2
    assert said in capsys.readouterr().err


def test_workers_cannot_read_standard_input(capsys: Capture) -> None:
    assert build("-", "-o", "x.spz", "--scheduler", "host:1") == 2
    assert "--scheduler cannot be used with standard input, which workers cannot read" in capsys.readouterr().err
