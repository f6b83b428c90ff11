"""`sparklod render --difference`: what is shown, and its PSNR."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.codecs.rounding import ROUND_TRIPS
from sparklod_cli.images.metrics import psnr
from tests.commands.render.runs import AT, DEMO, PLAIN, SIZE, floats, pixels, render
from tests.conftest import Capture


def test_a_difference_is_drawn_and_its_psnr_said(built: Path, tmp_path: Path, capsys: Capture) -> None:
    how = (*SIZE, *AT)
    assert render(DEMO, *how, "--diff", DEMO, "-o", tmp_path / "same.png", "--json", "-q") == 0
    assert json.loads(capsys.readouterr().out)["frames"][0]["psnr_db"] == 100
    assert not pixels(tmp_path / "same.png").any()
    for name, said in (("a", (built, "--budget", 300)), ("b", (DEMO,))):
        assert render(*said, *how, "-q", "-o", tmp_path / f"{name}.npy", "--background", "white") == 0
    a, b = (floats(tmp_path / f"{name}.npy")[..., :3] for name in "ab")
    settings = (built, "--budget", 300, *how, "--diff", DEMO, "--background", "white", "--gain", 3, "--json")
    assert render(*settings, "-o", tmp_path / "d.png") == 0
    out, err = capsys.readouterr()
    value = json.loads(out)["frames"][0]["psnr_db"]
    assert value == pytest.approx(psnr(np.clip(a, 0, 1), np.clip(b, 0, 1)), abs=2e-3)
    assert f"PSNR {value:.2f} dB" in err
    expected = np.rint(255 * np.clip(3 * np.abs(np.clip(a, 0, 1) - np.clip(b, 0, 1)), 0, 1))
    assert np.abs(pixels(tmp_path / "d.png") - expected).max() <= 1


def test_a_difference_says_what_it_shows(built: Path, tmp_path: Path, capsys: Capture) -> None:
    how = (built, "--budget", 9_000, "--size", "400x240", *AT, "--diff", DEMO, "--json")
    assert render(*how, "-o", tmp_path / "bar.png") == 0
    out, err = capsys.readouterr()
    report = json.loads(out)
    assert f"differences times {report['gain']:g}" in err
    bar = pixels(tmp_path / "bar.png")
    assert report["frames"][0]["width"] == bar.shape[1] > 400
    assert render(*how, "-o", tmp_path / "same.png", "--gain", report["gain"], "--no-bar") == 0
    assert np.array_equal(pixels(tmp_path / "same.png"), bar[:, :400])
    assert bar[:, :400].max() > 90


def test_an_encoding_is_seen_in_the_difference_to_the_file_itself(tmp_path: Path, capsys: Capture) -> None:
    values = {}
    for through in ROUND_TRIPS:
        settings = (PLAIN, *SIZE, "--through", through, "--diff", PLAIN, "--json", "-q")
        assert render(*settings, "-o", tmp_path / f"{through}.png") == 0
        values[through] = json.loads(capsys.readouterr().out)["frames"][0]["psnr_db"]
    assert all(25 < value < 100 for value in values.values())
    assert len(set(values.values())) == len(values)
