"""Outputs of a simulation: a table, index files of the cuts, and charts."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..system.output import check_free, check_writable, write_file
from ..system.progress import Progress, silent
from ..tables.columns import Filter, TableOutput
from .summary import Lookout

if TYPE_CHECKING:
    from ..cameras.sources import CameraPath
    from ..tables.columns import Row
    from .frames import SimulatedFrame, Simulation

#: Nodes per row of Spark's index texture.
ROW = 16_384


@dataclass(frozen=True)
class FrameOutputs:
    """Destinations of the frames of a simulation.

    Attributes:
        indices: folder for the node indices of each cut; None for none.
        padded: pad the index files to whole rows of `ROW`.
        plot: file of the charts; None for none.
    """

    table: TableOutput
    indices: Path | None = None
    padded: bool = False
    plot: Path | None = None
    overwrite: bool = False

    def check(self) -> None:
        """Raise a `SparklodError` if an output cannot be written; called before any work is done."""
        self.table.check()
        if self.plot is not None:
            check_writable(self.plot, overwrite=self.overwrite)
            from ..figures.charts import load_matplotlib

            load_matplotlib()
        if self.indices is not None:
            check_writable(self.indices / "0.npy", overwrite=True)

    def check_frames(self, numbers: Sequence[int], instances: int) -> None:
        """Raise an `OutputError` if an index file of a frame exists and may not be replaced."""
        for file in self.index_files(numbers, instances):
            check_free(file, overwrite=self.overwrite)

    def index_files(self, numbers: Sequence[int], instances: int) -> Iterator[Path]:
        """Yield the index files that will be written for frames of these numbers."""
        if self.indices is not None:
            for number in numbers:
                yield from index_files(self.indices, number, instances)


@dataclass(frozen=True)
class WrittenFrames:
    """Results of `write_frames`.

    Attributes:
        rows: the row of all instances together for each frame.
        in_front: mean share of the drawn splats in front of the camera.
        note: why the charts have no picture of the path; None if they have one, or if there are no charts.
    """

    rows: list[Row]
    in_front: float
    note: str | None


@dataclass
class _ChartData:
    """Data for the charts: rows, and the extreme frames so far."""

    rows: list[Row] = field(default_factory=list)
    in_front: list[float] = field(default_factory=list)
    lookout: Lookout = field(default_factory=Lookout)
    frames: dict[str, SimulatedFrame] = field(default_factory=dict)

    def add(self, frame: SimulatedFrame) -> None:
        """Store a frame if it exceeds all earlier frames in one of the criteria."""
        for criterion in self.lookout.add(frame.rows[0]):
            self.frames[criterion] = frame
        self.frames.setdefault("first", frame)

    def best(self) -> SimulatedFrame:
        """Return the first extreme frame that draws anything, as none does before the first chunk has arrived."""
        criteria = [moment.criterion for moment in self.lookout.moments()]
        extremes = [self.frames[criterion] for criterion in (*criteria, "first")]
        return next((each for each in extremes if len(each.cut)), extremes[0])


def write_frames(
    simulation: Simulation,
    path: CameraPath,
    outputs: FrameOutputs,
    *,
    threads: int = 1,
    progress: Progress = silent,
    passed: Filter | None = None,
) -> WrittenFrames:
    """Simulate a camera path and writes the outputs: table and index files frame by frame, then the charts.

    Args:
        passed: a filter for the bytes of a table on standard output.

    Raises:
        OutputError: a file cannot be written.
    """
    data = _ChartData()

    def rows() -> Iterator[Row]:
        for frame in simulation.run(path, threads=threads, progress=progress):
            data.in_front.append(frame.in_front)
            data.rows.append(frame.rows[0])
            _write_indices(frame, outputs)
            if outputs.plot is not None:
                data.add(frame)
            yield from frame.rows

    outputs.table.write(rows(), passed=passed)
    note = None if outputs.plot is None else _plot(simulation, path, outputs.plot, data, overwrite=outputs.overwrite)
    return WrittenFrames(data.rows, float(np.mean(data.in_front)), note)


def index_files(folder: Path, frame: int, instances: int) -> list[Path]:
    """Return the index files of a frame, one per instance."""
    if instances == 1:
        return [folder / f"{frame:06d}.npy"]
    return [folder / f"{frame:06d}.{instance}.npy" for instance in range(instances)]


def _write_indices(frame: SimulatedFrame, outputs: FrameOutputs) -> None:
    if outputs.indices is None:
        return
    parts = frame.cut.indices()
    for nodes, file in zip(parts, index_files(outputs.indices, frame.number, len(parts)), strict=True):
        if outputs.padded:
            nodes = np.concatenate([nodes, np.zeros(-len(nodes) % ROW, np.uint32)]).reshape(-1, ROW)
        out = io.BytesIO()
        np.save(out, nodes)
        write_file(file, [out.getvalue()], overwrite=outputs.overwrite)


def _plot(simulation: Simulation, path: CameraPath, target: Path, data: _ChartData, *, overwrite: bool) -> str | None:
    """Write the charts, with the path over the cut of an extreme frame; returns a note if that picture is missing."""
    from ..figures import traversal_chart

    frame = data.best()
    cut = simulation.scenes.cut_of(frame.cut)
    scene = traversal_chart.PathScene(
        path.cameras,
        cut.splats,
        np.concatenate([part.depth for part in cut.parts]),
        path.numbers.index(frame.number),
        "level" if simulation.scenes.in_runs else "tree depth",
    )
    marked = {moment.criterion: moment.frame for moment in data.lookout.moments()}
    drawn = traversal_chart.plot(data.rows, marked, simulation.scenes.title, scene)
    write_file(target, [drawn.png], overwrite=overwrite)
    return drawn.note
