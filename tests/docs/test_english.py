"""Docstrings name their subject in the first line, classes have names of their own, and modules import in no circle."""

from __future__ import annotations

import ast
import graphlib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

import sparklod_cli

PACKAGE = Path(sparklod_cli.__file__).parent

#: Beginnings of first lines that leave out what the docstring is about.
RIDDLES = (
    "What", "Whose", "Where", "Which", "Those", "How", "All that", "That of", "Of ", "Some", "Each", "Own ",
)  # fmt: skip

Documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def nodes_of(root: Path) -> Iterator[tuple[str, Documented]]:
    """Yield what can have a docstring, in all modules under a folder, with the module's path."""
    for path in sorted(root.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, Documented):
                yield path.relative_to(root).as_posix(), node


def riddles(root: Path) -> dict[str, list[str]]:
    """Return the places of docstrings that begin with a riddle, as "file:line: text", by file and name."""
    places = defaultdict(list)
    for file, node in nodes_of(root):
        text = ast.get_docstring(node)
        if text and text.startswith(RIDDLES):
            name = "" if isinstance(node, ast.Module) else f" {node.name}"
            places[file + name].append(f"{file}:{node.body[0].lineno}: {text.splitlines()[0]}")
    return places


def shared_names(root: Path) -> dict[str, list[str]]:
    """Return the places of classes that share a name, as "file:line: name", by name."""
    places = defaultdict(list)
    for file, node in nodes_of(root):
        if isinstance(node, ast.ClassDef):
            places[node.name].append(f"{file}:{node.lineno}: {node.name}")
    return {name: where for name, where in places.items() if len(where) > 1}


def listed(places: list[str]) -> str:
    return "\n".join(["", *places])


def test_first_lines_are_no_riddles() -> None:
    new = [place for places in riddles(PACKAGE).values() for place in places]
    assert not new, f"first lines that do not name their subject:{listed(new)}"


def test_no_two_classes_share_a_name() -> None:
    shared = [place for places in shared_names(PACKAGE).values() for place in places]
    assert not shared, f"classes that share a name:{listed(shared)}"


@pytest.mark.parametrize(
    ("source", "name", "line"),
    [
        ('"""What there is."""\n', "a.py", 1),
        ('class A:\n    """Those of a scene."""\n', "a.py A", 2),
        ('class A:\n    def b(self):\n        """\n        Of all.\n        """\n', "a.py b", 3),
        ('async def b():\n    """Where it is."""\n', "a.py b", 2),
    ],
)
def test_riddles_are_found(tmp_path: Path, source: str, name: str, line: int) -> None:
    (tmp_path / "a.py").write_text(source)
    ((found, places),) = riddles(tmp_path).items()
    assert found == name and len(places) == 1 and places[0].startswith(f"a.py:{line}: ")


def test_shared_names_are_found(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("class A: pass\nclass B: pass\n")
    (tmp_path / "b.py").write_text("def f():\n    class A: pass\n")
    assert shared_names(tmp_path) == {"A": ["a.py:1: A", "b.py:2: A"]}


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
