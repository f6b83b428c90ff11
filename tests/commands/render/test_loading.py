"""Pictures of what a visitor sees while files load: `sparklod render --after`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.io.reading import read_scene
from tests.conftest import FIXTURES, Capture

TOWN = FIXTURES / "traverse" / "town.spz"
VIEW = ("--look-at", "1,-1,-2:0,0,0", "--size", "64x48", "--budget", "20k")
SLOW = ("--bandwidth", "800kbit", "--latency", "100ms")


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The town as RAD: a header that takes 0.8 s, and three chunks of 0.4 to 0.7 s."""
    path = tmp_path_factory.mktemp("loading") / "town.rad"
    path.write_bytes(b"".join(rad.encode(read_scene(TOWN))))
    return path


def picture(town: Path, *options: str) -> np.ndarray:
    out = town.with_suffix(".npy")
    assert run(["render", str(town), *VIEW, *options, "-q", "--overwrite", "-o", str(out)]) == 0
    return np.load(out)


def test_the_picture_becomes_that_of_the_whole_cut(town: Path) -> None:
    whole = picture(town)
    errors = [
        float(np.abs(picture(town, *SLOW, "--after", after) - whole).mean()) for after in ("1ms", "1.7s", "2.1s", "99s")
    ]
    assert errors == sorted(errors, reverse=True)
    assert errors[0] > errors[1] > 0
    assert errors[-1] == 0


def test_nothing_is_drawn_before_the_first_chunk(town: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """And a line says why."""
    monkeypatch.chdir(town.parent)
    for look in ((), ("--color-by", "overdraw"), ("--color-by", "depth"), ("--style", "points")):
        arguments = [
            "render",
            town.name,
            *VIEW,
            *SLOW,
            "--after",
            "100ms",
            *look,
            "--json",
            "--overwrite",
            "-o",
            "x.npy",
        ]
        assert run(arguments) == 0
        out, err = capsys.readouterr()
        assert [frame["splats"] for frame in json.loads(out)["frames"]] == [0]
        assert "the first chunk has not arrived yet (--after)" in err
        assert not np.nan_to_num(np.load("x.npy")).any()


def test_views_are_of_visitors_of_their_own(town: Path, capsys: Capture) -> None:
    """Each of whom opened the page in front of that view, so that none has more than a moment's chunks."""
    views = ["--view", "1,-1,-2:0,0,0"] * 3
    out = town.with_suffix(".png")
    arguments = [*views, "--size", "64x48", *SLOW, "--after", "1.7s", "--json", "--overwrite", "-o", str(out)]
    assert run(["render", str(town), *arguments]) == 0
    (splats,) = {frame["splats"] for frame in json.loads(capsys.readouterr().out)["frames"]}
    assert splats > 0


@pytest.mark.parametrize(
    "options, error",
    [
        (("--after", "1s"), "--after can only be used with --bandwidth"),
        (("--bandwidth", "1Mbit"), "--bandwidth can only be used with --after"),
        (("--chunk-cache", "3"), "--chunk-cache can only be used with --after"),
        ((*SLOW, "--after", "1s", "--full"), "--full cannot be used with --after"),
        ((*SLOW, "--after", "1s", "--continuous"), "--continuous cannot be used with --after"),
        ((*SLOW, "--after", "1s", "--compare"), "--compare cannot be used with --after"),
        ((*SLOW, "--after", "1"), "'1' is not a time"),
    ],
)
def test_what_does_not_go_together_is_refused(
    town: Path, capsys: Capture, options: tuple[str, ...], error: str
) -> None:
    assert run(["render", str(town), *options, "-o", "x.png"]) == 2
    assert error in capsys.readouterr().err
