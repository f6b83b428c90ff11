"""`python -m fuzz`: runs the fuzzers; exit status 1 if something was found."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from .case import SEED, TARGETS, unpacked
from .child import Child
from .runner import run, table


def main() -> int:
    """Parses the command line, runs what it asks for, and says what was found."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, metavar="M", help="for all targets together")
    parser.add_argument("--cases", type=int, metavar="N", help="of each target; 100 unless --minutes says otherwise")
    parser.add_argument("--seed", type=int, default=SEED, metavar="S", help=f"of the cases; {SEED} unless given")
    parser.add_argument("--first", type=int, default=0, metavar="I", help="number of the first case; 0 unless given")
    parser.add_argument("--target", action="append", metavar="NAME", help="only this one; may be given more than once")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="where to put the cases in which something is found")
    parser.add_argument("--list", action="store_true", help="name the targets")
    parser.add_argument("--replay", type=Path, metavar="FILE", help="run a case of --keep again")
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
    how = {"seed": given.seed, "first": given.first, "keep": given.keep}
    tallies = run(given.target or TARGETS, cases=cases, seconds=seconds, **how)
    print(table(tallies))
    return int(any(tally.found for tally in tallies))


def replay(path: Path) -> int:
    """Runs a case that was kept."""
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
