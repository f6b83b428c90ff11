"""Declarations of settings: a field of a dataclass makes the option of the command line, its help and the API's check.

Imports nothing heavy: `--help` reads the declarations.
"""

from __future__ import annotations

import dataclasses
import inspect
import numbers
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

#: Key of a `Setting` in the metadata of its field.
SETTING = "setting"

#: Largest integer that arrays hold.
MOST_WHOLE = (1 << 63) - 1


@dataclass(frozen=True)
class Range:
    """Range of a number.

    Attributes:
        least, most: ends that belong to it; None for no end.
        above, below: ends that do not belong to it; None for no end.
        whole: the numbers are integers.
        unit: placeholder of a number in `--help`.
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
        """Raise TypeError unless a value is a number, and ValueError unless it is in the range."""
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
    """Number or list as text with a unit, such as 20Mbit.

    Attributes:
        unit: placeholder of the text in `--help`.
        parse: returns the value of a text, or raises a ValueError that says what is wrong.
        range: of the value; None for any.
    """

    unit: str
    parse: Callable[[str], Any]
    range: Range | None = None


@dataclass(frozen=True)
class Setting:
    """Declaration of a setting.

    Attributes:
        help: of the option, which documents the field, too. It says the default where the value does not.
        kind: a `Range`, a `Quantity`, a tuple of choices, or a parameter type of the command line; None for text, and
            for flags, whose default is False.
        name: of the parameter of a command, from which its flag is made; empty for that of the field.
        only_api: the command line has no such option.
        attributes: further ones of the option.
    """

    help: str
    kind: Any = None
    name: str = ""
    only_api: bool = False
    attributes: Mapping[str, Any] = field(default_factory=dict)


def setting(
    help: str, kind: Any = None, default: Any = None, *, name: str = "", only_api: bool = False, **attributes: Any
) -> Any:
    """Return a dataclass field with a `Setting`, whose attributes the arguments are, and a default value."""
    declared = Setting(help, kind, name, only_api, attributes)
    return field(default=default, metadata={SETTING: declared})


def setting_of(kind: type[Any], name: str, **attributes: Any) -> Any:
    """Return a field with the declaration of a field of another dataclass, and further attributes of the option."""
    declared = next(each for each in dataclasses.fields(kind) if each.name == name)
    own: Setting = declared.metadata[SETTING]
    changed = dataclasses.replace(own, attributes={**own.attributes, **attributes})
    return field(default=declared.default, metadata={SETTING: changed})


def settings_in(kind: type[Any]) -> Iterator[tuple[dataclasses.Field[Any], Setting | None]]:
    """Yield each field of a dataclass that is an option, with its declaration, or a group of options, with None."""
    for each in dataclasses.fields(kind):
        declared = each.metadata.get(SETTING)
        if (declared is not None and not declared.only_api) or dataclasses.is_dataclass(each.default_factory):
            yield each, declared


class CheckedSettings:
    """Base of dataclasses of settings: their values are checked, and their docstrings have the help of the fields.

    Raises:
        TypeError, ValueError: a value is not what its field's declaration allows. A default, such as None, always is.
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
