"""What `sparklod traverse` does with its frames."""

from __future__ import annotations

import io
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

from ..io import check_writable, write_stdout, write_whole
from ..simulation.summary import Lookout
from ..support.progress import Progress, silent
from .console import Console, for_screen, is_terminal
from .traverse_text import lines

if TYPE_CHECKING:
    from ..cameras.path import CameraPath
    from ..simulation.frames import Frame, Simulation
    from ..simulation.summary import Summary
    from ..tables.assertions import Assertion
    from ..tables.columns import Column, Row

#: Nodes of a row of Spark's index texture.
ROW = 16_384


@dataclass(frozen=True)
class Wanted:
    """What is to be made of the frames.

    Attributes:
        output: of the table; None for standard output.
        form: of the table.
        columns: of the table.
        summary: say it; None where a person reads.
        as_json: print it instead of the table.
        asserts: what must hold.
        plot, indices: outputs; None for none.
        padded: indices fill rows of `ROW`.
        overwrite: replace outputs.
    """

    output: Path | None
    form: str
    columns: Sequence[Column]
    summary: bool | None
    as_json: bool
    asserts: Sequence[Assertion]
    plot: Path | None
    indices: Path | None
    padded: bool
    overwrite: bool

    def check(self) -> None:
        """Raises a `SparklodError` where an output cannot be made, before work goes into it."""
        for target in (self.output, self.plot):
            if target is not None and str(target) != "-":
                check_writable(target, overwrite=self.overwrite)
        if self.indices is not None and self.indices.exists():  # it is made when all else is known to be right
            check_writable(self.indices / "0.npy", overwrite=True)
        if self.form == "parquet":
            from ..tables.files import load_pyarrow

            load_pyarrow()
        if self.plot is not None:
            from ..figures.charts import load_matplotlib

            load_matplotlib()


@dataclass
class Job:
    """Frames on their way through the outputs."""

    console: Console
    wanted: Wanted
    simulation: Simulation
    path: CameraPath
    rows: list[Row] = field(default_factory=list)
    in_front: float = 1.0
    _lookout: Lookout = field(default_factory=Lookout)
    _kept: dict[str, Frame] = field(default_factory=dict)

    def run(self, threads: int) -> None:
        """Simulates the path and writes what is made frame by frame, then the plot."""
        from ..tables.files import encode

        wanted, start = self.wanted, time.perf_counter()
        to_stdout = wanted.output is None or str(wanted.output) == "-"
        # A bar and a table do not go together on one screen.
        screen = to_stdout and not wanted.as_json and is_terminal(sys.stdout)
        rows = self._rows(threads, silent if screen else self.console.progress)
        if not to_stdout:
            assert wanted.output is not None
            write_whole(wanted.output, encode(rows, wanted.columns, wanted.form), overwrite=wanted.overwrite)
        elif wanted.as_json:
            for _ in rows:
                pass
        else:
            table = encode(rows, wanted.columns, wanted.form)
            write_stdout(for_screen(table) if screen and wanted.form != "parquet" else table)
        self.console.clear()
        self.console.detail(
            f"  {len(self.path.cameras):,} frames of {self.path.format}, {time.perf_counter() - start:.2f} s"
        )
        if wanted.plot is not None:
            self._plot(wanted.plot)

    def report(self) -> int:
        """Says what is asked for; the exit status."""
        from ..simulation.columns import EMPTY
        from ..simulation.summary import summarize
        from ..tables.assertions import check

        wanted = self.wanted
        outcomes = check(wanted.asserts, self.rows, empty=EMPTY)
        summary = summarize(self.rows)
        if wanted.as_json:
            asserts = [{"assert": each.assertion.text, "held": each.held, "value": each.value} for each in outcomes]
            click.echo(json.dumps(summary.as_dict() | {"asserts": asserts}, allow_nan=False))
        if wanted.summary or (wanted.summary is None and is_terminal(sys.stderr)):
            self._say(summary)
        for outcome in outcomes:
            if not outcome.held:
                self.console.error(outcome.message())
            else:
                self.console.detail(f"  holds: {outcome.message()}")
        return 0 if all(outcome.held for outcome in outcomes) else 3

    def _say(self, summary: Summary) -> None:
        for line in lines(summary):
            self.console.say(line)

    def _rows(self, threads: int, progress: Progress) -> Iterator[Row]:
        """The rows of the table; on the way, cuts are written and rows kept for the report."""
        if self.wanted.indices is not None:
            check_writable(self.wanted.indices / "0.npy", overwrite=True, make_parent=True)
        shares = []
        for frame in self.simulation.run(self.path, threads=threads, progress=progress):
            shares.append(frame.in_front)
            if self.wanted.indices is not None:
                self._write_indices(frame, self.wanted.indices)
            self.rows.append(frame.rows[0])
            if self.wanted.plot is not None:
                self._keep(frame)
            yield from frame.rows
        self.in_front = float(np.mean(shares))

    def index_files(self) -> Iterator[Path]:
        """The files of --indices-out, all that will be written."""
        if self.wanted.indices is not None:
            for number in self.path.numbers:
                yield from _index_files(self.wanted.indices, number, len(self.simulation.scenes.instances))

    def _keep(self, frame: Frame) -> None:
        """Keeps what may be drawn in the end: the frames that are most worth looking at until now, and the first."""
        for what in self._lookout.add(frame.rows[0]):
            self._kept[what] = frame
        self._kept.setdefault("first", frame)

    def _write_indices(self, frame: Frame, folder: Path) -> None:
        parts = frame.cut.indices()
        for nodes, file in zip(parts, _index_files(folder, frame.number, len(parts)), strict=True):
            if self.wanted.padded:
                nodes = np.concatenate([nodes, np.zeros(-len(nodes) % ROW, np.uint32)]).reshape(-1, ROW)
            out = io.BytesIO()
            np.save(out, nodes)
            write_whole(file, [out.getvalue()], overwrite=self.wanted.overwrite)

    def _plot(self, target: Path) -> None:
        """Draws the charts, and the path over what the frame that is most worth looking at had: its cut, as drawn."""
        from ..figures.traversal_chart import Scenery, plot

        scenes = self.simulation.scenes
        worth = [self._kept[what] for what in (*(moment.what for moment in self._lookout.moments()), "first")]
        frame = next((each for each in worth if len(each.cut)), worth[0])  # before anything arrived, nothing is drawn
        at = self.path.numbers.index(frame.number)
        cut = scenes.cut_of(frame.cut)
        scenery = Scenery(
            self.path.cameras,
            cut.splats,
            np.concatenate([part.depth for part in cut.parts]),
            at,
        )
        marked = {moment.what: moment.frame for moment in self._lookout.moments()}
        drawn = plot(self.rows, marked, scenes.title, scenery)
        if drawn.note:
            self.console.say(f"{target}: {drawn.note}")
        write_whole(target, [drawn.png], overwrite=self.wanted.overwrite)


def _index_files(folder: Path, frame: int, instances: int) -> list[Path]:
    """Where the nodes of a frame go, a file an instance."""
    if instances == 1:
        return [folder / f"{frame:06d}.npy"]
    return [folder / f"{frame:06d}.{instance}.npy" for instance in range(instances)]
