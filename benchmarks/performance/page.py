"""The pages docs/performance*.md, each made of a template and figures.

A line of the template that is only `{{ table NAME }}` becomes the table of a section, with when and how fast a machine
measured it; `{{ goals GROUP }}` the goals of a part of a page, met or missed; `{{ machine }}` the machine.
"""

from __future__ import annotations

import re
from pathlib import Path

from performance.calibration import NAMES
from performance.figures import Figures, Measured
from performance.goal_list import GOALS
from performance.goals import table as goals_table
from performance.sections import BY_NAME

#: Pages in the order of reading; each has its template beside this module.
PAGES = (
    "performance.md",
    "performance-baking.md",
    "performance-files.md",
    "performance-viewing.md",
    "performance-cuts.md",
)

#: A line that is filled in: what, and of what.
PLACE = re.compile(r"^\{\{ (table|goals|machine) ?([a-z-]*) \}\}$", re.MULTILINE)


class TemplateError(Exception):
    """The template asks for something that there is not."""


def template(name: str) -> str:
    """Return the template of a page."""
    return Path(__file__).with_name(f"{name}.template").read_text()


def write_pages(docs: Path, figures: Figures) -> None:
    """Write all pages to a folder."""
    for name in PAGES:
        (docs / name).write_text(page(template(name), figures))


def page(template: str, figures: Figures) -> str:
    """The page.

    Raises:
        TemplateError: there is no such section or group, or braces are left over.
    """
    text = PLACE.sub(lambda found: _filled(found[1], found[2], figures), template)
    if "{{" in text:
        raise TemplateError(f"cannot fill in {text[text.index('{{') :].splitlines()[0]}")
    return text


def places(template: str, what: str) -> list[str]:
    """Names of the tables, or of the goals' groups, that a template has."""
    return [name for kind, name in PLACE.findall(template) if kind == what]


def _filled(what: str, name: str, figures: Figures) -> str:
    if what == "machine":
        return _machines(figures)
    if what == "goals":
        goals = [goal for goal in GOALS if goal.group == name]
        if not goals:
            raise TemplateError(f"there are no goals of {name!r}")
        return goals_table(goals, figures)
    if name not in BY_NAME:
        raise TemplateError(f"there is no section {name!r}")
    if name not in figures:
        return "*Not measured yet.*"
    section = figures[name]
    return f"{BY_NAME[name].shown().markdown(section.rows)}\n\n{_measured(section)}"


def _machines(figures: Figures) -> str:
    """A line for each machine that measured a part."""
    by_machine: dict[str, list[str]] = {}
    for name in BY_NAME:
        if name in figures:
            by_machine.setdefault(figures[name].machine, []).append(name)
    if len(by_machine) == 1:
        return f"Measured on: {next(iter(by_machine))}."
    return "\n".join(f"- {', '.join(names)}: {machine}." for machine, names in by_machine.items())


def _measured(section: Measured) -> str:
    """When a table was measured, and how fast the machine was before and after."""
    before, after = section.before.medians(), section.after.medians()
    speeds = {name: f"{before[name]:.1f} / {after[name]:.1f}" for name in NAMES}
    notes = "".join(f" Left out: {note}." for note in section.notes)
    return (
        f"*Calibration, before / after: copies {speeds['cold_gb_s']} GB/s into new memory and {speeds['warm_gb_s']}"
        f" into used, arithmetic {speeds['one_gflop_s']} GFLOP/s on one thread and {speeds['two_gflop_s']} on two."
        f" Measured on {section.date} in {section.seconds:.0f} s, load {section.load:.1f} before.{notes}*"
    )
