"""Runs targets for a given time or number of cases, and reports the findings."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from .case import case_of
from .child import Child
from .oracle import Finding

#: Findings of one fault whose cases are run again to confirm them; further ones need no confirmation.
CONFIRMED = 2

#: Kinds of findings that depend on the process or on how busy the machine is: they count only if they occur again.
LOAD_DEPENDENT = ("hang", "memory")


@dataclass(frozen=True)
class CaseFinding:
    """A finding, the case that has it, and whether it occurred again when the case was repeated."""

    target: str
    seed: int
    case: int
    what: str
    finding: Finding
    again: bool

    @property
    def name(self) -> str:
        """Name of the file that `--keep` saves, without its suffix."""
        return f"{self.target}-{self.seed}-{self.case}"

    def line(self) -> str:
        """One line about the finding."""
        once = "" if self.again else " (not when the case was repeated)"
        return f"{self.target}, seed {self.seed}, case {self.case}: {self.finding.kind}: {self.finding.text}{once}"


@dataclass
class Tally:
    """Counts and findings of a target."""

    target: str
    cases: int = 0
    refused: int = 0
    seconds: float = 0.0
    found: list[CaseFinding] = field(default_factory=list)

    def by_fault(self) -> dict[str, list[CaseFinding]]:
        """The findings, grouped by what is probably one fault."""
        groups: dict[str, list[CaseFinding]] = {}
        for each in self.found:
            groups.setdefault(each.finding.signature, []).append(each)
        return groups


def run(
    targets: Sequence[str],
    *,
    seed: int,
    cases: int | None = None,
    seconds: float | None = None,
    first: int = 0,
    keep: Path | None = None,
    say: Callable[[str], None] = print,
    child: Child | None = None,
) -> list[Tally]:
    """Runs targets one after the other.

    Args:
        targets: their names.
        seed: seed of all cases.
        cases: number of cases of each target; None for as many as `seconds` allows.
        seconds: time for all targets together; None for no limit.
        first: number of the first case.
        keep: a folder for the cases that have findings; None to save none.
        say: called with a text for each new fault.
        child: the worker to run the cases in; None for a new one.
    """
    tallies = []
    ends = time.monotonic() + (seconds or 0)
    with child or Child() as process:
        for at, name in enumerate(targets):
            tally = Tally(name)
            tallies.append(tally)
            start = time.monotonic()
            share = max(0.0, ends - start) / (len(targets) - at)  # time that one target leaves goes to the others
            for number in _numbers(first, cases, seconds and start + share):
                _one(process, tally, seed, number, keep, say)
            tally.seconds = time.monotonic() - start
    return tallies


def _numbers(first: int, cases: int | None, ends: float | None) -> Iterator[int]:
    number = first
    while (cases is None or number < first + cases) and (ends is None or number == first or time.monotonic() < ends):
        yield number
        number += 1


def _one(process: Child, tally: Tally, seed: int, number: int, keep: Path | None, say: Callable[[str], None]) -> None:
    request = {"target": tally.target, "seed": seed, "case": number}
    answer = process.run(request)
    tally.cases += 1
    tally.refused += answer["outcome"] == "refused"
    if answer["finding"] is None:
        return
    finding, again = Finding(**answer["finding"]), True
    known = len(tally.by_fault().get(finding.signature, ()))
    if known < CONFIRMED or finding.kind in LOAD_DEPENDENT:
        process.run(request, patient=True)  # once to compile kernels
        second = process.run(request)["finding"]
        again = second is not None
        if not again and finding.kind in LOAD_DEPENDENT:
            return
        finding = Finding(**second) if second else finding
        known = len(tally.by_fault().get(finding.signature, ()))
    case = case_of(tally.target, seed, number)
    found = CaseFinding(tally.target, seed, number, case.what, finding, again)
    tally.found.append(found)
    if not known:
        say(f"{found.line()}\n  {finding.where}; {case.what}")
    if keep is not None and known <= CONFIRMED:
        keep.mkdir(parents=True, exist_ok=True)
        about = f"{found.line()}\n{finding.where}\n\n{finding.detail}\n"
        (keep / f"{found.name}.zip").write_bytes(case.packed(tally.target, about))


def table(tallies: Sequence[Tally]) -> str:
    """Formats a table with a row for each target, followed by a line for each fault."""
    rows = [["target", "cases", "refused", "findings", "faults", "seconds"]]
    for tally in tallies:
        numbers = (tally.cases, tally.refused, len(tally.found), len(tally.by_fault()))
        rows.append([tally.target, *(f"{number:,}" for number in numbers), f"{tally.seconds:.1f}"])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join(
            [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        )
        for row in rows
    ]
    for tally in tallies:
        lines += [f"{len(group):,} x {group[0].line()}" for group in tally.by_fault().values()]
    return "\n".join(lines)
