"""Tree of a bake: selected and transformed splats, the tree built of them in memory or kept, and its files."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np

from ..codecs.encoder import CLAMPED, results, windows_of
from ..codecs.formats import DEFAULTS, RAD_ENCODINGS, RAD_SUFFIX, WRITABLE, Format, WriteOptions
from ..codecs.reader import Reader, check_valid, is_valid_and_visible
from ..codecs.statistics import Statistics
from ..io.files import opened, read_rgba
from ..io.reading import Merged, Source, read_scene
from ..io.writing import parts_output, scene_output
from ..lod.tree_settings import BUILDERS
from ..model.lod_tree import LodTree
from ..model.scene import Scene, rotated_axis
from ..model.selection import Selection, SelectionTally
from ..model.splats import Splats, same_rows
from ..system.addresses import Place
from ..system.errors import FormatError, InvalidSplatsError, naming
from ..system.output import Output
from ..system.progress import Progress
from ..system.threads import on_threads
from .settings import Baked, BakeSettings

if TYPE_CHECKING:
    from ..codecs.encoder import Encoder, Windows
    from ..model.transforms import Transform


@dataclass(kw_only=True, eq=False)
class BuiltTree:
    """Tree on its way from the splats of an input to the files of an output.

    Attributes:
        form: format of an SPZ or RAD file, which is written in windows; None for an output that is made of all nodes at
            once, in memory, and takes any tree.
        in_chunks: viewers read the output in chunks, for which nodes are ordered first.
        stored: codes of the input, which unchanged nodes keep, and the (N,) nodes with these codes; None for none.
        repacked: RAD file whose chunks are copied; None for none.
        nodes: in memory or in a store; before the tree is built, the splats of an input in memory; None while a step
            replaces them.
        environment: splats that are always drawn.
        statistics: of all nodes, from which the codec settles options; of the leaves before the nodes are in order;
            None for an output that needs none.
        started: when the current stage began, seconds of `time.perf_counter`.
    """

    settings: BakeSettings
    out: Output
    options: WriteOptions
    form: Format | None = None
    in_chunks: bool = False
    stored: tuple[Any, Splats] | None = None
    repacked: Place | None = None
    nodes: Scene | Reader | None = None
    baked: Baked = field(default_factory=Baked)
    environment: Splats | None = None
    statistics: Statistics | None = None
    started: float = field(default_factory=time.perf_counter)

    @property
    def scene(self) -> Scene:
        """The nodes, in memory."""
        assert isinstance(self.nodes, Scene)
        return self.nodes

    def end(self, stage: str) -> None:
        """Record the seconds of a stage; the next one begins."""
        now = time.perf_counter()
        self.baked.seconds[stage] = round(now - self.started, 4)
        self.started = now


def output_of(target: Place, settings: BakeSettings, *, overwrite: bool) -> BuiltTree:
    """Prepare the output of a bake, and return the tree that is to be built.

    Raises:
        OutputError: the output cannot be written, or it exists and `overwrite` is False.
    """
    options = settings.options
    if settings.detail is not None or settings.tiles is not None:
        return BuiltTree(settings=settings, out=parts_output(target, overwrite=overwrite), options=options)
    form = WRITABLE[settings.suffix]
    out = scene_output(target, form, chunked=options.rad.chunked, overwrite=overwrite)
    if settings.simplify is not None:
        return BuiltTree(settings=settings, out=out, options=options)
    return BuiltTree(settings=settings, out=out, options=options, form=form, in_chunks=form is WRITABLE[RAD_SUFFIX])


def build(tree: BuiltTree, source: Source, threads: int, progress: Progress) -> None:
    """Select and transform the splats of an input, and build their tree, or keep the input's tree."""
    settings, baked, scene = tree.settings, tree.baked, tree.scene
    tree.nodes = None
    if settings.environment is not None:
        tree.environment = read_environment(settings, threads, progress)
    antialiased, up = scene.antialiased, settings.up or scene.up
    if up is not None and settings.transform is not None:
        up = rotated_axis(up, settings.transform.rotation)
    if scene.tree is not None:
        keep_tree(tree, source, scene)
        check_valid(scene.splats, threads)
        baked.splats = int(np.count_nonzero(scene.tree.is_leaf))
        tree.nodes = Scene(scene.splats, scene.tree, antialiased, up=up)
        tree.end("read")
        return
    splats, tally = select(scene.splats, settings, threads=threads)
    if tally.dropped or not len(splats):
        settings.selection.check(tally)
    if settings.environment_beyond is not None:
        from ..lod.parts import beyond

        if (far := beyond(splats, settings.environment_beyond)).any():
            if tree.environment is None:
                tree.environment = transformed(splats.take(far), settings.transform, threads)
            splats = splats.take(~far)
    splats = transformed(splats, settings.transform, threads)
    tree.end("read")
    if tree.form is not None:
        codec = tree.form.codec()
        tree.statistics = Statistics.of(splats, np.ones(len(splats), np.bool_), codec.needed(tree.options), threads)
        codec.settled(tree.statistics, tree.options)  # reports a tree that the output cannot hold before it is built
    baked.splats, baked.dropped, baked.method = len(splats), tally.dropped, settings.method
    leaves = [splats]
    del scene, splats  # the builder frees its input as it goes, if nobody else holds it: a third of the peak
    with on_threads(threads):
        built = build_tree(leaves, settings, in_chunks=tree.in_chunks, progress=progress)
    tree.nodes = Scene(*built, antialiased, up=up)
    tree.end("build")


