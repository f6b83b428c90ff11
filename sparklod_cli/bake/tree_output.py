"""Output of a bake: its files and options, which are known before the tree is built, and writing the tree."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from ..codecs.encoder import CLAMPED, Encoder, Stored, Windows, clamps_of, windows_of
from ..codecs.formats import RAD_SUFFIX as RAD
from ..codecs.formats import WRITABLE, Format
from ..codecs.options import DEFAULTS, RAD_ENCODINGS, WriteOptions
from ..io.reading import Merged, Source, opened, read_stored
from ..io.writing import parts_output, scene_output
from ..model.scene import Scene
from ..model.splats import Splats, same_rows
from ..system.addresses import Place
from ..system.errors import FormatError
from ..system.output import Output
from ..system.progress import Progress
from .settings import SPZ, Baked, BakeSettings, BuiltTree, Clock

if TYPE_CHECKING:
    from .simplifying import Simplifier

#: Encodes the windows of a tree.
Encode = Callable[[BuiltTree, Encoder], Windows]


@dataclass(frozen=True)
class BakeOutput:
    """Destination of a tree.

    Attributes:
        out: its files.
        options: of its format.
        form: format of an SPZ or RAD file, which is written in windows; None for an output that is made of all nodes at
            once, in memory, and takes any tree.
        simplifier: of a simplified scene, else None.
        stored: codes of unchanged nodes, which keep them; None for none.
        before: (N,) nodes with these codes.
        repacked: RAD file whose chunks are copied; None for none.
    """

    out: Output
    settings: BakeSettings
    options: WriteOptions
    form: Format | None = None
    simplifier: Simplifier | None = None
    stored: Stored | None = None
    before: Splats | None = None
    repacked: Place | None = None

    @property
    def in_chunks(self) -> bool:
        """Whether viewers read it in chunks, for which nodes are ordered first."""
        return self.form is not None and self.form is WRITABLE[RAD]

    @property
    def needed(self) -> frozenset[str]:
        """Statistics of all nodes by which the codec settles options, see `codecs.statistics`."""
        return frozenset() if self.form is None else self.form.codec().needed(self.options)


def output_of(
    target: Place, settings: BakeSettings, *, overwrite: bool, say: Callable[[str], None] = lambda text: None
) -> BakeOutput:
    """Return the output of a bake; raise `OutputError` or `CameraPathError` now, before the work."""
    options = settings.options
    if settings.detail is not None or settings.tiles is not None:
        return BakeOutput(parts_output(target, overwrite=overwrite), settings, options)
    if settings.encoding is not None and settings.simplify is None:
        return BakeOutput(Output(target, overwrite=overwrite), settings, options)
    form = WRITABLE[settings.suffix]
    out = scene_output(target, form, chunked=options.rad.chunked, overwrite=overwrite)
    if settings.simplify is None:
        return BakeOutput(out, settings, options, form)
    from .simplifying import Simplifier

    return BakeOutput(out, settings, options, simplifier=Simplifier.of(settings, say))


def output_of_existing_tree(output: BakeOutput, source: Source, scene: Scene) -> tuple[BakeOutput, bool]:
    """Return the output of an input whose tree is kept, and whether its nodes are in order already.

    Nodes keep their opacities. In the same format, options that were not given are those of the file, and the codes of
    unchanged nodes are copied. Chunks of a RAD file that gets its other container are copied unless an option changes
    the encoding.

    Raises:
        FormatError: the settings neither change the format or container of the tree nor fit its merged splats; or they
            have options that only splats without a tree take.
    """
    settings = output.settings
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
    if output.form is None:
        return output, False
    options = output.options
    if is_same and settings.refine is not None:
        assert not isinstance(source, Merged)  # of which no part is a tree
        stored = read_stored(source)
        return dataclasses.replace(output, options=stored.like(options), stored=stored, before=scene.splats), True
    if is_same and dataclasses.replace(options, rad=dataclasses.replace(options.rad, chunked=False)) == DEFAULTS:
        assert not isinstance(source, Merged)
        return dataclasses.replace(output, form=None, repacked=source), False
    return dataclasses.replace(output, options=dataclasses.replace(options, covering=False)), False


def write_tree(tree: BuiltTree, encode: Encode, clock: Clock, threads: int, progress: Progress) -> None:
    """Write a tree whose nodes are in order to its output; all but SPZ and RAD files need its nodes in memory."""
    output, baked = tree.output, tree.baked
    out, settings, options = output.out, output.settings, output.options
    if output.form is not None:
        _write_windows(tree, output.form, encode, clock, threads, progress)
    elif output.repacked is not None:
        _repack(output.repacked, out, baked)
        clock.end("write")
    elif settings.tiles is not None:
        from .parts_output import write_tiles

        baked.output_format = "3d-tiles"
        baked.bytes, baked.tiles = write_tiles(tree.scene, out, settings.tiles, options, clock, threads, progress)
    elif settings.detail is not None:
        from .parts_output import write_levels

        baked.output_format = "streamed-sog"
        baked.bytes, baked.detail = write_levels(
            tree.scene, tree.environment, out, settings.detail, options, clock, threads, progress
        )
    elif output.simplifier is not None:
        from .simplifying import write_simplified

        write_simplified(tree, output.simplifier, clock, threads, progress)
    else:
        assert settings.encoding is not None
        from ..codecs.gpu import dump

        arrays = dump.pack(tree.scene, settings.encoding, threads)
        pieces = dump.encode(arrays, raw=settings.raw)
        with out:
            baked.bytes = out.write(out.target.name, pieces)
        baked.output_format, baked.arrays = settings.encoding, {name: words.shape for name, words in arrays.items()}
        clock.end("write")


def _write_windows(
    tree: BuiltTree, form: Format, encode: Encode, clock: Clock, threads: int, progress: Progress
) -> None:
    """Encode the windows of an SPZ or RAD file and write them."""
    output, baked, codec = tree.output, tree.baked, form.codec()
    settled: WriteOptions = codec.settled(tree.statistics, output.options)
    ranges = tuple(codec.held(settled, baked.sh_degree))
    encoder: Any = codec.encoder(tree.nodes, settled, ranges, threads=threads, progress=progress)
    if output.stored is not None and output.before is not None:
        encoder = output.stored.keeping(encoder, same_rows(tree.scene.splats, output.before))
    windows, options, count = encode(tree, encoder), encoder.options, encoder.count
    numbers = range(len(windows_of(count)))
    with output.out as out:
        name = out.target.name
        if out.siblings is None:
            for piece in encoder.pieces(windows, threads=threads, progress=progress):
                baked.bytes += out.write(name, (piece,))
        else:
            chunks = (windows(number, codec.CHUNK).tobytes() for number in numbers)
            for each, pieces in encoder.files(chunks, PurePath(name).stem, progress=progress):
                baked.bytes += out.write(each, pieces)
    if ranges:
        baked.clamped, baked.clamps = clamps_of([windows(number, CLAMPED) for number in numbers], ranges)
    clock.end("write")
    if not output.in_chunks:
        baked.output_format, baked.version, baked.fractional_bits = "spz", options.spz_version, options.fractional_bits
        return
    baked.output_format = "rad-chunked" if options.rad.chunked else "rad"
    baked.chunks = len(numbers)
    baked.encodings = {name: getattr(options.rad, name) for name in RAD_ENCODINGS if encoder.sh_degree or name != "sh"}
    if options.rad.sh_codes and encoder.sh_degree:
        baked.sh_codes = min(options.rad.sh_codes, count)


def _repack(source: Place, out: Output, baked: Baked) -> None:
    """Write a RAD file with the chunks of another one."""
    with opened(source) as (file, form, more), out:
        chunks = form.codec().RadReader.open(file, **more)
        name = out.target.name
        files = [(name, chunks.in_one_file())] if out.siblings is None else chunks.in_files(PurePath(name).stem)
        baked.bytes = sum(out.write(*each) for each in files)
        baked.encodings = chunks.encodings
    baked.output_format = "rad" if chunks.header.chunked else "rad-chunked"
    baked.chunks, baked.sh_codes = len(chunks.header.chunks), chunks.header.sh_code_count
