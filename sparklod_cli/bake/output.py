"""Outputs of a bake: a file that is written in windows, or what is made of all nodes at once, in memory."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any, cast

from ..codecs import clamps
from ..codecs.encoder import CLAMPED, Encoder, Get, Stored, windows_of
from ..codecs.file_names import RAD_SUFFIX as RAD
from ..codecs.formats import WRITABLE, Format
from ..codecs.options import DEFAULTS, WriteOptions
from ..codecs.rad.rad_layout import OPTIONS
from ..codecs.statistics import Statistics
from ..io.reading import opened, read_stored
from ..io.writing import parts_output, scene_output
from ..model.lod_tree import CHUNK_NODES
from ..model.scene import Scene
from ..model.splats import Splats, same_rows
from ..system.addresses import Place
from ..system.errors import FormatError
from ..system.output import Files, Output
from ..system.progress import Progress
from .records import BuiltTree, Clock, WrittenTree
from .settings import SPZ, BakeSettings
from .sources import Merged, Source

#: Encodes the windows of a tree, and returns what reads their results.
Encode = Callable[[BuiltTree, Encoder], Get]


class BakeOutput:
    """Destination of a tree; by default one that is made of all nodes at once, in memory, and holds any tree.

    Attributes:
        in_chunks: it is read in chunks, so that nodes are put in an order for that first.
    """

    in_chunks: bool = False

    @property
    def needed(self) -> frozenset[str]:
        """Statistics of all nodes by which it is written, see `codecs.statistics`."""
        return frozenset()

    def check(self, leaves: Statistics) -> None:
        """Raise `FormatError` where a tree of leaves with these statistics cannot be written."""

    def write(self, tree: BuiltTree, encode: Encode, clock: Clock, threads: int, progress: Progress) -> WrittenTree:
        """Write a tree whose nodes are in order; in memory, unless this is a `FileOutput`."""
        raise NotImplementedError


def output_of(
    target: Place, settings: BakeSettings, *, overwrite: bool, say: Callable[[str], None] = lambda text: None
) -> BakeOutput:
    """Return the output that settings ask for; fail now if it cannot be written later.

    Raises:
        OutputError: see `system.output.Output`.
    """
    if settings.detail is not None or settings.tiles is not None:  # which most bakes do without
        from .parts_output import DetailOutput, TileOutput
    if settings.detail is not None:
        return DetailOutput(settings.detail, settings.options, parts_output(target, overwrite=overwrite))
    if settings.tiles is not None:
        return TileOutput(settings.tiles, settings.options, parts_output(target, overwrite=overwrite))
    if settings.simplify is not None:
        from .simplifying import SimplifiedOutput, Simplifier

        form = WRITABLE[settings.suffix]
        out = scene_output(target, form, chunked=settings.options.rad.chunked, overwrite=overwrite)
        return SimplifiedOutput(form, settings.options, out, Simplifier.of(settings, say))
    if settings.encoding is not None:
        return ArrayOutput(settings.encoding, settings.raw, Output(target, overwrite=overwrite))
    form, chunked = WRITABLE[settings.suffix], settings.options.rad.chunked
    out = scene_output(target, form, chunked=chunked, overwrite=overwrite)
    return FileOutput(form, settings.options, out, in_chunks=settings.suffix == RAD)


def output_of_existing_tree(
    output: BakeOutput, source: Source, scene: Scene, settings: BakeSettings
) -> tuple[BakeOutput, bool]:
    """Return the output of an input that has a tree, which is kept, and whether its nodes are in order already.

    Nodes keep their opacities. In the same format, what was not chosen of how to write is that of the file, and nodes
    that have the values of the file are written bit for bit as they stand there; chunks of a RAD that goes into its
    other container are copied, unless an option tells how.

    Args:
        output: of an input without a tree.

    Raises:
        FormatError: nobody asked for another format than that of the scene, or for merged splats to be fitted; or for
            something that only splats without a tree can be given.
    """
    held = scene.format.split()[0]
    others = settings.detail, settings.tiles, settings.encoding, settings.simplify
    plain = all(other is None for other in others)
    is_same = plain and WRITABLE[settings.suffix].name == held
    is_same_container = bool(scene.header.get("chunked")) == settings.options.rad.chunked
    converts = settings.converts and settings.encoding is None and not (is_same and is_same_container)
    if settings.refine is None and not converts:
        other = next(each for each in (WRITABLE[RAD], WRITABLE[SPZ]) if each.name != held)
        raise FormatError(
            "it is a Level-of-Detail file already; --unlod writes its splats back out, and --format"
            f" {other.suffixes[0][1:]} its tree as {other.name}; --refine fits its merged splats"
        )
    if settings.unused:
        kept = "is written as it is" if settings.refine is None else "--refine keeps"
        raise FormatError(
            f"it has a tree, which {kept}; leave out {', '.join(settings.unused)}, or give the splats that"
            " the tree was built from"
        )
    if not isinstance(output, FileOutput):
        return output, False
    options = output.options
    if is_same and settings.refine is not None:
        assert not isinstance(source, Merged)  # of which no part is a tree
        stored = read_stored(source)
        return dataclasses.replace(output, options=stored.like(options), stored=stored, before=scene.splats), True
    if is_same and dataclasses.replace(options, rad=dataclasses.replace(options.rad, chunked=False)) == DEFAULTS:
        assert not isinstance(source, Merged)
        return RepackedOutput(source, output.out), False
    return dataclasses.replace(output, options=dataclasses.replace(options, covering=False)), False


@dataclass(frozen=True)
class ArrayOutput(BakeOutput):
    """Arrays in the layout of a viewer's memory.

    Attributes:
        encoding: of `codecs.formats.ENCODINGS`.
        raw: their words alone, rather than a .npz.
    """

    encoding: str
    raw: bool
    out: Output

    def write(self, tree: BuiltTree, encode: Encode, clock: Clock, threads: int, progress: Progress) -> WrittenTree:
        """Pack the nodes and write the arrays."""
        from ..codecs.gpu import dump

        arrays = dump.pack(tree.scene, self.encoding, threads)
        with self.out as out:
            size = out.write(out.target.name, dump.encode_raw(arrays) if self.raw else dump.encode_npz(arrays))
        shapes = {name: words.shape for name, words in arrays.items()}
        clock.end("write")
        return WrittenTree(output_format=self.encoding, bytes=size, arrays=shapes)


@dataclass(frozen=True)
class RepackedOutput(BakeOutput):
    """RAD file with the chunks of another one."""

    source: Place
    out: Output

    def write(self, tree: BuiltTree, encode: Encode, clock: Clock, threads: int, progress: Progress) -> WrittenTree:
        """Copy the chunks."""
        with opened(self.source) as (file, form, more):
            chunks = form.codec().RadReader.open(file, **more)
            with self.out as out:
                name = out.target.name
                whole = out.siblings is None
                files = [(name, chunks.in_one_file())] if whole else chunks.in_files(PurePath(name).stem)
                size = sum(out.write(*file) for file in files)
            encodings = chunks.encodings
        clock.end("write")
        return WrittenTree(
            output_format="rad" if chunks.header.chunked else "rad-chunked",
            bytes=size,
            chunks=len(chunks.header.chunks),
            encodings=encodings,
            sh_codes=chunks.header.sh_code_count,
        )


@dataclass(frozen=True)
class FileOutput(BakeOutput):
    """SPZ or RAD file, written in windows.

    Attributes:
        in_chunks: see `BakeOutput`; RAD is.
        stored: codes that nodes keep which still have the values of `before`; None where there are none.
        before: (N,) nodes with these codes.
    """

    form: Format
    options: WriteOptions
    out: Output
    in_chunks: bool
    stored: Stored | None = None
    before: Splats | None = None

    @property
    def needed(self) -> frozenset[str]:
        """Statistics by which the codec settles options."""
        needed: frozenset[str] = self.form.codec().needed(self.options)
        return needed

    def check(self, leaves: Statistics) -> None:
        """Fail where the format cannot hold a tree of these leaves."""
        self.form.codec().settled(leaves, self.options)

    def encoder(self, tree: BuiltTree, threads: int, progress: Progress) -> Encoder:
        """Return the encoder of a tree, which counts what it clamps."""
        codec: Any = self.form.codec()
        options: WriteOptions = codec.settled(tree.statistics, self.options)
        ranges = tuple(codec.held(options, tree.sh_degree))
        encoder: Encoder = codec.encoder(tree.nodes, options, ranges, threads=threads, progress=progress)
        if self.stored is None or self.before is None:
            return encoder
        return self.stored.keeping(encoder, same_rows(tree.scene.splats, self.before))

    def write(self, tree: BuiltTree, encode: Encode, clock: Clock, threads: int, progress: Progress) -> WrittenTree:
        """Encode the windows and write the file."""
        encoder = self.encoder(tree, threads, progress)
        get, options, count = encode(tree, encoder), encoder.options, encoder.count
        with self.out as out:
            name = out.target.name
            if out.siblings is None:
                size = out.write(name, encoder.pieces(get, threads=threads, progress=progress))
            else:
                files: Files = cast(Any, encoder).files(get, PurePath(name).stem, progress=progress)
                size = sum(out.write(*file) for file in files)
        numbers = range(len(windows_of(count)) if encoder.ranges else 0)
        beyond = clamps.Clamps()
        if numbers:
            beyond = clamps.clamps_of(clamps.merged([get(number, CLAMPED) for number in numbers]), encoder.ranges)
        clock.end("write")
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
            encodings={name: getattr(options.rad, name) for name in OPTIONS if encoder.sh_degree or name != "sh"},
            sh_codes=min(options.rad.sh_codes, count) if options.rad.sh_codes and encoder.sh_degree else None,
            clamped=beyond.splats,
            clamps=beyond.ends,
        )
