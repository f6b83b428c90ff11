"""`fixtures/traverse/orbit.csv` is what the documented command writes, and what arithmetic without sparklod says."""

from __future__ import annotations

import csv
import gzip
import itertools
import math
import re
import shlex
import struct
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.cli import run
from tests.conftest import FIXTURES
from tests.references import frames as twin

TOWN, GOLDEN = FIXTURES / "traverse" / "town.spz", FIXTURES / "traverse" / "orbit.csv"
README = (FIXTURES / "README.md").read_text()
#: As the command has it.
FRAMES, DISTANCE, ELEVATION, BUDGET, BYTES_A_SECOND, LATENCY, CAPACITY = 24, 3.0, 20.0, 4000, 1e6 / 8, 0.05, 2

Row = dict[str, str]


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    with GOLDEN.open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_documented_command_writes_the_golden_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = re.search(r"^sparklod traverse town\.spz (?:.*\\\n)*.*$", README, re.MULTILINE)
    assert found is not None
    command = shlex.split(found[0].replace("\\\n", " "))
    (tmp_path / "town.spz").write_bytes(TOWN.read_bytes())
    monkeypatch.chdir(tmp_path)
    for threads in ("1", "3"):
        assert run([*command[1:], "-q", "--overwrite", "--threads", threads]) == 0
        assert (tmp_path / "orbit.csv").read_bytes() == GOLDEN.read_bytes()


def test_every_column_of_the_golden_table_varies_but_the_fixed_ones(rows: list[Row]) -> None:
    """Or the table would not tell much."""
    same = {name for name in rows[0] if len({row[name] for row in rows}) == 1}
    assert same == {
        *("name", "instance", "position_y", "forward_y", "fov_y_deg", "width", "height", "budget"),
        "pixel_scale_limit",
    }


def town() -> twin.Nodes:
    """The tree as its bytes say: numbers of 24 bits, 16 steps of scale to a factor of e, opacities of up to 5."""
    data = gzip.decompress(TOWN.read_bytes())
    _, version, count, sh_degree, fractional_bits, flags, _ = struct.unpack_from("<IIIBBBB", data)
    assert (version, sh_degree, flags) == (3, 0, 0x80)
    sizes = (9, 1, 3, 3, 4, 2, 4)
    ends = 16 + np.cumsum([0, *sizes]) * count
    position, alpha, _, scale, _, children, start = (data[a:b] for a, b in itertools.pairwise(ends))
    assert ends[-1] == len(data)
    low, middle, high = np.frombuffer(position, np.uint8).reshape(-1, 3).astype(int).T
    fixed = low + (middle << 8) + (high << 16)
    center = (fixed - ((high > 127) << 24)).reshape(-1, 3) / 2**fractional_bits
    deviation = np.exp(np.frombuffer(scale, np.uint8).reshape(-1, 3) / 16 - 10)
    coded = np.frombuffer(alpha, np.uint8) * (2 / 255)
    opacity = np.where(coded <= 1, coded, 4 * coded - 3)
    size = 2 * deviation.mean(axis=1) * (1 + 0.7 * np.maximum(opacity - 1, 0))
    return twin.Nodes(center, size, np.frombuffer(children, "<u2"), np.frombuffer(start, "<u4"))


def eye(number: int) -> twin.Eye:
    """A camera of the orbit: -y is up, the first one is on the side of -z, and they go counter-clockwise from above."""
    turn, tilt = 2 * math.pi * number / FRAMES, math.radians(ELEVATION)
    outwards = np.array(
        [math.cos(tilt) * math.sin(turn), -math.sin(tilt), -math.cos(tilt) * math.cos(turn)],
    )
    ahead = -outwards
    right = np.cross(ahead, [0, -1, 0])
    right /= np.linalg.norm(right)
    return twin.Eye(DISTANCE * outwards, right, np.cross(right, ahead), ahead, math.radians(60), 640, 360)


def test_cameras_are_where_trigonometry_puts_them(rows: list[Row]) -> None:
    assert len(rows) == FRAMES
    for number, row in enumerate(rows):
        at = eye(number)
        assert row["frame"] == str(number)
        assert row["time_s"] == f"{number / 10:.6f}"
        for axis, position, forward in zip("xyz", at.position, at.ahead, strict=True):
            assert float(row[f"position_{axis}"]) == pytest.approx(position, abs=1e-6)
            assert float(row[f"forward_{axis}"]) == pytest.approx(forward, abs=1e-6)
        assert row["pixel_scale_limit"] == f"{2 * math.tan(math.radians(30)) / 360:.6g}"


def test_cuts_of_the_golden_table_are_those_of_a_queue(rows: list[Row]) -> None:
    """Whichever chunks there are, as many as the table says, one set of them explains all cells of a row."""
    nodes = town()
    weight = twin.cones(90, 120, 0.4, 0.2)
    cuts: list[set[tuple[int, int]]] = []
    for number, row in enumerate(rows):
        typed: dict[str, object] = {}
        for name, text in row.items():
            whole = re.fullmatch("[0-9]+", text)
            typed[name] = None if not text else int(text) if whole else text if text.isalpha() else float(text)
        found = []
        at = eye(number)
        for chunks in itertools.combinations(range(3), int(row["chunks_resident"])):
            drawn = twin.frame([twin.Instance(nodes, weight=weight)], at, BUDGET, at.pixel, chunks)
            found.append((twin.differing(drawn.cells, typed), drawn))
            if not found[-1][0]:
                break
        wrong, drawn = min(found, key=lambda each: len(each[0]))
        assert not wrong, (number, wrong)
        cuts.append(set(drawn.cut))
    for row, cut, before in zip(rows[1:], cuts[1:], cuts, strict=False):
        assert (int(row["added"]), int(row["removed"])) == (len(cut - before), len(before - cut))
        both = len(cut) + len(before)
        assert row["churn"] == f"{len(cut ^ before) / both if both else 0:.4f}"


def test_fetched_bytes_are_those_of_the_file(rows: list[Row]) -> None:
    """A chunk has its share of the file, and comes no sooner than the network brings it."""
    size, count = TOWN.stat().st_size, len(town().size)
    ends = [min(count, 65_536 * chunk) * size // count for chunk in range(4)]
    sizes = {end - start for start, end in itertools.pairwise(ends)}
    for row in rows:
        assert row["chunks_new"] in ("0", "1")
        assert int(row["bytes_new"]) in (sizes if row["chunks_new"] == "1" else {0})
        assert int(row["chunks_resident"]) <= CAPACITY
        if int(row["missing"]) == 0:
            assert (row["complete_in_s"] == "") == (int(row["chunks_touched"]) > CAPACITY)
    # The root's chunk is asked for by the first frame and nothing else is known of.
    arrives = LATENCY + ends[1] / BYTES_A_SECOND
    first = next(row for row in rows if row["chunks_new"] == "1")
    assert int(first["frame"]) == math.ceil(10 * arrives)
    assert int(first["bytes_new"]) == ends[1]
    # All that the first frame would draw is in that chunk, or in it and one more, which come together.
    assert rows[0]["complete_in_s"] in {f"{LATENCY + each / BYTES_A_SECOND:.4f}" for each in (ends[1], ends[2])}
