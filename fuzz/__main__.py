"""`python -m fuzz`: runs the fuzzers. The exit status is 1 if they found something."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from .case import SEED, TARGETS, unpacked
from .child import Child
from .runner import run, table


def main() -> int:
    """Parses the command line, runs the cases it asks for and prints the findings; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, metavar="M", help="stop after M minutes, for all targets together")
    parser.add_argument(
        "--cases", type=int, metavar="N", help="cases of each target (default: 100, or as many as --minutes allows)"
    )
    parser.add_argument("--seed", type=int, default=SEED, metavar="S", help=f"seed of the cases (default: {SEED})")
    parser.add_argument("--first", type=int, default=0, metavar="I", help="number of the first case (default: 0)")
    parser.add_argument("--target", action="append", metavar="NAME", help="run this target only; repeatable")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="save the cases that have findings in DIR")
    parser.add_argument("--list", action="store_true", help="list the targets")
    parser.add_argument("--replay", type=Path, metavar="FILE", help="run a case again that --keep saved")
    given = parser.parse_args()
    if given.list:
        print("\n".join(TARGETS))
        return 0
    if given.replay:
        return replay(given.replay)
    unknown = [name for name in given.target or () if name not in TARGETS and "." not in name]
    if unknown:
        parser.error(f"{unknown[0]} is not one of {', '.join(TARGETS)}")
    cases = given.cases if given.cases or given.minutes else 100
    seconds = given.minutes and 60 * given.minutes
    tallies = run(
        given.target or TARGETS, cases=cases, seconds=seconds, seed=given.seed, first=given.first, keep=given.keep
    )
    print(table(tallies))
    return int(any(tally.found for tally in tallies))


def replay(path: Path) -> int:
    """Runs a case that `--keep` saved; returns the exit status."""
    target, case = unpacked(path)
    print(f"{target}: {case.what}")
    with Child() as child:
        request = {"replay": str(path.resolve())}
        child.run(request)
        answer = child.run(request)
    finding = answer["finding"]
    if finding is None:
        print(f"nothing is wrong ({answer['outcome']}, {answer['seconds']:.2f} s)")
        return 0
    print(f"{finding['kind']}: {finding['text']}\n{finding['where']}\n{finding['detail']}")
    return 1


if __name__ == "__main__":
    sys.exit(main())
