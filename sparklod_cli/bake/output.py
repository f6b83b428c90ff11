"""Writing a tree in the format that is set, and what is to be said of the output."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from ..codecs import clamps
from ..codecs.clamps import Range
from ..codecs.encoder import CLAMPED, Encoder, Get, Kept, Stored, results, windows_of
from ..codecs.file_names import RAD_SUFFIX as RAD
from ..codecs.formats import WRITABLE, Format
from ..codecs.options import DEFAULTS, WriteOptions
from ..codecs.rad.rad_layout import OPTIONS
from ..codecs.statistics import Statistics
from ..io import SceneSink, Sink, scene_sink, sink
from ..model.nodes import CHUNK_NODES
from ..model.scene import Scene
from ..model.splats import Splats, same_rows
from ..model.streams import NodeStream
from ..support.addresses import Place
from ..support.progress import Progress
from .clock import Clock
from .repacked import Repacked
from .settings import BakeSettings
from .whole_output import WholeOutput
from .written import WrittenTree

#: Bytes of encoded nodes that wait in memory for their header; beyond, they wait on disk.
SPOOLED = 1 << 26


class Output(Protocol):
    """Where a tree goes."""

    @property
    def in_chunks(self) -> bool:
        """Whether it is read in chunks, so that nodes are put in an order for that first."""

    @property
    def needed(self) -> frozenset[str]:
        """The statistics of all nodes by which it is written, see `codecs.statistics`."""

    def check(self, splats: Splats, threads: int) -> Statistics | None:
        """Raises `FormatError` where a tree of these splats cannot be written; statistics of them that `write` takes.

        Args:
            splats: the leaves of the tree.
            threads: to count on.
        """

    def check_statistics(self, found: Statistics) -> None:
        """As `check`, of statistics of these splats; and where it cannot be written without all nodes in memory."""

    def converting(self) -> Output:
        """The same for the tree of a file, in another format or in several files, whose nodes keep their opacities."""

    def keeping(self, stored: Stored, before: Splats) -> Output:
        """The same for the tree of a file of the same format: what was not chosen of how to write is that of the file.

        Nodes that have the same values as there, as all leaves, are written bit for bit as they stand there.

        Args:
            stored: the codes of the file.
            before: its nodes.
        """

    def repacking(self, source: Place) -> Output:
        """The same for the tree of a file of the same format in its other container, where no option tells how.

        Args:
            source: the file, whose chunks are written as they stand.
        """

    def write(
        self,
        scene: Scene,
        environment: Splats | None,
        clock: Clock,
        threads: int,
        progress: Progress,
        counted: Statistics | None = None,
    ) -> WrittenTree:
        """Writes a tree.

        Args:
            scene: the tree.
            environment: splats beside it that are always drawn, which only a Streamed SOG can hold; None without.
            clock: told of the stages.
            threads, progress: as for `bake`.
            counted: statistics of its leaves, of `check`; None to count these, too.
        """

    def encoder(self, nodes: NodeStream, found: Statistics, threads: int, progress: Progress) -> Encoder:
        """The encoder of a tree, which `write_windows` takes.

        Args:
            nodes: of the tree, in their final order.
            found: statistics of all of them.
            threads, progress: for what has to be found out of the nodes first.

        Raises:
            FormatError: the tree cannot be written, or not without all nodes in memory.
        """

    def write_windows(self, encoder: Encoder, get: Get, threads: int, progress: Progress) -> WrittenTree:
        """Writes a tree whose windows are encoded; `get` reads their results."""


def output_of(target: Place, settings: BakeSettings, *, overwrite: bool) -> Output:
    """The output that settings ask for; fails now if it cannot be written later.

    Raises:
        OutputError: see `io.scene_sink` and `io.detail_sink`.
    """
    if settings.detail is not None:
        from ..io import detail_sink  # what most bakes do without
        from .detail_output import DetailOutput

        return DetailOutput(settings.detail, settings.options, detail_sink(target, overwrite=overwrite))
    if settings.encoding is not None:
        return _Arrays(settings.encoding, settings.raw, sink(target, overwrite=overwrite))
    form, chunked = WRITABLE[settings.suffix], settings.options.rad.chunked
    write = scene_sink(target, form, chunked=chunked, overwrite=overwrite)
    return _File(form, settings.options, write, in_chunks=settings.suffix == RAD)


@dataclass(frozen=True)
class _Arrays(WholeOutput):
    """Arrays in the layout of a viewer's memory.

    Attributes:
        encoding: of `codecs.formats.ENCODINGS`.
        raw: their words alone, rather than a .npz.
        sink: writes them.
    """

    encoding: str
    raw: bool
    sink: Sink

    made = "the arrays of --encoding are packed"

    def write(
        self,
        scene: Scene,
        environment: Splats | None,
        clock: Clock,
        threads: int,
        progress: Progress,
        counted: Statistics | None = None,
    ) -> WrittenTree:
        """Writes them."""
        from ..codecs.gpu import dump

        arrays = dump.pack(scene, self.encoding, threads)
        size = self.sink(dump.encode_raw(arrays) if self.raw else dump.encode_npz(arrays))
        shapes = {name: words.shape for name, words in arrays.items()}
        clock.end("write")
        return WrittenTree(output_format=self.encoding, bytes=size, arrays=shapes)


@dataclass(frozen=True)
class _File:
    """A splat file.

    Attributes:
        form: its format.
        options: how it is written.
        sink: writes it.
        in_chunks: see `Output`; RAD is.
        stored: codes that nodes keep which still have the values of `before`; None where there are none.
        before: (N,) nodes with these codes.
    """

    form: Format
    options: WriteOptions
    sink: SceneSink
    in_chunks: bool
    stored: Stored | None = None
    before: Splats | None = None

    @property
    def needed(self) -> frozenset[str]:
        """Those of the codec."""
        needed: frozenset[str] = self.form.codec().needed(self.options)
        return needed

    def converting(self) -> Output:
        """The same without changes to opacities."""
        return dataclasses.replace(self, options=dataclasses.replace(self.options, covering=False))

    def keeping(self, stored: Stored, before: Splats) -> Output:
        """The same with these codes."""
        return dataclasses.replace(self, options=stored.like(self.options), stored=stored, before=before)

    def repacking(self, source: Place) -> Output:
        """The chunks of a RAD file, where options do not ask for others."""
        plain = dataclasses.replace(self.options, rad=dataclasses.replace(self.options.rad, chunked=False))
        return Repacked(source, self.sink) if plain == DEFAULTS else self.converting()

    def check(self, splats: Splats, threads: int) -> Statistics | None:
        """The codec knows."""
        found = Statistics.of_leaves(splats, self.needed, threads=threads)
        self.check_statistics(found)
        return found

    def check_statistics(self, found: Statistics) -> None:
        """The codec knows."""
        self.form.codec().settled(found, self.options)

    def write(
        self,
        scene: Scene,
        environment: Splats | None,
        clock: Clock,
        threads: int,
        progress: Progress,
        counted: Statistics | None = None,
    ) -> WrittenTree:
        """Writes it."""
        if counted is None:
            found = Statistics.of_scene(scene, self.needed, threads=threads)
        else:
            found = Statistics.of_tree(scene, counted, self.needed, threads=threads)
        options: WriteOptions = self.form.codec().settled(found, self.options)
        if self.stored is None or self.before is None:
            size = self.sink(scene, options, threads=threads, progress=progress)
        else:
            made = self.form.codec().encoder(scene, options, threads=threads, progress=progress)
            encoder = self.stored.keeping(made, same_rows(scene.splats, self.before))
            with Kept(None, SPOOLED) as kept:
                for result in results(encoder, scene, threads, progress, "encoding"):
                    kept.put(result)
                size = self.sink.assemble(encoder, kept.get, threads=threads, progress=progress)
        beyond = clamps.find(scene.splats, threads, self._held(options, scene.splats.sh_degree), scene.tree)
        clock.end("write")
        return self._written(options, size, len(scene), scene.splats.sh_degree, beyond)

    def encoder(self, nodes: NodeStream, found: Statistics, threads: int, progress: Progress) -> Encoder:
        """That of the codec."""
        codec = self.form.codec()
        options = codec.settled(found, self.options)
        ranges = tuple(self._held(options, nodes.sh_degree))
        encoder: Encoder = codec.encoder(nodes, options, ranges, threads=threads, progress=progress)
        return encoder

    def write_windows(self, encoder: Encoder, get: Get, threads: int, progress: Progress) -> WrittenTree:
        """Writes it."""
        size = self.sink.assemble(encoder, get, threads=threads, progress=progress)
        tallies = [get(number, CLAMPED) for number in range(len(windows_of(encoder.count)))]
        beyond = clamps.clamps_of(clamps.merged(tallies), encoder.ranges)
        return self._written(encoder.options, size, encoder.count, encoder.sh_degree, beyond)

    def _held(self, options: WriteOptions, sh_degree: int) -> Sequence[Range]:
        """The values that are not clamped."""
        held: Sequence[Range] = self.form.codec().held(options, sh_degree)
        return held

    def _written(
        self, options: WriteOptions, size: int, count: int, sh_degree: int, beyond: clamps.Clamps
    ) -> WrittenTree:
        """What was written, of so many bytes and nodes, with settled options."""
        if not self.in_chunks:
            return WrittenTree(
                output_format="spz",
                bytes=size,
                version=options.spz_version,
                fractional_bits=options.fractional_bits,
                clamped=beyond.splats,
                clamps=beyond.ends,
            )
        return WrittenTree(
            output_format="rad-chunked" if options.rad.chunked else "rad",
            bytes=size,
            chunks=-(-count // CHUNK_NODES),
            encodings={name: getattr(options.rad, name) for name in OPTIONS if sh_degree or name != "sh"},
            sh_codes=min(options.rad.sh_codes, count) if options.rad.sh_codes and sh_degree else None,
            clamped=beyond.splats,
            clamps=beyond.ends,
        )
