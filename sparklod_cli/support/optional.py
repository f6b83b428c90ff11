"""Packages that sparklod and its extras require: whether they are met, by metadata alone, and how to install them."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from .errors import SparklodError

#: Folder that this package is in: a checkout, or one of installed packages.
_HOME = Path(__file__).parents[2]

#: Name of this distribution, for pip.
DISTRIBUTION = "sparklod"

#: Variables that name the active environment, where "pip" is that of this interpreter.
_ENVIRONMENTS = ("VIRTUAL_ENV", "CONDA_PREFIX")


@contextlib.contextmanager
def optional_import(
    purpose: str, extra: str = "", error: type[SparklodError] = SparklodError, *, package: str = ""
) -> Iterator[None]:
    """Turn failed imports inside into an error that says what to install.

    The import stays a statement, so that type checkers and import-linter see it.

    Args:
        purpose: what takes the package, and which one: "charts are drawn by matplotlib".
        extra: the extra that brings it: "render".
        package: what pip installs, if no extra brings it.

    Raises:
        SparklodError: the package is not installed, or does not load; of the class `error`.
    """
    try:
        yield
    except ImportError as reason:
        hint = pip_install(package) if package else install_hint(extra)
        raise error(f"{purpose}: {hint} ({reason})") from None


def pip_install(*arguments: str) -> str:
    """Return a command line that has the pip of this interpreter install something."""
    import shlex

    is_active = any(os.environ.get(name) == sys.prefix for name in _ENVIRONMENTS)
    pip = ["pip"] if is_active else [sys.executable, "-m", "pip"]
    return shlex.join([*pip, "install", *arguments])


def install_hint(extra: str = "", *options: str) -> str:
    """Return a command line that installs what this installation of sparklod, or one of its extras, requires.

    No package index is known to have sparklod. So the command names the checkout that it was installed from, or else
    the packages that are missing.

    Args:
        extra: name of the extra; empty for what sparklod always requires.
    """
    from importlib import metadata  # takes long to load

    checkout = _checkout()
    if checkout is not None:
        editable = ["-e"] if checkout == _HOME else []
        return pip_install(*options, *editable, f"{checkout}[{extra}]" if extra else str(checkout))
    try:
        required = list(required_by(DISTRIBUTION, extra))
    except metadata.PackageNotFoundError:
        what = f"the extra {extra} of sparklod" if extra else "sparklod"
        return f"install {what} with pip, from a checkout of its repository"
    missing = [one for one in required if one.missing] or required
    return pip_install(*options, *(f"{one.name}>={one.least}" if one.least else one.name for one in missing))


def _checkout() -> Path | None:
    """Return the folder of the repository that this package is in, or was installed from, if there is one."""
    import json
    from importlib import metadata
    from urllib.parse import unquote, urlsplit

    folders = [_HOME]
    with contextlib.suppress(metadata.PackageNotFoundError, ValueError, AttributeError):
        source = json.loads(metadata.distribution(DISTRIBUTION).read_text("direct_url.json") or "{}")
        address = urlsplit(source.get("url", ""))
        if address.scheme == "file" and "dir_info" in source:
            folders.append(Path(unquote(address.path)))
    return next((folder for folder in folders if (folder / "pyproject.toml").is_file()), None)


@dataclass(frozen=True)
class Required:
    """A distribution that another one requires.

    Attributes:
        least: the minimum version; empty for any.
        version: the installed version; None if it is not installed.
    """

    name: str
    least: str
    version: str | None

    @property
    def missing(self) -> bool:
        """Whether it has to be installed or upgraded."""
        from packaging.version import Version

        return self.version is None or bool(self.least and Version(self.version) < Version(self.least))

    @property
    def state(self) -> str:
        """Return the state for display: "2.4.6", "is missing", or "1.20, older than 1.26"."""
        if self.version is None:
            return "is missing"
        return f"{self.version}, older than {self.least}" if self.missing else self.version


def required_by(distribution: str, extra: str = "") -> Iterator[Required]:
    """Yield the requirements of an installed distribution or, if an extra is given, those of the extra alone.

    Raises:
        importlib.metadata.PackageNotFoundError: the distribution is not installed.
    """
    from importlib import metadata  # takes long to load

    from packaging.requirements import Requirement

    for line in metadata.requires(distribution) or []:
        requirement = Requirement(line)
        is_basic, is_of_extra = (
            requirement.marker is None or requirement.marker.evaluate({"extra": name}) for name in ("", extra)
        )
        if not is_of_extra or (extra and is_basic):
            continue
        least = next((each.version for each in requirement.specifier if each.operator == ">="), "")
        try:
            version = metadata.version(requirement.name)
        except metadata.PackageNotFoundError:
            yield Required(requirement.name, least, None)
            continue
        yield Required(requirement.name, least, version)
        for inner in sorted(requirement.extras):
            yield from required_by(requirement.name, inner)
