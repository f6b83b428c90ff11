"""The examples of docs/ci.md and docs/inspect-checks.md do what they say, as far as a shell can tell."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from sparklod_cli.cli import run
from tests.conftest import FIXTURES, ROOT

from .shell import Shell, blocks

pytestmark = pytest.mark.slow

CI = (ROOT / "docs" / "ci.md").read_text(encoding="utf-8")
PAGE = (ROOT / "docs" / "inspect-checks.md").read_text(encoding="utf-8")
HOOKS = (ROOT / ".pre-commit-hooks.yaml").read_text(encoding="utf-8")


def steps(workflow: str) -> dict[str, str]:
    """The scripts of a workflow of GitHub Actions by the names of their steps; knows no more of YAML than it needs."""
    scripts = {}
    for name, indent, first, rest in re.findall(
        r"^ *- name: (.*)\n(?: +(?!run:)\w.*\n)*( +)run: (.*)\n((?:\2 +.*\n)*)", workflow, re.MULTILINE
    ):
        assert indent
        scripts[name] = textwrap.dedent(rest) if first == "|" else first
    return scripts


def settings(hook: str) -> dict[str, str]:
    """The plain values of a hook of pre-commit, by their keys."""
    pairs = re.findall(r"^[ -]*(\w+): (.*?)(?: #.*)?$", hook, re.MULTILINE)
    assert len(dict(pairs)) == len(pairs)
    return dict(pairs)


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A folder as the examples have it, with scenes and the page's expectations."""
    (tmp_path / "scenes").mkdir()
    for name in ("demo", "sh0"):
        shutil.copy(FIXTURES / f"{name}.ply", tmp_path / "scenes")
    (tmp_path / "scenes" / "expect.txt").write_text(blocks(PAGE, "text")[-1])
    return tmp_path


@pytest.fixture
def web(project: Path) -> Path:
    """The trees of the scenes, baked."""
    scenes = map(str, (project / "scenes").glob("*.ply"))
    assert run(["build-lod", *scenes, "--output-dir", str(project / "web"), "-q"]) == 0
    return project / "web"


def spoil(path: Path) -> None:
    """Cuts a file short."""
    path.write_bytes(path.read_bytes()[:-100])


# --- GitHub Actions ---------------------------------------------------------------------------------------------------

STEPS = steps(blocks(CI, "yaml")[0])


def test_every_step_of_the_workflow_succeeds(project: Path, shell: Shell) -> None:
    assert next(iter(STEPS)) == "Install sparklod"
    assert re.fullmatch(r"python -m pip install \./sparklod", STEPS["Install sparklod"])
    for name, script in list(STEPS.items())[1:]:
        done = shell(script)
        assert done.returncode == 0, (name, done.stderr)
        assert "::" not in done.stdout, name
    assert sorted(path.name for path in (project / "web").iterdir()) == ["demo-lod.spz", "sh0-lod.spz"]
    assert (project / "summary.md").read_text().count("leaves") >= 2


def test_the_workflow_stops_at_a_broken_file(web: Path, shell: Shell) -> None:
    spoil(web / "sh0-lod.spz")
    done = shell(STEPS["Check"])
    assert done.returncode == 3
    assert re.fullmatch(r"::error file=web/sh0-lod\.spz,title=container\.[\w-]+::.+\n", done.stdout)
    assert shell(STEPS["Hold to the budget"]).returncode == 3


def test_the_workflow_stops_beyond_the_budget(web: Path, shell: Shell) -> None:
    script = STEPS["Hold to the budget"].replace("2MB", "10kB")
    assert script != STEPS["Hold to the budget"]
    done = shell(script)
    assert done.returncode == 3
    assert re.fullmatch(r"::error file=web/demo-lod\.spz,title=expect\.bytes::.+\n", done.stdout)


def test_the_workflow_stops_at_leaves_of_another_original(project: Path, web: Path, shell: Shell) -> None:
    shutil.copy(FIXTURES / "needle.ply", project / "scenes" / "sh0.ply")
    done = shell(STEPS["Compare with the originals"])
    assert done.returncode == 3
    assert "file=web/sh0-lod.spz,title=expect.leaves::" in done.stdout


# --- The action -------------------------------------------------------------------------------------------------------


