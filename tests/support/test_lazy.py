"""Packages that load what they offer when it is first asked for."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from sparklod_cli import bake, io
from sparklod_cli.api import bake_jobs

PACKAGES = (bake, bake_jobs, io)


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.__name__)
def test_names_are_those_that_type_checkers_are_told(package: ModuleType) -> None:
    assert package.__file__ is not None
    (told,) = (node for node in ast.parse(Path(package.__file__).read_text()).body if _is_for_type_checkers(node))
    parent = package.__name__ if package.__file__.endswith("__init__.py") else package.__name__.rpartition(".")[0]
    found: dict[str, set[str]] = {}
    for node in told.body:
        assert isinstance(node, ast.ImportFrom)
        home = ".".join([*parent.split(".")[1 : len(parent.split(".")) + 1 - node.level], node.module or ""])
        found.setdefault(home, set()).update(alias.name for alias in node.names)
    assert found == {module: set(names) for module, names in package._NAMES.items()}
    for names in package._NAMES.values():
        for name in names:
            assert getattr(package, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        package.nothing  # noqa: B018


def _is_for_type_checkers(node: ast.stmt) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def test_a_bake_of_a_ply_loads_no_other_reader(tmp_path: Path) -> None:
    """Nor what only bakes out of core, of other outputs, or of several files need."""
    scene = Path(__file__).parents[2] / "fixtures" / "sh3.ply"
    code = f"""
import sys
from sparklod_cli import cli
assert cli.run(["build-lod", {str(scene)!r}, "-o", {str(tmp_path / "tree.spz")!r}, "-q"]) == 0
print(*sorted(sys.modules))
"""
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "sparklod_cli.codecs.ply" in loaded
    others = (
        "cameras.pose",
        "codecs.sog.sog_container",
        "codecs.streamed_sog.manifest",
        "codecs.rad.codec",
        "codecs.gpu.dump",
    )
    others += ("bake.out_of_core.cluster", "bake.out_of_core.flow", "bake.skipping", "scenes.instances_file")
    assert {f"sparklod_cli.{name}" for name in others}.intersection(loaded) == set()
    assert "PIL" not in loaded
