"""Runs targets for a while or for so many cases, and says what was found."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from .case import case_of
from .child import Child
from .oracle import Finding

#: Findings of one fault that are tried again; what is found more often is there.
CONFIRMED = 2

#: Findings that another process, or a machine that does less, may not have.
OF_THE_MOMENT = ("hang", "memory")


@dataclass(frozen=True)
class Found:
    """A finding and the case that has it."""

    target: str
    seed: int
    case: int
    what: str
    finding: Finding
    again: bool

    @property
    def name(self) -> str:
        """What `--replay` calls its file, without the suffix."""
        return f"{self.target}-{self.seed}-{self.case}"

    def line(self) -> str:
        """For people."""
        once = "" if self.again else " (not when it was run again)"
        return f"{self.target}, seed {self.seed}, case {self.case}: {self.finding.kind}: {self.finding.text}{once}"


@dataclass
class Tally:
    """What came of a target."""

    target: str
    cases: int = 0
    refused: int = 0
    seconds: float = 0.0
    found: list[Found] = field(default_factory=list)

    def by_fault(self) -> dict[str, list[Found]]:
        """Findings by what is likely to be one fault."""
        groups: dict[str, list[Found]] = {}
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
        targets: names.
        seed: of all.
        cases: so many of each, or as many as there is time for.
        seconds: for all of them together.
        first: number of the first case.
        keep: a folder for the cases in which something was found.
        say: takes a line for each fault that is new.
        child: to run them in.
    """
    tallies = []
    ends = time.monotonic() + (seconds or 0)
    with child or Child() as process:
        for at, name in enumerate(targets):
            tally = Tally(name)
            tallies.append(tally)
            start = time.monotonic()
            share = max(0.0, ends - start) / (len(targets) - at)  # what one leaves over is for the others
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
    if known < CONFIRMED or finding.kind in OF_THE_MOMENT:
        process.run(request, patient=True)  # it may compile
        second = process.run(request)["finding"]
        again = second is not None
        if not again and finding.kind in OF_THE_MOMENT:
            return
        finding = Finding(**second) if second else finding
        known = len(tally.by_fault().get(finding.signature, ()))
    case = case_of(tally.target, seed, number)
    found = Found(tally.target, seed, number, case.what, finding, again)
    tally.found.append(found)
    if not known:
        say(f"{found.line()}\n  {finding.where}; {case.what}")
    if keep is not None and known <= CONFIRMED:
        keep.mkdir(parents=True, exist_ok=True)
        about = f"{found.line()}\n{finding.where}\n\n{finding.detail}\n"
        (keep / f"{found.name}.zip").write_bytes(case.packed(tally.target, about))


def table(tallies: Sequence[Tally]) -> str:
    """For people: a line a target, and one for each fault."""
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