def run_action(shell: Shell, action: dict[str, str] | None = None, **more: str) -> subprocess.CompletedProcess[str]:
    """Run the body of the action with the inputs of docs/ci.md or of other settings, as GitHub calls it."""
    given = action or ACTION
    inputs = {name.upper(): value for name, value in given.items() if name in ("scenes", "options", "checks")} | more
    words = [f"{name}={shlex.quote(value)}" for name, value in {**inputs, "GITHUB_OUTPUT": "out"}.items()]
    return shell(
        " ".join([*words, f"PYTHON={shlex.quote(sys.executable)}", shlex.quote(str(ROOT / "action" / "check"))])
    )


def test_the_action_bakes_checks_and_reports(project: Path, shell: Shell) -> None:
    done = run_action(shell)
    assert done.returncode == 0, done.stderr
    assert not re.search("^::(error|warning)", done.stdout, re.MULTILINE)
    assert (project / "out").read_text() == "report=web/report.jsonl\n"
    reports = [json.loads(line) for line in (project / "web" / "report.jsonl").read_text().splitlines()]
    assert [report["file"] for report in reports] == ["web/demo-lod.spz", "web/sh0-lod.spz"]
    assert (project / "summary.md").read_text().count("leaves") >= 2


def test_the_action_of_the_tutorial_bakes_and_checks(project: Path, shell: Shell) -> None:
    (action,) = blocks((ROOT / "docs" / "tutorials" / "pipeline.md").read_text(encoding="utf-8"), "yaml")
    done = run_action(shell, settings(action))
    assert done.returncode == 0, done.stderr
    assert {path.name for path in (project / "web").glob("*.rad")} == {"demo-lod.rad", "sh0-lod.rad"}


def test_the_action_looks_at_all_files_before_it_fails(project: Path, shell: Shell) -> None:
    done = run_action(shell, CHECKS="--check --assert bytes<=1000")
    assert done.returncode == 3
    assert re.findall(r"^::error file=web/(\w+)-lod\.spz,title=expect\.bytes::", done.stdout, re.MULTILINE) == [
        "demo",
        "sh0",
    ]
    assert len((project / "web" / "report.jsonl").read_text().splitlines()) == 2


def test_the_action_refuses_patterns_without_files_and_runs_no_names(project: Path, shell: Shell) -> None:
    done = run_action(shell, SCENES="scans/*.ply")
    assert (done.returncode, done.stderr) == (1, "no file matches scans/*.ply\n")
    odd = project / "odd"
    odd.mkdir()
    shutil.copy(FIXTURES / "sh0.ply", odd / "$(touch run); a b.ply")
    assert run_action(shell, SCENES="odd/*.ply", OPTIONS="--up -y", COMPARE="false").returncode == 0
    assert not (project / "run").exists()


def test_the_action_has_the_inputs_that_its_body_reads() -> None:
    action = (ROOT / "action.yml").read_text("utf-8")
    inputs = re.findall(r"^  ([\w-]+):$", action.partition("\noutputs:")[0], re.MULTILINE)
    assert set(ACTION) - {"uses", "with"} <= set(inputs)
    body = (ROOT / "action" / "check").read_text("utf-8")
    for name in set(inputs) - {"python-version"}:
        assert f"${{{{ inputs.{name} }}}}" in action
        assert f"${{{name.replace('-', '_').upper()}" in body


# --- pre-commit -------------------------------------------------------------------------------------------------------

OURS = settings(HOOKS)
ACTION, THEIRS, LOCAL = map(settings, blocks(CI, "yaml")[1:])


