"""Declarations of settings: a dataclass field declares an option, its help, and the check of its value in the API.

Imports nothing heavy, as `--help` reads the declarations.
"""

from __future__ import annotations

import dataclasses
import inspect
import numbers
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

#: Key of the `Setting` in the metadata of a field.
SETTING = "setting"

#: Largest integer that arrays hold.
MOST_WHOLE = (1 << 63) - 1


@dataclass(frozen=True)
class Range:
    """Range of a number.

    Attributes:
        least, most: inclusive ends; None for no end.
        above, below: exclusive ends; None for no end.
        whole: only integers are in the range.
        unit: placeholder for the number in `--help`.
    """

    least: float | None = None
    most: float | None = None
    above: float | None = None
    below: float | None = None
    whole: bool = False
    unit: str = "X"

    def __str__(self) -> str:
        if self.least is not None:
            return f"{self.least} or more" if self.most is None else f"{self.least} to {self.most}"
        ends = (("more than", self.above), ("less than", self.below), ("at most", self.most))
        return " and ".join(f"{words} {end}" for words, end in ends if end is not None)

    def check(self, name: str, value: Any) -> None:
        """Raise TypeError for a value that is not a number, and ValueError for one outside the range."""
        if isinstance(value, bool) or not isinstance(value, numbers.Integral if self.whole else numbers.Real):
            raise TypeError(f"{name} is {value!r}; give a {'whole ' * self.whole}number, {self}")
        number: Any = value  # abstract numbers have no operators for mypy
        if self.whole and abs(number) > MOST_WHOLE:
            raise ValueError(f"{name} is a number of {len(str(abs(number)))} digits, which is too large")
        is_inside = (
            (self.least is None or number >= self.least)
            and (self.most is None or number <= self.most)
            and (self.above is None or number > self.above)
            and (self.below is None or number < self.below)
        )
        if not is_inside or number != number:
            raise ValueError(f"{name} is {value}; give {self}")


def whole(least: int, most: int | None = None, unit: str = "N") -> Range:
    """Return a range of integers."""
    return Range(least, most, whole=True, unit=unit)


@dataclass(frozen=True)
class Quantity:
    """Number or list, given as text with a unit, such as 20Mbit.

    Attributes:
        unit: placeholder for the text in `--help`.
        parse: returns the value of a text, or raises ValueError with a message for the user.
        range: allowed values; None for any.
    """

    unit: str
    parse: Callable[[str], Any]
    range: Range | None = None


@dataclass(frozen=True)
class Setting:
    """Declaration of a setting.

    Attributes:
        help: help text of the option, which also documents the field; it names a default that differs from the value.
        kind: a `Range`, a `Quantity`, a tuple of choices, or a parameter type of the command line; None for text, and
            for flags, whose default is False.
        name: name of the command's parameter, which gives the flag; empty for the name of the field.
        only_api: the command line has no such option.
        attributes: further attributes of the option.
    """

    help: str
    kind: Any = None
    name: str = ""
    only_api: bool = False
    attributes: Mapping[str, Any] = field(default_factory=dict)


def setting(
    help: str, kind: Any = None, default: Any = None, *, name: str = "", only_api: bool = False, **attributes: Any
) -> Any:
    """Return a dataclass field with this default and a `Setting` of the other arguments."""
    declared = Setting(help, kind, name, only_api, attributes)
    return field(default=default, metadata={SETTING: declared})


def settings_in(kind: type[Any]) -> Iterator[tuple[dataclasses.Field[Any], Setting | None]]:
    """Yield the fields of a dataclass that are options, with their declarations, or groups of options, with None."""
    for each in dataclasses.fields(kind):
        declared = each.metadata.get(SETTING)
        if (declared is not None and not declared.only_api) or dataclasses.is_dataclass(each.default_factory):
            yield each, declared


class CheckedSettings:
    """Base of dataclasses of settings, which checks their values and adds the help of the fields to their docstrings.

    Raises:
        TypeError, ValueError: the declaration of a field does not allow its value. Defaults, such as None, are allowed.
    """

    def __init_subclass__(cls) -> None:
        declared = {name: each for name, each in vars(cls).items() if isinstance(each, dataclasses.Field)}
        helps = [f"    {name}: {each.metadata[SETTING].help}" for name, each in declared.items() if each.metadata]
        if helps and cls.__doc__:
            text = inspect.cleandoc(cls.__doc__)
            heading = "" if "\nAttributes:\n" in text else "\n\nAttributes:"
            cls.__doc__ = "\n".join([text + heading, *helps])

    def __post_init__(self) -> None:
        for each in dataclasses.fields(self):  # type: ignore[arg-type]
            declared, value = each.metadata.get(SETTING), getattr(self, each.name)
            if declared is None or value is each.default:
                continue
            allowed = declared.kind.range if isinstance(declared.kind, Quantity) else declared.kind
            if isinstance(allowed, Range):
                allowed.check(each.name, value)
            elif isinstance(allowed, tuple) and value not in allowed:
                noun = (declared.name or each.name).replace("_", " ")
                raise ValueError(f"there is no {noun} {value!r}; give one of {', '.join(map(str, allowed))}")
