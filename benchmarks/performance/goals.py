"""`Goal`, a figure and its bound; whether it is met is judged by what was measured, never typed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from performance.figures import Figures
from performance.rows import Label, Row

#: The figure of a row; None where it was not measured.
Figure = Callable[[Row], float | None]


@dataclass(frozen=True)
class Goal:
    """A figure and its bound.

    Attributes:
        group: part of the page.
        text: what is wanted, with the bound, in Markdown.
        section: that measures it.
        figure: of each row that counts.
        most, least: the bound; one of the two.
        where: labels of rows that count; a tuple lists those allowed.
        only: which of these rows count, by their labels.
        form: how the figure is told.
        name: labels that tell rows apart, where several count.
        across: what is judged, of all rows' figures together; None for each by itself.
    """

    group: str
    text: str
    section: str
    figure: Figure
    most: float | None = None
    least: float | None = None
    where: Mapping[str, Label | tuple[Label, ...]] = field(default_factory=dict)
    only: Callable[[Row], bool] = lambda row: True
    form: str = "{:.2f}"
    name: tuple[str, ...] = ()
    across: Callable[[Sequence[float]], float] | None = None


@dataclass(frozen=True)
class Verdict:
    """How a goal was reached.

    Attributes:
        goal: which.
        met: whether all its figures keep to the bound; None if none was measured.
        figures: by what they are of.
    """

    goal: Goal
    met: bool | None
    figures: Mapping[str, float]

    @property
    def text(self) -> str:
        """Says "met" or "missed" with the figures, the worst last, or that nothing was measured."""
        if self.met is None:
            return "not measured"
        told = {name: self.goal.form.format(value) for name, value in self.figures.items()}
        if self.met:
            worst, best = _ends(self.goal, self.figures)
            return f"met: {told[worst]}" if worst == best else f"met: {told[best]} to {told[worst]}"
        missed = [name for name, value in self.figures.items() if not _keeps(self.goal, value)]
        listed = ", ".join(f"{name}: {told[name]}" if name else told[name] for name in missed)
        worst = max(_times(self.goal, self.figures[name]) for name in missed)
        rest = len(self.figures) - len(missed)
        also = f"; met by the other {rest}" if rest else ""
        percent = 100 * (worst - 1)
        return f"**missed** by {percent:.{0 if percent >= 10 else 1}f} %: {listed}{also}"


def _ends(goal: Goal, figures: Mapping[str, float]) -> tuple[str, str]:
    """The names of the worst and of the best figure."""
    order = sorted(figures, key=lambda name: _times(goal, figures[name]))
    return order[-1], order[0]


def _times(goal: Goal, value: float) -> float:
    """How many times worse than the bound."""
    if goal.most is not None:
        return value / goal.most
    assert goal.least is not None
    return goal.least / value


def _keeps(goal: Goal, value: float) -> bool:
    return _times(goal, value) <= 1


def judged(goal: Goal, figures: Figures) -> Verdict:
    """Judges a goal by what was measured."""
    section = figures.get(goal.section)
    rows = [row for row in section.rows if _counts(goal, row)] if section else []
    values = [(row, value) for row in rows if (value := goal.figure(row)) is not None]
    if goal.across:
        found = {"": goal.across([value for _, value in values])} if values else {}
    else:
        found = {", ".join(_label_text(name, row) for name in goal.name): value for row, value in values}
        if len(found) < len(values):
            raise ValueError(f"{goal.text}: {goal.name} does not tell the rows of {goal.section} apart")
    return Verdict(goal, all(_keeps(goal, value) for value in found.values()) if found else None, found)


def _label_text(name: str, row: Row) -> str:
    """Return a label, with its name if it is a number."""
    value = row.labels[name]
    return f"{name} {value:,}" if isinstance(value, int) else str(value)


def _counts(goal: Goal, row: Row) -> bool:
    for name, allowed in goal.where.items():
        if row.labels.get(name) not in (allowed if isinstance(allowed, tuple) else (allowed,)):
            return False
    return goal.only(row)


def table(goals: Iterable[Goal], figures: Figures) -> str:
    """Goals and what was reached of each, in Markdown."""
    lines = ["| goal | reached |", "| --- | --- |"]
    lines += [f"| {goal.text} | {judged(goal, figures).text} |" for goal in goals]
    return "\n".join(lines)