def test_hooks_name_what_there_is() -> None:
    assert THEIRS["id"] == OURS["id"]
    assert re.search(r"^\[project\.scripts\]\nsparklod = ", (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    for hook in (OURS, LOCAL):
        assert shlex.split(hook["entry"])[:3] == ["sparklod", "inspect", "--check"]


@pytest.mark.parametrize("name", ["scene.spz", "web/scene-lod.spz", "a b/c.d.spz", "scene-lod.rad"])
@pytest.mark.parametrize("files", [OURS["files"], LOCAL["files"]])
def test_hooks_look_at_splat_files(files: str, name: str) -> None:
    assert re.search(files, name)


@pytest.mark.parametrize(
    "name", ["scene.spz.md", "spz", "scenespz", "scene.spz/readme", "splat.py", "x.plyx", "a-0.radc"]
)
@pytest.mark.parametrize("files", [OURS["files"], LOCAL["files"]])
def test_hooks_leave_other_files_alone(files: str, name: str) -> None:
    assert not re.search(files, name)


@pytest.mark.parametrize("hook, more", [(OURS, THEIRS["args"]), (LOCAL, "")], ids=["ours with arguments", "local"])
def test_a_hook_passes_good_files_and_fails_on_spoilt_ones(
    web: Path, shell: Shell, hook: dict[str, str], more: str
) -> None:
    """As pre-commit puts them together: the entry, its arguments, the files."""
    arguments = [word.strip().strip('"') for word in more.strip("[]").split(",") if word]
    command = [*shlex.split(hook["entry"]), *arguments, "web/demo-lod.spz", "web/sh0-lod.spz"]
    done = shell(shlex.join(command))
    assert (done.returncode, done.stdout) == (0, "")
    spoil(web / "sh0-lod.spz")
    done = shell(shlex.join(command))
    assert done.returncode == 3
    assert done.stdout.startswith("web/sh0-lod.spz: error: container.")


def test_a_pointer_of_git_lfs_is_no_splat_file(project: Path, shell: Shell) -> None:
    pointer = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 123\n"
    (project / "scene.spz").write_text(pointer)
    done = shell(f"{OURS['entry']} scene.spz")
    assert done.returncode == 3
    assert "error: file.format: " in done.stdout


# --- Make and the shell -----------------------------------------------------------------------------------------------


def test_the_makefile_bakes_once_and_deletes_what_falls_short(project: Path, shell: Shell) -> None:
    if shutil.which("make") is None:
        pytest.skip("there is no make")
    (project / "Makefile").write_text(blocks(CI, "make")[0])
    done = shell("make")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("build-lod") == 2
    assert "build-lod" not in shell("make").stdout
    (project / "scenes" / "expect.txt").write_text("growth<=1\n")
    done = shell("make", "-k")
    assert done.returncode == 2
    assert done.stdout.count("expect.growth") == 2
    assert not list((project / "web").iterdir())


def test_the_script_bakes_and_reports(project: Path, web: Path, shell: Shell) -> None:
    script = blocks(CI, "sh")[0]
    done = shell(script)
    assert (done.returncode, done.stderr) == (0, "")
    assert "web/demo-lod.spz has 27800 splats\n" in done.stdout
    reports = [json.loads(line) for line in (project / "web" / "report.jsonl").read_text().splitlines()]
    assert [report["tree"]["leaves"] for report in reports] == [27800, 60]


def test_the_script_stops_at_a_broken_tree(web: Path, shell: Shell) -> None:
    script = blocks(CI, "sh")[0]
    check = script[script.index("status=0") :]
    assert check != script
    spoil(web / "sh0-lod.spz")
    done = shell(check)
    assert done.returncode == 3
    assert "stay here" in done.stderr
    assert shell(script).returncode == 1  # there is no number of leaves to print


def test_the_script_for_streamed_files_bakes_and_checks(project: Path, shell: Shell) -> None:
    script = blocks(CI, "sh")[1]
    done = shell(script)
    assert (done.returncode, done.stdout) == (0, "")
    assert len((project / "web" / "demo-lod.rad.csv").read_text().splitlines()) == 2
    done = shell(script.replace("first_bytes<2MB", "first_bytes<20kB"))
    assert done.returncode == 3
    assert "expect.value: first_bytes<20kB" in done.stdout


# --- Expectations -----------------------------------------------------------------------------------------------------


def test_expectations_on_the_page_can_be_read(web: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = web / "expect.txt"
    path.write_text(blocks(PAGE, "text")[-1])
    assert run(["inspect", str(web / "demo-lod.spz"), str(web / "sh0-lod.spz"), "--expect", str(path)]) == 0
    assert capsys.readouterr().out == ""
    assert run(["inspect", str(FIXTURES / "golden" / "tree-v2.spz"), "--expect", str(path)]) == 3


@pytest.mark.parametrize(
    "path",
    [*(ROOT / ".github" / "workflows").iterdir(), ROOT / "action.yml", ROOT / "docs" / "ci.md"],
    ids=lambda path: path.name,
)
def test_actions_of_others_are_pinned_to_a_commit(path: Path) -> None:
    # A tag can be moved to other code by whoever controls the action's repository.
    used = re.findall(r"^\s*(?:- )?uses: (.*)$", path.read_text(), re.MULTILINE)
    others = [each for each in used if not each.startswith(("./", "OWNER/sparklod@"))]
    assert others
    for each in others:
        assert re.match(r"[\w.-]+/[\w.-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+", each), each
