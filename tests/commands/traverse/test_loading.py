"""What a visitor waits for who opens a page: the summary of `sparklod traverse`, and assertions about it."""

from __future__ import annotations

import json

import pytest

from sparklod_cli.cli import run
from sparklod_cli.simulation.columns import LOADING
from tests.conftest import FIXTURES, Capture

TOWN = str(FIXTURES / "traverse" / "town.spz")
VIEW = ("--look-at", "1,-1,-2:0,0,0", "--budget", "20k")
SLOW = ("--bandwidth", "800kbit", "--latency", "100ms")


def test_the_summary_tells_what_a_visitor_waits_for(capsys: Capture) -> None:
    assert run(["traverse", TOWN, *VIEW, *SLOW, "--json", "--summary"]) == 0
    out, err = capsys.readouterr()
    loading = json.loads(out)["loading"]
    assert list(loading) == [column.name for column in LOADING]
    assert 0.1 < loading["first_picture_s"] < loading["resident_90_s"] <= loading["resident_all_s"]
    assert (
        loading["resident_90_bytes"] <= loading["resident_all_bytes"] <= (FIXTURES / "traverse/town.spz").stat().st_size
    )
    assert f"opens      first picture after {loading['first_picture_s']:.2f} s, 90 % after" in err


def test_a_cache_that_is_too_small_never_has_it_all(capsys: Capture) -> None:
    assert run(["traverse", TOWN, *VIEW, *SLOW, "--chunk-cache", "1", "--json", "--summary"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["loading"]["resident_all_s"] is None
    assert "all never" in err


@pytest.mark.parametrize("text, code", [("first_picture_s<1", 0), ("resident_all_s<0.2", 3), ("resident_90_s<9", 0)])
def test_assertions_can_be_about_it(text: str, code: int, capsys: Capture) -> None:
    assert run(["traverse", TOWN, *VIEW, *SLOW, "--assert", text, "--json"]) == code
    (held,) = json.loads(capsys.readouterr().out)["asserts"]
    assert held["held"] == (code == 0)


def test_without_a_network_nobody_waits(capsys: Capture) -> None:
    assert run(["traverse", TOWN, *VIEW, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["loading"] is None
    assert run(["traverse", TOWN, *VIEW, "--assert", "first_picture_s<1", "--json"]) != 0
    assert "first_picture_s is empty: it needs --bandwidth" in capsys.readouterr().err
