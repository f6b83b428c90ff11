"""Splat budgets: a count of splats, or a share of the leaves."""

from __future__ import annotations

import re
from dataclasses import dataclass
from fractions import Fraction

from ..system.units import check_grouping, count_of, parse_count

#: A share of the leaves, in percent, with at most nine decimals.
SHARE = re.compile(r"([0-9]{1,3}(?:\.[0-9]{1,9})?|\.[0-9]{1,9})\s*%")

#: A share without the percent sign.
FRACTION = re.compile(r"0?\.[0-9]{1,9}")

#: A comma that groups digits, as no budget of a list begins with a zero.
GROUPED_LIST = re.compile(r"[0-9],0")

#: Smaller counts draw nothing recognisable: probably a share or thousands are meant.
FEW = 100

#: Largest count: every table format stores integers up to this exactly.
LARGEST = 1 << 53


@dataclass(frozen=True)
class Budget:
    """The maximum number of splats of a cut.

    Attributes:
        text: as the user wrote it: "5%" or "500k".
        share: share of the leaves of all instances together; None for a count.
        count: number of splats; None for a share.
        scale: factor for the budget, Spark's `lodSplatScale`.
        by_default: not chosen by the user; viewers other than Spark then use their own defaults.
    """

    text: str
    share: Fraction | None
    count: int | None
    scale: float = 1.0
    by_default: bool = False

    @classmethod
    def of_count(cls, count: int) -> Budget:
        """Return a budget of a number of splats."""
        return cls(f"{count}", None, count)

    def of(self, leaves: int) -> int:
        """Return the number of splats, at least 1, for a total number of leaves."""
        splats = self.count if self.share is None else self.share * leaves
        assert splats is not None
        return max(1, int(splats if self.scale == 1 else float(splats) * self.scale))


def doubt(count: int | None, *, shares: bool = True) -> str:
    """Return a question about a suspiciously small number of splats, else an empty text.

    `shares`: suggest a share, too.
    """
    share = f" or {count}%" if shares else ""
    few = count is not None and count < FEW
    return f"{count} means {count_of(count or 0, 'splat')}; did you mean {count}k{share}?" if few else ""


def parse_budget(text: str) -> Budget:
    """Parse a budget such as "5%" or "500k".

    Raises:
        ValueError: the text is neither a share nor a count, or is out of range (0, or a count beyond `LARGEST`).
    """
    text = text.strip()
    check_grouping(text)
    found = SHARE.fullmatch(text)
    try:
        budget = Budget(text, Fraction(found[1]) / 100, None) if found else Budget(text, None, parse_count(text))
    except ValueError:
        meant = f"; did you mean {100 * float(text):g}%?" if FRACTION.fullmatch(text) and float(text) else ""
        raise ValueError(f"{text!r} is neither a share such as 5% nor a count such as 500k{meant}") from None
    if budget.share == 0:
        raise ValueError(f"a budget of {text} leaves nothing to draw; give more than 0%")
    if budget.count is not None and not 1 <= budget.count <= LARGEST:
        raise ValueError(f"the budget must be from 1 to 2^53, not {text}")
    return budget


def parse_budgets(text: str) -> tuple[Budget, ...]:
    """Parse budgets such as "2%,5%,500k"; raise `ValueError` for an invalid budget, and for an empty list."""
    if GROUPED_LIST.search(text):
        check_grouping(text)
    budgets = tuple(map(parse_budget, filter(None, map(str.strip, text.split(",")))))
    if not budgets:
        raise ValueError(f"{text!r} names no budget, such as 5% or 500k")
    return budgets
