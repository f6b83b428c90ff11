"""Reports that tests of expectations share."""

from __future__ import annotations

import pytest

from sparklod_cli.inspection.report import Report, ReportSettings, inspect
from tests.inspection.expected import PLAIN, TREE


@pytest.fixture(scope="module")
def tree() -> Report:
    return inspect(TREE, ReportSettings(values=True, all_quantities=True))[0]


@pytest.fixture(scope="module")
def plain() -> Report:
    return inspect(PLAIN, ReportSettings(values=True))[0]
