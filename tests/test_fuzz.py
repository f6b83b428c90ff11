"""The fuzzers find what is planted, name it so that it can be had again, and find nothing where nothing is."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fuzz import runner
from fuzz.__main__ import main
from fuzz.case import TARGETS, Case, case_of, target_of, unpacked
from fuzz.child import Child
from fuzz.mutate import text_mutated
from tests import planted
from tests.conftest import ROOT

pytestmark = pytest.mark.slow

if sys.platform != "linux":
    pytest.skip("the process that runs cases is watched by what Linux offers", allow_module_level=True)

PLANTED = "tests.planted"

#: Seconds after which a case hangs: where one is meant to, and where a busy machine must not look like it.
LIMIT, PATIENCE = 2.0, 60.0


def planted_run(monkeypatch: pytest.MonkeyPatch, what: str, **how: object) -> tuple[runner.Tally, list[str]]:
    monkeypatch.setenv("PLANTED", what)
    said: list[str] = []
    limit = LIMIT if what == "hangs" else PATIENCE
    with Child(limit=limit, patience=limit) as child:
        (tally,) = runner.run([PLANTED], seed=1, cases=1, say=said.append, child=child, **how)
    return tally, said


@pytest.mark.parametrize("fault", planted.FAULTS, ids=lambda fault: fault.__name__)
def test_a_planted_fault_is_found(fault: object, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    name, kind = fault.__name__, planted.FAULTS[fault]
    tally, said = planted_run(monkeypatch, name, keep=tmp_path)
    (found,) = tally.found
    assert found.finding.kind == kind, found
    assert found.again
    assert said[0].startswith(f"{PLANTED}, seed 1, case 0: {kind}: ")
    if kind in ("exception", "crash", "hang") and name != "leaves":
        assert name in found.finding.detail
    # What was kept is the case itself.
    assert unpacked(tmp_path / f"{found.name}.zip") == (PLANTED, case_of(PLANTED, 1, 0))
    assert "1 x tests.planted, seed 1, case 0" in runner.table([tally])


@pytest.mark.parametrize(("what", "refused"), [("works", 0), ("refuses", 1)])
def test_results_and_sparklod_errors_are_no_findings(what: str, refused: int, monkeypatch: pytest.MonkeyPatch) -> None:
    tally, said = planted_run(monkeypatch, what)
    assert (tally.cases, tally.refused, tally.found, said) == (1, refused, [], [])


def test_a_process_that_dies_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    request = {"target": PLANTED, "seed": 1, "case": 0}
    with Child(limit=LIMIT, patience=20.0) as child:
        monkeypatch.setenv("PLANTED", "crashes")
        assert child.run(request)["finding"]["kind"] == "crash"
        monkeypatch.setenv("PLANTED", "works")
        assert [child.run(request)["finding"] for _ in range(3)] == [None] * 3


def test_different_faults_have_different_signatures(monkeypatch: pytest.MonkeyPatch) -> None:
    signatures = set()
    for what in ("raises", "warns", "breaks_a_law"):
        tally, _ = planted_run(monkeypatch, what)
        signatures |= set(tally.by_fault())
    assert len(signatures) == 3


def test_findings_set_the_exit_status_and_can_be_replayed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PLANTED", "raises")
    arguments = ["fuzz", "--target", PLANTED, "--cases", "2", "--seed", "3", "--first", "5", "--keep", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", arguments)
    assert main() == 1
    assert "2 x tests.planted, seed 3, case 5" in capsys.readouterr().out
    kept = tmp_path / f"{PLANTED}-3-5.zip"
    monkeypatch.setattr(sys, "argv", ["fuzz", "--replay", str(kept)])
    assert main() == 1
    assert "a decoder's own fault" in capsys.readouterr().out
    monkeypatch.setenv("PLANTED", "works")
    monkeypatch.setattr(sys, "argv", arguments[:-2])
    assert main() == 0


@pytest.mark.parametrize("target", TARGETS)
def test_a_case_has_the_same_bytes_in_every_process(target: str) -> None:
    code = (
        "import hashlib, json, sys; from fuzz.case import case_of; case = case_of(sys.argv[1], 7, 3);"
        "text = json.dumps([case.what, sorted((n, d.hex()) for n, d in case.files.items()), dict(case.run)]);"
        "print(hashlib.sha256(text.encode()).hexdigest())"
    )
    command = [sys.executable, "-c", code, target]
    environment = {**os.environ, "PYTHONHASHSEED": "42"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == digest(case_of(target, 7, 3)) == digest(case_of(target, 7, 3))
    assert digest(case_of(target, 7, 4)) != digest(case_of(target, 7, 3)) != digest(case_of(target, 8, 3))


@pytest.mark.parametrize("target", TARGETS)
def test_cases_do_not_depend_on_earlier_ones(target: str) -> None:
    forwards = {number: digest(case_of(target, 1, number)) for number in range(60)}
    backwards = {number: digest(case_of(target, 1, number)) for number in reversed(range(60))}
    assert forwards == backwards


def digest(case: Case) -> str:
    text = json.dumps([case.what, sorted((name, data.hex()) for name, data in case.files.items()), dict(case.run)])
    return hashlib.sha256(text.encode()).hexdigest()


@pytest.mark.parametrize("target", TARGETS)
def test_no_target_has_only_refused_cases(target: str) -> None:
    """A target all of whose cases are refused tries nothing but the first check of a reader."""
    assert hasattr(target_of(target), "check")
    with Child() as child:
        (tally,) = runner.run([target], seed=1, cases=5, child=child)
    assert tally.cases == 5
    assert tally.refused < 5
    assert not tally.found, runner.table([tally])


def test_texts_that_are_mutated_again_and_again_stay_of_a_size_that_is_soon_made() -> None:
    longest = 0
    for seed in range(200):
        rng, text = np.random.default_rng(seed), "churn_p95<0.2"
        for _ in range(8):
            text = text_mutated(rng, text)
        longest = max(longest, len(text))
    assert 4_000 < longest < 1 << 24
