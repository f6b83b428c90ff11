"""Figures of performance: their tables, goals and comparisons with earlier figures. Nothing is timed here."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import ROOT

BENCHMARKS = ROOT / "benchmarks"


@pytest.fixture
def modules(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Imports a module of `benchmarks/performance` by its name."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return lambda name: importlib.import_module(f"performance.{name}")


def measured(modules: Any, rows: Sequence[Any], speed: float = 1.0, notes: Sequence[str] = ()) -> Any:
    """A section on a machine of some speed."""
    calibration = modules("calibration").Calibration(*[[speed, speed, speed]] * 4)
    made = modules("figures").Measured
    return made("2026-01-02", "a machine", 0.25, 7.0, calibration, calibration, rows, notes)


def test_every_section_and_every_goal_has_a_place(modules: Any) -> None:
    page, goals, sections = modules("page"), modules("goal_list").GOALS, modules("sections").SECTIONS
    templates = "".join(map(page.template, page.PAGES))
    assert page.places(templates, "table") == [section.name for section in sections]
    assert set(page.places(templates, "goals")) == {goal.group for goal in goals}
    assert {goal.section for goal in goals} <= {section.name for section in sections}
    assert all((goal.most is None) != (goal.least is None) for goal in goals), "one bound each"
    assert len({(goal.group, goal.text) for goal in goals}) == len(goals)


def test_a_table_has_what_was_measured_and_how_fast_the_machine_was(modules: Any) -> None:
    row = modules("rows").Row({"splats": 20_000}, {"picture_cpu_s": [0.010], "gradients_cpu_s": [0.02, 0.03, 0.07]})
    section = measured(modules, [row], 5.0, ["there is no scene x.ply"])
    told = modules("page").page("{{ machine }}\n{{ table gradients }}", {"gradients": section})
    assert "a machine" in told
    assert "| 20,000 | 10.0 | 30.0 (20.0 to 70.0) | 3.0 |" in told
    assert "copies 5.0 / 5.0 GB/s into new memory" in told
    assert "Left out: there is no scene x.ply." in told


def test_a_goal_of_several_rows_is_met_only_if_all_keep_to_it(modules: Any) -> None:
    goals, row = modules("goals"), modules("rows").Row
    goal = goals.Goal("a", "b", "c", lambda each: each.value("x_s"), least=2, name=("scene",), form="{:.1f}")
    rows = [row({"scene": name}, {"x_s": [value]}) for name, value in {"a": 4.0, "b": 2.0, "c": 1.6}.items()]
    told = goals.judged(goal, {"c": measured(modules, rows)})
    assert told.met is False
    assert told.text == "**missed** by 25 %: c: 1.6; met by the other 2"
    told = goals.judged(goal, {"c": measured(modules, rows[:2])})
    assert (told.met, told.text) == (True, "met: 4.0 to 2.0")
    rows.append(row({"scene": "d"}, {}))
    assert goals.judged(goal, {"c": measured(modules, rows[3:])}).met is None
    with pytest.raises(ValueError, match="does not tell the rows of c apart"):
        goals.judged(goals.Goal("a", "b", "c", goal.figure, least=2), {"c": measured(modules, rows[:2])})
    spread = goals.Goal("a", "b", "c", goal.figure, most=2.5, across=lambda values: max(values) / min(values))
    assert goals.judged(spread, {"c": measured(modules, rows[:3])}).text == "met: 2.50"
    assert goals.judged(spread, {"c": measured(modules, [*rows[:3], row({"scene": "e"}, {"x_s": [1.0]})])}).met is False


TABLES = {"judged": ("x_s", "peak_bytes"), "key": ("scene",), "columns": ()}


@pytest.mark.parametrize(
    ("before", "now", "speed", "fell"),
    [
        ([1.0, 1.1, 1.2], [1.3, 1.4, 1.5], 1.0, True),
        ([1.0, 1.1, 1.2], [1.1, 1.4, 1.5], 1.0, False),  # their ranges overlap
        ([1.0, 1.01, 1.02], [1.03, 1.04, 1.05], 1.0, False),  # apart, but by little
        ([1.0, 1.1, 1.2], [1.3, 1.4, 1.5], 0.7, False),  # the machine is slower
        ([1.0, 1.1, 1.2], [2.6, 2.8, 3.0], 0.7, True),  # but not by that much
        ([1.0, 1.1, 1.2], [1.0, 1.1, 1.2], 2.0, True),  # it is faster, and the code is not
        ([1.0, 1.1, 1.2], [0.5, 0.6, 0.7], 1.0, False),
        ([1.0], [1.2], 1.0, False),  # a single run varies more
        ([1.0], [1.4], 1.0, True),
        ([], [1.4], 1.0, False),
    ],
)
def test_figures_that_fell_behind_by_more_than_noise_are_reported(
    modules: Any, before: list[float], now: list[float], speed: float, fell: bool
) -> None:
    row, table = modules("rows").Row, modules("rows").Table(**TABLES)
    old = measured(modules, [row({"scene": "a"}, {"x_s": before}), row({"scene": "gone"}, {"x_s": [1e-9, 1e-9]})])
    new = measured(modules, [row({"scene": "a"}, {"x_s": now}), row({"scene": "new"}, {"x_s": [1e9, 1e9]})], speed)
    found = list(modules("behind").behind(table, old, new))
    assert [(each.key, each.name) for each in found] == ([(("a",), "x_s")] if fell else [])
    assert all(str(each).startswith("a: x_s ") for each in found)


def test_figures_are_written_and_read_again(modules: Any, tmp_path: Path) -> None:
    store, file = modules("figures"), tmp_path / "figures.json"
    rows = [modules("rows").Row({"scene": "a", "splats": 3}, {"x_s": [0.1234567, 2e9], "y_s": []})]
    store.write(file, {"gradients": measured(modules, rows, 2.0, ["a note"]), "short": measured(modules, [])})
    again = store.read(file)
    assert list(again) == ["gradients", "short"]
    assert again["gradients"].rows[0].runs["x_s"] == [0.123457, 2e9]
    assert again["gradients"].as_json() == measured(modules, rows, 2.0, ["a note"]).as_json()
    assert store.committed(file).keys() == again.keys(), "the file itself, where nothing is committed"
    assert store.read(tmp_path / "none.json") == {}


def test_a_process_is_measured_from_outside(modules: Any, tmp_path: Path) -> None:
    process = modules("process")
    code = "import os, sys; a = bytearray(60_000_000); print(os.environ['GIVEN'], os.getcwd())"
    took = process.run([sys.executable, "-c", code], cwd=tmp_path, variables={"GIVEN": "x"})
    assert took.output.split() == ["x", str(tmp_path)]
    assert 60e6 < took.peak_bytes < 120e6, "its own memory, not that of this process"
    assert took.cpu_s > 0
    with pytest.raises(process.CommandError, match="ValueError: no"):
        process.run([sys.executable, "-c", "raise ValueError('no')"])
    assert process.run([sys.executable, "-c", "raise SystemExit(3)"], codes=(0, 3)).output == ""
