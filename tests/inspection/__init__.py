"""Reports on scenes in memory, for tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sparklod_cli.inspection.findings import Finding, ReportBlocks
from sparklod_cli.inspection.report import Report, ReportSettings, report_on
from sparklod_cli.inspection.tree import TreeFacts
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats


def report_of(scene: Scene, **settings: Any) -> Report:
    return report_on(Path("scene"), ReportBlocks.of(scene), ReportSettings(**settings))


def examine_tree(splats: Splats, tree: LodTree) -> tuple[TreeFacts, list[Finding]]:
    """Facts of a tree, and the findings about it alone."""
    report = report_of(Scene(splats, tree), check=True)
    assert report.tree is not None
    return report.tree, [each for each in report.findings or [] if each.code.startswith("tree.")]
