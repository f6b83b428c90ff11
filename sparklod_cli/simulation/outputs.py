"""What is made of the frames of a simulation: a table, files of the nodes of each cut, and charts."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..io import check_writable, write_whole
from ..support.progress import Progress, silent
from ..tables.output import Filter, TableOutput
from .summary import Lookout

if TYPE_CHECKING:
    from ..cameras.path import CameraPath
    from ..tables.columns import Row
    from .frames import Frame, Simulation

#: Nodes of a row of Spark's index texture.
ROW = 16_384


@dataclass(frozen=True)
class FrameOutputs:
    """Where the frames of a simulation go.

    Attributes:
        table: of their rows.
        indices: folder of the nodes of each cut; None for none.
        padded: fill the files of nodes up to rows of `ROW`.
        plot: file of the charts; None for none.
        overwrite: replace files that exist.
    """

    table: TableOutput
    indices: Path | None = None
    padded: bool = False
    plot: Path | None = None
    overwrite: bool = False

    def check(self) -> None:
        """Raises a `SparklodError` where an output cannot be made, before work goes into it."""
        self.table.check()
        if self.plot is not None:
            check_writable(self.plot, overwrite=self.overwrite)
            from ..figures.charts import load_matplotlib

            load_matplotlib()
        if self.indices is not None:
            check_writable(self.indices / "0.npy", overwrite=True)

    def index_files(self, numbers: Sequence[int], instances: int) -> Iterator[Path]:
        """The files of nodes that will be written, of frames of some numbers."""
        if self.indices is not None:
            for number in numbers:
                yield from index_files(self.indices, number, instances)


@dataclass(frozen=True)
class WrittenFrames:
    """What became of the frames.

    Attributes:
        rows: of all instances together, one for each frame.
        in_front: mean share of the splats drawn that are in front of the camera.
        note: why there is no picture of the path in the charts; None where there is, or there are no charts.
    """

    rows: list[Row]
    in_front: float
    note: str | None


@dataclass
class _Kept:
    """What the charts need: rows, and the frames most worth a look until now."""

    rows: list[Row] = field(default_factory=list)
    in_front: list[float] = field(default_factory=list)
    lookout: Lookout = field(default_factory=Lookout)
    frames: dict[str, Frame] = field(default_factory=dict)

    def look(self, frame: Frame) -> None:
        """Keeps a frame if there is more of something in it than in all before."""
        for what in self.lookout.add(frame.rows[0]):
            self.frames[what] = frame
        self.frames.setdefault("first", frame)

    def shown(self) -> Frame:
        """The frame most worth a look that draws anything: before a chunk has arrived, none does."""
        worth = [self.frames[what] for what in (*(moment.what for moment in self.lookout.moments()), "first")]
        return next((each for each in worth if len(each.cut)), worth[0])


def write_frames(
    simulation: Simulation,
    path: CameraPath,
    outputs: FrameOutputs,
    *,
    threads: int = 1,
    progress: Progress = silent,
    passed: Filter | None = None,
) -> WrittenFrames:
    """Goes along a camera path, and writes what is made of the frames, frame by frame, and the charts at last.

    Args:
        simulation: whose frames they are.
        path: of the camera.
        outputs: where they go.
        threads: to find cuts on.
        progress: called with the number of frames that are done.
        passed: what the bytes of the table are passed through on their way to standard output.

    Raises:
        OutputError: a file cannot be written.
    """
    kept = _Kept()

    def rows() -> Iterator[Row]:
        for frame in simulation.run(path, threads=threads, progress=progress):
            kept.in_front.append(frame.in_front)
            kept.rows.append(frame.rows[0])
            _write_indices(frame, outputs)
            if outputs.plot is not None:
                kept.look(frame)
            yield from frame.rows

    outputs.table.write(rows(), passed=passed)
    note = None if outputs.plot is None else _plot(simulation, path, outputs.plot, kept, overwrite=outputs.overwrite)
    return WrittenFrames(kept.rows, float(np.mean(kept.in_front)), note)


def index_files(folder: Path, frame: int, instances: int) -> list[Path]:
    """Where the nodes of a frame go, a file for each instance."""
    if instances == 1:
        return [folder / f"{frame:06d}.npy"]
    return [folder / f"{frame:06d}.{instance}.npy" for instance in range(instances)]


def _write_indices(frame: Frame, outputs: FrameOutputs) -> None:
    if outputs.indices is None:
        return
    parts = frame.cut.indices()
    for nodes, file in zip(parts, index_files(outputs.indices, frame.number, len(parts)), strict=True):
        if outputs.padded:
            nodes = np.concatenate([nodes, np.zeros(-len(nodes) % ROW, np.uint32)]).reshape(-1, ROW)
        out = io.BytesIO()
        np.save(out, nodes)
        write_whole(file, [out.getvalue()], overwrite=outputs.overwrite)


def _plot(simulation: Simulation, path: CameraPath, target: Path, kept: _Kept, *, overwrite: bool) -> str | None:
    """Draws the charts, and the path over the cut of the frame that is most worth a look; a note where it cannot."""
    from ..figures import traversal_chart

    frame = kept.shown()
    cut = simulation.scenes.cut_of(frame.cut)
    scene = traversal_chart.PathScene(
        path.cameras,
        cut.splats,
        np.concatenate([part.depth for part in cut.parts]),
        path.numbers.index(frame.number),
    )
    marked = {moment.what: moment.frame for moment in kept.lookout.moments()}
    drawn = traversal_chart.plot(kept.rows, marked, simulation.scenes.title, scene)
    write_whole(target, [drawn.png], overwrite=overwrite)
    return drawn.note
