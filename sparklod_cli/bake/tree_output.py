"""Outputs of a bake: their files and options, which are known before the tree is built, and writing the tree."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from ..codecs.encoder import CLAMPED, results, windows_of
from ..codecs.formats import DEFAULTS, RAD_ENCODINGS, WRITABLE, Format, WriteOptions
from ..codecs.formats import RAD_SUFFIX as RAD
from ..io.files import opened
from ..io.reading import Merged, Source
from ..io.writing import parts_output, scene_output
from ..model.scene import Scene
from ..model.splats import Splats, same_rows
from ..system.addresses import Place
from ..system.errors import FormatError
from ..system.output import Output
from ..system.progress import Progress
from .settings import Baked, BakeSettings

if TYPE_CHECKING:
    from ..codecs.encoder import Encoder, Windows
    from ..codecs.reader import Reader
    from ..codecs.statistics import Statistics


@dataclass(kw_only=True, eq=False)
class BuiltTree:
    """Tree on its way from the splats of an input to the files of an output.

    Attributes:
        form: format of an SPZ or RAD file, which is written in windows; None for an output that is made of all nodes at
            once, in memory, and takes any tree.
        in_chunks: viewers read the output in chunks, for which nodes are ordered first.
        stored, before: codes that unchanged nodes keep, and (N,) nodes with these codes; None for none.
        repacked: RAD file whose chunks are copied; None for none.
        nodes: in memory or in a store; before the tree is built, the splats of an input in memory; None while a step
            replaces them.
        environment: splats that are always drawn; None without.
        statistics: of all nodes, those by which the codec settles options; of the leaves alone before the nodes are in
            order; None for an output that needs none.
        is_ordered: the nodes have the order of the output.
        started: when the current stage began, seconds of `time.perf_counter`.
    """

    settings: BakeSettings
    out: Output
    options: WriteOptions
    form: Format | None = None
    in_chunks: bool = False
    stored: Any = None
    before: Splats | None = None
    repacked: Place | None = None
    nodes: Scene | Reader | None = None
    baked: Baked = field(default_factory=Baked)
    environment: Splats | None = None
    statistics: Statistics | None = None
    is_ordered: bool = False
    started: float = field(default_factory=time.perf_counter)

    def end(self, stage: str) -> None:
        """End a stage; the next one begins."""
        now = time.perf_counter()
        self.baked.seconds[stage] = round(now - self.started, 4)
        self.started = now


def output_of(target: Place, settings: BakeSettings, *, overwrite: bool) -> BuiltTree:
    """Return a tree to be built, with its output; raise `OutputError` now, before the work."""
    options, simplify = settings.options, settings.simplify
    if settings.detail is not None or settings.tiles is not None:
        return BuiltTree(settings=settings, out=parts_output(target, overwrite=overwrite), options=options)
    form = WRITABLE[settings.suffix]
    out = scene_output(target, form, chunked=options.rad.chunked, overwrite=overwrite)
    if simplify is not None:
        return BuiltTree(settings=settings, out=out, options=options)
    return BuiltTree(settings=settings, out=out, options=options, form=form, in_chunks=form is WRITABLE[RAD])


def keep_tree(tree: BuiltTree, source: Source, scene: Scene) -> None:
    """Adapt an output to an input whose tree is kept.

    Nodes keep their opacities. In the same format, options that were not given are those of the file, and the codes of
    unchanged nodes are copied. Chunks of a RAD file that gets its other container are copied unless an option changes
    the encoding.

    Raises:
        FormatError: the settings neither change the format or container of the tree nor fit its merged splats; or they
            have options that only splats without a tree take.
    """
    settings, options = tree.settings, tree.options
    held = scene.format.split()[0]
    rest = settings.detail, settings.tiles, settings.simplify
    is_same = all(setting is None for setting in rest) and WRITABLE[settings.suffix].name == held
    is_same_container = bool(scene.header.get("chunked")) == options.rad.chunked
    if settings.refine is None and not settings.recodes and (not settings.converts or (is_same and is_same_container)):
        raise FormatError(
            "it is a Level-of-Detail file already; sparklod convert writes its tree or its leaves in another format,"
            " and --refine fits its merged splats"
        )
    if settings.unused:
        kept = "is written as it is" if settings.refine is None else "--refine keeps"
        raise FormatError(
            f"it has a tree, which {kept}; leave out {', '.join(settings.unused)}, or give the splats that"
            " the tree was built from"
        )
    if tree.form is None:
        return
    is_plain = dataclasses.replace(options, rad=dataclasses.replace(options.rad, chunked=False)) == DEFAULTS
    if is_same and (settings.refine is not None or not is_plain or not tree.in_chunks):
        assert not isinstance(source, Merged)  # of which no part is a tree
        with opened(source) as (file, form):
            tree.stored, tree.options = form.codec().stored(file, options)
        tree.before, tree.is_ordered = scene.splats, True
    elif is_same:
        assert not isinstance(source, Merged)
        tree.form, tree.in_chunks, tree.repacked = None, False, source
    else:
        tree.options = dataclasses.replace(options, covering=False)


def write_windows(
    tree: BuiltTree, encode: Callable[[BuiltTree, Encoder], Windows] | None, threads: int, progress: Progress
) -> None:
    """Encode the windows of a tree whose nodes are in order, and write them as an SPZ or RAD file.

    Args:
        encode: encodes the windows of nodes in a store; None for nodes in memory.
    """
    baked, form = tree.baked, tree.form
    assert form is not None
    codec = form.codec()
    settled: WriteOptions = codec.settled(tree.statistics, tree.options)
    encoder: Any = codec.encoder(tree.nodes, settled, counting=True, threads=threads, progress=progress)
    if tree.before is not None:
        assert isinstance(tree.nodes, Scene)
        encoder = encoder.keeping(tree.stored, same_rows(tree.nodes.splats, tree.before))
    if encode is None:
        assert isinstance(tree.nodes, Scene)
        encoded = list(results(encoder, tree.nodes, threads, progress, "encoding"))
    windows = (lambda number, name: encoded[number][name]) if encode is None else encode(tree, encoder)
    options, numbers = encoder.options, range(len(windows_of(baked.nodes)))
    with tree.out as out:
        name = out.target.name
        if out.siblings is None:
            for piece in encoder.pieces(windows, threads=threads, progress=progress):
                baked.bytes += out.write(name, (piece,))
        else:
            chunks = (windows(number, codec.CHUNK).tobytes() for number in numbers)
            for each, pieces in encoder.files(chunks, PurePath(name).stem, progress=progress):
                baked.bytes += out.write(each, pieces)
    tallies = [windows(number, CLAMPED) for number in numbers] if encoder.ranges else []
    if any(tally[:, 3].any() for tally in tallies):  # splats beyond any range of a column
        from ..codecs.losses import clamps_of

        baked.clamped, baked.clamps = clamps_of(tallies, encoder.ranges)
    tree.end("write")
    if not tree.in_chunks:
        baked.output_format, baked.version, baked.fractional_bits = "spz", options.spz_version, options.fractional_bits
        return
    baked.output_format = "rad-chunked" if options.rad.chunked else "rad"
    baked.chunks = len(numbers)
    baked.encodings = {name: getattr(options.rad, name) for name in RAD_ENCODINGS if baked.sh_degree or name != "sh"}
    if options.rad.sh_codes and baked.sh_degree:
        baked.sh_codes = min(options.rad.sh_codes, baked.nodes)


def write_whole(tree: BuiltTree, threads: int, progress: Progress, **how: Any) -> None:
    """Write an output that is made of all nodes of a tree at once.

    Args:
        how: further arguments of `simplifying.simplified`, for a simplified scene.
    """
    baked, out, settings, options, scene = tree.baked, tree.out, tree.settings, tree.options, tree.nodes
    assert isinstance(scene, Scene)
    if tree.repacked is not None:
        _repack(tree.repacked, out, baked)
    elif settings.tiles is not None:
        from .parts_output import write_tiles

        baked.output_format = "3d-tiles"
        baked.bytes, baked.tiles = write_tiles(scene, out, settings.tiles, options, tree.end, threads, progress)
    elif settings.detail is not None:
        from .parts_output import write_levels

        baked.output_format, above = "streamed-sog", tree.environment
        baked.bytes, baked.detail = write_levels(
            scene, above, out, settings.detail, options, tree.end, threads, progress
        )
    else:
        assert settings.simplify is not None
        from .simplifying import write_simplified

        form = WRITABLE[settings.suffix]
        baked.output_format = form.name
        # The opacities of a tree that was read make up for the rounding of its scales already.
        options = dataclasses.replace(options, covering=baked.method is not None)
        rest = form, options, baked.splats, tree.end
        baked.bytes, baked.simplified = write_simplified(
            scene, settings.simplify, out, *rest, threads=threads, progress=progress, **how
        )
    tree.end("write")


def _repack(source: Place, out: Output, baked: Baked) -> None:
    """Write a RAD file with the chunks of another one."""
    with opened(source) as (file, form), out:
        chunks = form.codec().RadReader.open(file.file, file.open_companion)
        name = out.target.name
        files = [(name, chunks.in_one_file())] if out.siblings is None else chunks.in_files(PurePath(name).stem)
        baked.bytes = sum(out.write(*each) for each in files)
        baked.encodings = chunks.encodings
    baked.output_format = "rad" if chunks.header.chunked else "rad-chunked"
    baked.chunks, baked.sh_codes = len(chunks.header.chunks), chunks.header.sh_code_count
