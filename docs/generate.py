"""Write the generated parts of the documentation: `python docs/generate.py`. CI fails if that changes a file.

Pages of docs/cli are the help of the commands. In other pages, a table between `<!-- generated: NAME -->` and
`<!-- end -->` is written by the function of that name in `TABLES`. The pages of performance come from the committed
figures, and the chart of chunk orders from the table of docs/streaming-measured.md.
"""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import click

import sparklod_cli
from sparklod_cli.api import comparison
from sparklod_cli.cameras.camera_formats import FORMATS as CAMERA_FORMATS
from sparklod_cli.cli import cli
from sparklod_cli.commands.command import Command
from sparklod_cli.inspection.findings import CODES
from sparklod_cli.simulation import results
from sparklod_cli.tables.columns import Column

DOCS = Path(__file__).resolve().parent

#: Width in columns that help is wrapped to.
WIDTH = 100

#: A generated table, with its name and the arguments of its function.
MARKED = re.compile(r"(<!-- generated: (\w+)([\w -]*) -->\n).*?(<!-- end -->)", re.DOTALL)


# --- Tables in pages --------------------------------------------------------------------------------------------------


def table(heading: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Format a Markdown table."""
    lines = [heading, ["---"] * len(heading), *rows]
    return "".join(f"| {' | '.join(line)} |\n".replace("|  |", "| |") for line in lines)


def columns_of_frames() -> str:
    """Make the table of the columns of `traverse`."""
    kinds = {int: "whole", float: "number", str: "text"}
    rows = ([f"`{each.name}`", kinds[each.kind], each.unit, each.meaning] for each in results.COLUMNS)
    return table(["column", "type", "unit", "meaning"], rows)


def columns_of_comparisons() -> str:
    """Make the table of the columns of `render --compare`."""
    return _columns(comparison.COLUMNS)


def columns_of_loading() -> str:
    """Make the table of the waiting times in the summary of `traverse --bandwidth`."""
    return _columns(results.LOADING)


def _columns(columns: Iterable[Column]) -> str:
    return table(["column", "unit", "meaning"], ([f"`{each.name}`", each.unit, each.meaning] for each in columns))


def camera_formats() -> str:
    """Make the table of the formats of camera paths and their axes."""
    rows = (
        [f"`{each.name}`", each.title, f"`{each.axes.value}`" if each.axes else "eye and target"]
        for each in CAMERA_FORMATS
    )
    return table(["name", "file", "axes"], rows)


def findings(*groups: str) -> str:
    """Make the table of the kinds of findings whose codes begin with one of some groups, such as "file"."""
    rows = (
        [f"`{code}`", severity, meaning]
        for code, (severity, meaning) in CODES.items()
        if code.partition(".")[0] in groups
    )
    return table(["code", "severity", "meaning"], rows)


def public_names() -> str:
    """Make the table of the public API, with the first line of each docstring."""
    rows = []
    for name in sparklod_cli.__all__:
        described = inspect.getdoc(getattr(sparklod_cli, name)) or ""
        rows.append([f"`{name}`", described.splitlines()[0].rstrip(".") if described else ""])
    return table(["name", "purpose"], rows)


TABLES: dict[str, Callable[..., str]] = {
    each.__name__: each
    for each in (
        columns_of_frames,
        columns_of_comparisons,
        columns_of_loading,
        camera_formats,
        findings,
        public_names,
    )
}


def with_tables(text: str) -> str:
    """Return a page with its generated tables."""
    return MARKED.sub(lambda mark: f"{mark[1]}\n{TABLES[mark[2]](*mark[3].split())}\n{mark[4]}", text)


# --- Pages of commands ------------------------------------------------------------------------------------------------

INDEX = """\
# Commands

```text
{help}
```

| command | purpose |
| --- | --- |
{rows}

Data goes to standard output, messages to standard error. Outputs appear whole or not at all, and existing ones are
replaced only with `--overwrite`. [Installation](../install.md#shell-completion) has shell completion. These pages have
all options, as `--help-all` prints them; `--help` lists those that most people need.
"""

PAGE = """\
# {name}

```text
{help}
```
"""


def command_pages() -> dict[str, str]:
    """Return the text of each page of docs/cli by its file name."""
    names = cli.list_commands(click.Context(cli))
    rows = "\n".join(f"| [`{name}`]({name}.md) | {_command(name).get_short_help_str(WIDTH)} |" for name in names)
    pages = {"index.md": INDEX.format(help=_help(cli), rows=rows)}
    return pages | {f"{name}.md": PAGE.format(name=name, help=_help(_command(name), name)) for name in names}


def _command(name: str) -> Command:
    command = cli.get_command(click.Context(cli), name)
    assert isinstance(command, Command)
    return command


def _help(command: click.Command, name: str | None = None) -> str:
    """Return what `--help-all` prints for a command, or `--help` for the program, whatever the terminal's width."""
    width = {"terminal_width": WIDTH, "max_content_width": WIDTH}
    parent = click.Context(cli, info_name="sparklod", **width, **cli.context_settings)
    if not isinstance(command, Command):
        return command.get_help(parent)
    context = click.Context(command, info_name=name, parent=parent, **width, **command.context_settings)
    return command.get_help(context, whole=True)


# --- The chart of docs/streaming-measured.md --------------------------------------------------------------------------

#: Width of the names and of the longest bar, and height of a row, in pixels.
NAMES, LENGTH, ROW = 210, 420, 17

#: Colours of the orders, on light and on dark pages.
COLORS = ("#0a84d0", "#e07b39", "#8a94a0")


def chart_of_chunk_orders(page: str) -> str:
    """Draw the megabytes until 90 % of the cut is resident, for each tree and order, relative to Spark's order.

    Args:
        page: text with the table, which begins with `| tree |`; columns "MB: ORDER" are drawn.
    """
    begin = page.index("\n| tree |") + 1
    heading, _, *rows = (
        [cell.strip() for cell in line.strip("|").split("|")] for line in page[begin:].partition("\n\n")[0].splitlines()
    )
    shown = [at for at, name in enumerate(heading) if name.startswith("MB: ")]
    orders = [heading[at].removeprefix("MB: ") for at in shown]
    reference = shown[orders.index("Spark's")]
    ratios = [[float(row[at]) / float(row[reference]) for at in shown] for row in rows]
    scale = LENGTH / max(map(max, ratios))
    height = (len(rows) * (len(shown) + 1) + 2) * ROW
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {NAMES + LENGTH + 60} {height}" '
        'font-family="sans-serif" font-size="12" fill="#7b8794">'
    ]
    for number, order in enumerate(orders):
        x = NAMES + 110 * number
        parts.append(f'<rect x="{x}" y="4" width="10" height="10" fill="{COLORS[number]}"/>')
        parts.append(f'<text x="{x + 15}" y="13">{order}</text>')
    for at, (row, of_row) in enumerate(zip(rows, ratios, strict=True)):
        top = (at * (len(shown) + 1) + 2) * ROW
        parts.append(f'<text x="{NAMES - 8}" y="{top + 2 * ROW - 5}" text-anchor="end">{row[0]}</text>')
        for number, ratio in enumerate(of_row):
            y, width = top + number * ROW, ratio * scale
            parts.append(f'<rect x="{NAMES}" y="{y}" width="{width:.1f}" height="{ROW - 3}" fill="{COLORS[number]}"/>')
            parts.append(f'<text x="{NAMES + width + 5:.1f}" y="{y + 12}">{ratio:.2f}</text>')
    return "\n".join([*parts, "</svg>", ""])


def main() -> None:
    """Write all generated files, and remove the pages of commands that no longer exist."""
    pages = command_pages()
    for path in (DOCS / "cli").glob("*.md"):
        if path.name not in pages:
            path.unlink()
    for name, text in pages.items():
        (DOCS / "cli" / name).write_text(text, encoding="utf-8")
    for path in DOCS.glob("*.md"):
        text = path.read_text(encoding="utf-8")
        path.write_text(with_tables(text), encoding="utf-8")
    chart = chart_of_chunk_orders((DOCS / "streaming-measured.md").read_text(encoding="utf-8"))
    (DOCS / "images" / "chunk-order.svg").write_text(chart, encoding="utf-8")
    subprocess.run([sys.executable, DOCS.parent / "benchmarks" / "run_all.py", "--write-page"], check=True)


if __name__ == "__main__":
    main()
