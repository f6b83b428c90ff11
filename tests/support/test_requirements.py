"""What is required is read from the metadata of what is installed."""

from __future__ import annotations

import sys
from importlib import metadata

import pytest

from sparklod_cli.support.requirements import Required, required_by

LINES = {
    "sparklod": [
        "numpy>=1.26",
        "any-version",
        "old-python>=1.0; python_version < '3.0'",
        f"this-python>=1.0; python_version < '3.{sys.version_info[1] + 1}'",
        'films[ffmpeg,other]>=2.31; extra == "video"',
        'tests>=1; extra == "test"',
    ],
    "films": ["base", "encoder>=3 ; extra == 'ffmpeg'", "numpy; extra == 'all-plugins'"],
}
VERSIONS = {"numpy": "1.25.9", "any-version": "0", "this-python": "1.0.dev2", "films": "10.0"}


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        if name not in VERSIONS:
            raise metadata.PackageNotFoundError(name)
        return VERSIONS[name]

    monkeypatch.setattr(metadata, "requires", LINES.get)
    monkeypatch.setattr(metadata, "version", version)


def test_markers_decide_what_is_required() -> None:
    assert list(required_by("sparklod")) == [
        Required("numpy", "1.26", "1.25.9"),
        Required("any-version", "", "0"),
        Required("this-python", "1.0", "1.0.dev2"),
    ]


def test_an_extra_requires_its_own_and_the_extras_of_those() -> None:
    assert list(required_by("sparklod", "video")) == [Required("films", "2.31", "10.0"), Required("encoder", "3", None)]


@pytest.mark.parametrize(
    ("least", "version", "found"),
    [
        ("1.26", "1.26", "1.26"),
        ("1.26", "1.26.4", "1.26.4"),
        ("", "0", "0"),
        ("2.9", "2.10", "2.10"),
        ("1.26", "1.25.9", "1.25.9, older than 1.26"),
        ("1.26", None, "is missing"),
    ],
)
def test_versions_compare_as_numbers(least: str, version: str | None, found: str) -> None:
    required = Required("numpy", least, version)
    assert required.found == found
    assert required.missing == (found != version)