def keep_tree(tree: BuiltTree, source: Source, scene: Scene) -> None:
    """Adapt an output to an input whose tree is kept.

    Nodes keep their opacities. In the same format, unset options are those of the file, and the codes of unchanged
    nodes are copied. A RAD file that changes only between one file and several has its chunks copied.

    Raises:
        FormatError: the settings neither change the format or container of the tree nor fit its merged splats; or some
            have no effect on a tree.
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
    if not is_same:
        tree.options = dataclasses.replace(options, covering=False)
        return
    assert not isinstance(source, Merged)  # whose parts have no trees
    is_plain = dataclasses.replace(options, rad=dataclasses.replace(options.rad, chunked=False)) == DEFAULTS
    if settings.refine is None and is_plain and tree.in_chunks:
        tree.form, tree.in_chunks, tree.repacked = None, False, source
        return
    with opened(source) as (file, form):
        codes, tree.options = form.codec().stored(file, options)
    tree.stored = codes, scene.splats


def put_in_order(tree: BuiltTree, threads: int, progress: Progress) -> None:
    """Put the nodes of a tree into the order of its output, and count them."""
    scene, baked = tree.scene, tree.baked
    assert scene.tree is not None
    baked.nodes, baked.sh_degree = len(scene), scene.splats.sh_degree
    baked.levels = int(scene.tree.depths().max()) + 1
    if tree.in_chunks and tree.stored is None:
        with on_threads(threads):
            from ..lod.chunk_order import chunk_order, reordered

            order, child_start = chunk_order(scene.splats, scene.tree, progress=progress)
            built, antialiased, up = [(scene.splats, scene.tree)], scene.antialiased, scene.up
            tree.nodes = None
            del scene  # `reordered` frees the nodes as it goes
            tree.nodes = scene = Scene(*reordered(built, order, child_start), antialiased=antialiased, up=up)
        tree.end("arrange")
    if tree.form is None:
        return
    needed = tree.form.codec().needed(tree.options)
    if tree.statistics is None:
        tree.statistics = Statistics.of_scene(scene, needed, threads=threads)
    else:
        assert scene.tree is not None
        inner = scene.splats.take(~scene.tree.is_leaf)
        merged = Statistics.of(inner, np.zeros(len(inner), np.bool_), needed, threads)
        tree.statistics = Statistics.merged([tree.statistics, merged])


def build_tree(
    leaves: list[Splats], settings: BakeSettings, *, in_chunks: bool, progress: Progress
) -> tuple[Splats, LodTree]:
    """Build the tree of splats, which are taken out of a list so that the builder can free them.

    With `in_chunks`, the nodes are put into the order for streaming later.
    """
    row = BUILDERS[settings.method]
    builder = import_module(f"..lod.{settings.method}", __package__)
    built = [builder.build(leaves.pop(), getattr(settings, row.setting), progress=progress)]
    if row.in_bands and not in_chunks:
        from ..lod.chunk_order import banded

        return banded(built)
    return built.pop()


def select(
    splats: Splats, settings: BakeSettings, *, start: int = 0, total: int | None = None, threads: int = 1
) -> tuple[Splats, SelectionTally]:
    """Recolour splats, limit their SH, and return the selected splats and a tally of all.

    Args:
        splats: of an input, all or some.
        start, total: number of the first splat, and of all splats of the input; None if these are all.
    """
    if settings.rgba is not None:  # SH stay, as where Spark is given new colours
        values = read_rgba(settings.rgba, len(splats) if total is None else total, slice(start, start + len(splats)))
        splats = dataclasses.replace(splats, rgb=np.ascontiguousarray(values[:, :3]), opacity=values[:, 3].copy())
    if settings.max_sh < splats.sh_degree:
        splats = splats.with_max_sh(settings.max_sh)
    selection = settings.selection
    drops_nothing = len(splats) and dataclasses.replace(selection, drop_invalid=False) == Selection()
    if drops_nothing and all(is_valid_and_visible(splats, threads)):
        return splats, SelectionTally(len(splats))
    keep, tally = selection.examine(splats, threads=threads)
    return (splats if keep.all() else splats.take(keep)), tally


def transform(splats: Splats, settings: Transform | None, threads: int = 1) -> tuple[Splats, int]:
    """Rotate, scale and move splats; also return how many left the range of float32."""
    turned = splats if settings is None else settings.apply(splats)
    if turned is splats or is_valid_and_visible(turned, threads)[0]:
        return turned, 0
    return turned, int(np.count_nonzero(~turned.is_valid()))


def check_transformed(beyond: int) -> None:
    """Raise `InvalidSplatsError` if a transform moved this many splats out of the range of float32."""
    if beyond:
        raise InvalidSplatsError(
            "scaled and moved like this, it leaves the range of float32; give a smaller --scale or --translate"
        )


def transformed(splats: Splats, settings: Transform | None, threads: int = 1) -> Splats:
    """Rotate, scale and move splats; fail if one leaves the range of float32."""
    turned, beyond = transform(splats, settings, threads)
    check_transformed(beyond)
    return turned


def read_environment(settings: BakeSettings, threads: int, progress: Progress) -> Splats:
    """Read and transform the splats of the environment's file; errors name it."""
    path = settings.environment
    assert path is not None
    with naming(f"the environment {path}", (FormatError, InvalidSplatsError)):
        scene = read_scene(path, threads=threads, progress=progress)
        if scene.tree is not None:
            raise FormatError("it is a Level-of-Detail file; give the splats that its tree was built from")
        selection = Selection(drop_invalid=settings.selection.drop_invalid)
        splats, tally = select(scene.splats, dataclasses.replace(settings, rgba=None, selection=selection))
        selection.check(tally)
        return transformed(splats, settings.transform, threads)


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
    if tree.stored is not None:
        codes, before = tree.stored
        encoder = encoder.keeping(codes, same_rows(tree.scene.splats, before))
    if encode is None:
        encoded = list(results(encoder, tree.scene, threads, progress, "encoding"))
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
    baked, out, settings, options = tree.baked, tree.out, tree.settings, tree.options
    rest = options, tree.end, threads, progress
    if tree.repacked is not None:
        _repack(tree.repacked, out, baked)
    elif settings.tiles is not None:
        from .parts_output import write_tiles

        baked.output_format = "3d-tiles"
        baked.bytes, baked.tiles = write_tiles(tree.scene, out, settings.tiles, *rest)
    elif settings.detail is not None:
        from .parts_output import write_levels

        baked.output_format = "streamed-sog"
        baked.bytes, baked.detail = write_levels(tree.scene, tree.environment, out, settings.detail, *rest)
    else:
        assert settings.simplify is not None
        from .simplifying import write_simplified

        form = WRITABLE[settings.suffix]
        baked.output_format = form.name
        # Opacities of a tree that was read already compensate for the rounding of its scales.
        options = dataclasses.replace(options, covering=baked.method is not None)
        baked.bytes, baked.simplified = write_simplified(
            tree.scene, settings.simplify, out, form, options, tree.end, threads, progress, leaves=baked.splats, **how
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
