"""What the documents promise of themselves."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import click
import pytest

from sparklod_cli import io
from sparklod_cli.cameras import frame
from sparklod_cli.cli import COMMANDS, cli
from sparklod_cli.cli import run as cli_run
from sparklod_cli.codecs import compression
from sparklod_cli.inspection import tree
from sparklod_cli.support import printable, untrusted
from tests.conftest import FIXTURES, ROOT


@pytest.mark.parametrize("page", sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("*.md")))
def test_every_link_leads_to_a_file_or_the_web(page: str) -> None:
    for link in re.findall(r"\]\(([^)#]+)\)", (ROOT / page).read_text()):
        assert link.startswith("https://") or (ROOT / link).exists(), link


def test_the_readmes_program_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert code
    (tmp_path / "scene.ply").write_bytes((FIXTURES / "sh1.ply").read_bytes())
    monkeypatch.chdir(tmp_path)
    exec(code[1], {})
    assert (tmp_path / "scene-lod.spz").exists()


def test_the_readmes_first_line_can_be_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its last command at least, in a folder that has our fixtures; what it writes is no news to git."""
    block = re.search(r"## Try it\n.*?```sh\n(.*?)\n```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert block
    command = shlex.split(block[1].rpartition("&&")[2])
    assert command.pop(0).endswith("/sparklod")
    (tmp_path / "fixtures").symlink_to(FIXTURES)
    monkeypatch.chdir(tmp_path)
    assert [cli_run(command), cli_run(command)] == [0, 0]
    (written,) = (path.name for path in tmp_path.iterdir() if path.name != "fixtures")
    assert f"/{written}" in (ROOT / ".gitignore").read_text().splitlines()


def test_the_figures_of_security_are_those_of_the_code() -> None:
    text = " ".join((ROOT / "SECURITY.md").read_text().split())
    for said in (
        f"promises more than {compression.TRUSTED_SIZE >> 20} MiB",
        f"at most {compression.MAX_RATIO} times what the file has",
        f"read up to {io.MAX_TEXT >> 20} MiB and {untrusted.MAX_DEPTH} levels deep",
        f"shortened to {printable.MOST} characters",
    ):
        assert said in text
    assert (tree.MAX_DEPTHS, frame.MAX_FRAMES) == (1000, 1 << 20)
    assert "a thousand levels" in text
    assert "(a million at most)" in text


def test_the_readme_quotes_the_help() -> None:
    """Made by `python -m tests.docs.test_docs`."""
    text = (ROOT / "README.md").read_text()
    assert with_help(text) == text


def with_help(text: str) -> str:
    """The README with what `--help` says of each command in the first block of its section."""
    for name in COMMANDS:
        pattern = re.compile(rf"(?<=\n## {name}\n\n```\n).*?(?=\n```\n)", re.DOTALL)
        assert pattern.search(text), name
        text = pattern.sub(lambda _, name=name: help_of(name), text, count=1)
    return text


def help_of(name: str) -> str:
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    width = {"terminal_width": 100, "max_content_width": 100}
    parent = click.Context(cli, info_name="sparklod", **cli.context_settings)
    context = click.Context(command, info_name=name, parent=parent, **width, **command.context_settings)
    return command.get_help(context)


if __name__ == "__main__":
    (ROOT / "README.md").write_text(with_help((ROOT / "README.md").read_text()))
