"""What systems other than Linux lack has another way: locks, unnamed files, affinity, positioned reads, UTF-8."""

from __future__ import annotations

import ast
import ctypes
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import sparklod_cli
from sparklod_cli.system import machine, threads
from tests.conftest import FIXTURES, ROOT

PACKAGE = Path(sparklod_cli.__file__).parent

#: Runs command lines without what Windows lacks, and says at last on standard error how each ended. The standard
#: library needs the name of the system and O_NONBLOCK.
PROGRAM = """
import ctypes, json, os, signal, sys
for name in ("O_TMPFILE", "O_CLOEXEC", "O_NOFOLLOW", "O_DIRECTORY", "fchmod", "fork", "geteuid", "getuid", "killpg",
             "pread", "pwrite", "posix_fadvise", "register_at_fork", "sched_getaffinity", "sysconf"):
    if hasattr(os, name):
        delattr(os, name)
for name in ("SIGHUP", "SIGKILL", "pthread_kill", "pthread_sigmask"):
    delattr(signal, name)
for name in ("fcntl", "grp", "pwd", "resource", "termios"):
    sys.modules[name] = None
from sparklod_cli.cli import run
{more}
print([run(command) for command in json.loads(sys.argv[1])], file=sys.stderr)
"""

#: Lets a scene of 27,800 splats be too large for 3.2 MB of memory.
SMALL_BLOCKS = """
from sparklod_cli.bake import estimate
estimate.PROCESS = estimate.WINDOW = estimate.FAMILIES = 0
estimate.LEAST_BLOCK_SPLATS = 1 << 12
"""

#: Names of Python 3.11 and later that a module must not import when it runs, by the module that has them.
NEWER = {
    "asyncio": {"TaskGroup", "timeout"},
    "contextlib": {"chdir"},
    "datetime": {"UTC"},
    "enum": {"ReprEnum", "StrEnum"},
    "itertools": {"batched"},
    "typing": {"LiteralString", "Never", "NotRequired", "Required", "Self", "Unpack", "assert_never", "override"},
}


def elsewhere(*commands: tuple[object, ...], more: str = "") -> tuple[list[int], subprocess.CompletedProcess[bytes]]:
    """Return how commands ended, and the process that ran them."""
    environment = os.environ | {"PYTHONIOENCODING": "cp1252", "PYTHONPATH": str(ROOT), "PYTHONUTF8": "0"}
    words = json.dumps([[*map(str, command)] for command in commands])
    line = [sys.executable, "-c", PROGRAM.replace("{more}", more), words]
    done = subprocess.run(line, env=environment, capture_output=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return json.loads(done.stderr.splitlines()[-1]), done


@pytest.mark.parametrize("output", ["out.spz", "out.rad", "set/lod-meta.json"])
def test_bakes_do_without_what_windows_lacks(output: str, tmp_path: Path) -> None:
    target = tmp_path / output
    bake = "build-lod", FIXTURES / "sh1.ply", "-o", target
    codes, done = elsewhere(bake, (*bake, "--overwrite"), ("inspect", target, "--check"), bake)
    assert codes == [0, 0, 0, 1], done.stderr.decode()  # at last, it exists
    assert not list(tmp_path.rglob(".*"))


def test_bakes_out_of_core_do_without_it_too(tmp_path: Path) -> None:
    target = tmp_path / "out.rad"
    arguments = ("build-lod", FIXTURES / "demo.ply", "-o", target, "--memory", "3.2M", "-v")
    codes, done = elsewhere(arguments, more=SMALL_BLOCKS)
    assert codes == [0], done.stderr.decode()
    assert b"out of core" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["out.rad"]


def test_consoles_without_utf8_show_escapes(tmp_path: Path) -> None:
    scene = tmp_path / "caf\u00e9 \u96ea.ply"
    scene.write_bytes((FIXTURES / "sh1.ply").read_bytes())
    codes, done = elsewhere(("inspect", scene), ("build-lod", scene, "-o", tmp_path / "\u96ea" / "out.txt"))
    assert codes == [0, 2], done.stderr
    assert "caf\u00e9 \\u96ea.ply" in done.stdout.decode("cp1252")
    assert "Traceback" not in done.stderr.decode("cp1252")


def test_all_processors_are_used_where_no_affinity_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 5)
    assert threads.processors() == 5


def test_memory_is_unknown_where_nothing_tells_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "_text", lambda path: "")
    monkeypatch.delattr(os, "sysconf", raising=False)
    assert (machine.total_memory(), machine.available_memory()) == (None, None)


def test_memory_is_released_where_the_c_library_can(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(name: Any) -> None:
        raise TypeError("bad argument type for built-in operation")  # of Windows, for None

    monkeypatch.setattr(ctypes, "CDLL", refuse)
    machine.release_memory()


def imported(path: Path) -> set[str]:
    """Return the names that a module imports when it runs, and their modules: "typing.Self"."""
    module = ast.parse(path.read_text("utf-8"))
    nodes = list(ast.walk(module))
    for node in nodes:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body.clear()
    froms = [node for node in ast.walk(module) if isinstance(node, ast.ImportFrom) and not node.level]
    return {f"{node.module}.{alias.name}" for node in froms for alias in node.names}


def test_modules_import_what_python_3_10_has() -> None:
    newer = {f"{module}.{name}" for module, names in NEWER.items() for name in names}
    found = {path.relative_to(PACKAGE).as_posix(): imported(path) & newer for path in PACKAGE.rglob("*.py")}
    assert {path: names for path, names in found.items() if names} == {}
