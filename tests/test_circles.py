"""Modules import each other in no circle, also not inside functions or for annotations alone."""

from __future__ import annotations

import ast
import graphlib
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "sparklod_cli"


def module_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_of(path: Path, modules: set[str]) -> Iterator[str]:
    """Yield the modules of the package that a module imports, wherever the statement stands."""
    package = path.relative_to(PACKAGE.parent).parent.parts
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level:
            origin = [*package[: len(package) - node.level + 1], *(node.module.split(".") if node.module else ())]
            for alias in node.names:
                name = ".".join([*origin, alias.name])
                yield name if name in modules else ".".join(origin)


def test_no_modules_import_each_other_in_a_circle() -> None:
    paths = {module_of(path): path for path in PACKAGE.rglob("*.py")}
    graph = {name: set(imports_of(path, set(paths))) - {name} for name, path in paths.items()}
    assert sum(map(len, graph.values())) > len(paths), "imports are not recognised"
    list(graphlib.TopologicalSorter(graph).static_order())  # raises CycleError, which names the circle
