"""Outputs of `sparklod build-lod`: their names and formats, and which options suit these."""

from __future__ import annotations

from dataclasses import dataclass

import click

from ..codecs.file_names import MANIFEST
from ..codecs.file_names import RAD_SUFFIX as RAD
from ..codecs.formats import FORMATS, NPZ, RAW_SUFFIXES, WRITABLE, ending_of
from ..support.addresses import Place
from ..support.stdin import DASH
from .options.baking import (
    FORMS,
    OF_BOTH,
    OF_PALETTES,
    OF_PLACE,
    OF_RAD,
    OF_SELECTION,
    OF_SPZ,
    OF_TREES,
    STREAMED_SOG,
)
from .options.detail import HEADING as DETAIL
from .options.detail import OF_DETAIL
from .paths import require_suffix, stem_of
from .usage import is_given, refuse

#: Suffixes of the formats in which a tree can be written, and what they are called; the first one is the default.
TREES = {suffix: form.name for suffix, form in WRITABLE.items() if form.trees}
SPZ = next(iter(TREES))

#: Suffixes of formats that hold no tree, and how else their names end.
PLAIN = {ending for form in FORMATS for ending in (*form.suffixes, *form.endings) if not form.trees}

#: Formats whose spherical harmonics can be a palette.
WITH_PALETTE = ("RAD", "SOG")


#: Values of --skip-existing: read only files whose size or date changed, or all.
BY_DATE, VERIFY = "date", "verify"


@dataclass(frozen=True)
class Outputs:
    """Where outputs go.

    Attributes:
        output: the file of a single input.
        output_dir: the folder of all of them.
        overwrite: replace files that exist.
        unlod: write the splats of trees.
        inputs: what they are made of.
        refine: steps by which merged splats are fitted; None for not at all.
        skip_existing: make nothing that is there already: `BY_DATE` or `VERIFY`; None makes all.
        form: of the outputs, a key of `FORMS`; None where nobody chose.
        encoding: of array files.
    """

    output: Place | None
    output_dir: Place | None
    overwrite: bool
    unlod: bool
    inputs: tuple[Place, ...]
    refine: int | None
    skip_existing: str | None
    form: str | None
    encoding: str | None

    @property
    def named_suffix(self) -> str:
        """Of the output that was named, if one was; or its name where that tells the format, see `ending_of`."""
        return ending_of(self.output.name) if self.output is not None and self.output != DASH else ""

    @property
    def is_raw(self) -> bool:
        """Whether words go out alone: what is named is no .npz."""
        return self.output is not None and self.named_suffix != NPZ

    @property
    def suffix(self) -> str:
        """Of the format that is written, which a name need not have."""
        if self.encoding:
            return NPZ
        if self.form is not None:
            return FORMS[self.form][0]
        return self.named_suffix or (RAD if self.refine is not None and self._suffixes == {RAD} else SPZ)

    @property
    def _suffixes(self) -> set[str]:
        """Of the inputs."""
        return {source.suffix.lower() for source in self.inputs}

    @property
    def may_replace_inputs(self) -> bool:
        """Whether an input may be its own output: of a tree that is refined, the leaves and links stay."""
        return self.refine is not None and self.overwrite and not self.skip_existing

    @property
    def is_streamed_sog(self) -> bool:
        """Whether regions at several detail levels are written."""
        return self.form == STREAMED_SOG or (self.is_manifest and not (self.form or self.encoding or self.unlod))

    @property
    def is_manifest(self) -> bool:
        """Whether the output that was named is called as a Streamed SOG has to be."""
        return self.output is not None and self.output != DASH and self.output.name == MANIFEST

    @property
    def is_chunked(self) -> bool:
        """Whether the chunks of a RAD are files of their own."""
        return self.form is not None and FORMS[self.form][1]

    @property
    def is_folder(self) -> bool:
        """Whether the output is the first of several files in its folder."""
        return self.suffix in WRITABLE and self.suffix == WRITABLE[self.suffix].unbundled

    @property
    def format_is_asked_for(self) -> bool:
        """Whether somebody chose the format, by --format or by a name."""
        return self.form is not None or self.named_suffix in TREES or self.is_streamed_sog

    def check_kept_format(self) -> None:
        """Raises a `click.UsageError` where trees of several formats would have to be refined as one format."""
        chosen = self.form is not None or self.encoding is not None or self.output is not None
        if self.refine is not None and not chosen and RAD in self._suffixes and len(self._suffixes) > 1:
            raise click.UsageError(
                "--refine keeps the format of a Level-of-Detail file, and the inputs are of several; give --format, or"
                " refine the .rad files on their own"
            )

    def target(self, source: Place) -> Place:
        """Where an input goes."""
        return self.output or (self.output_dir or source.parent) / self._name(source)

    def _name(self, source: Place) -> str:
        stem = stem_of(source)
        if self.is_streamed_sog:
            return f"{stem.removesuffix('-lod')}-lod/{MANIFEST}"
        if self.unlod:
            return f"{stem.removesuffix('-lod')}-unlod{self.suffix}"
        known = self.form is not None or self.refine is not None
        if known and source.suffix.lower() in TREES:  # a tree in another format has its name
            stem = stem.removesuffix("-lod")
        name = f"{stem}-lod{self.suffix}"
        return f"{stem}-lod-refined{self.suffix}" if self.refine is not None and name == source.name else name


def check_formats(ctx: click.Context, outputs: Outputs) -> None:
    """Raises a `click.UsageError` where the options of formats, and the name of the output, contradict each other."""
    suffix = outputs.named_suffix
    outputs.check_kept_format()
    if outputs.is_streamed_sog:
        _check_streamed_sog(ctx, outputs)
        return
    if outputs.is_chunked and outputs.output == DASH:
        raise click.UsageError("--format rad-chunked writes several files; name the output, or use --format rad")
    if outputs.encoding:
        refuse(ctx, ("form",), "cannot be used with --encoding")
        refuse(ctx, OF_SPZ, "is an option of SPZ, not of --encoding")
        refuse(ctx, OF_RAD, "is an option of RAD, not of --encoding")
        refuse(ctx, OF_BOTH, "is an option of SPZ and RAD, not of --encoding")
        refuse(ctx, OF_DETAIL, f"is an option of {DETAIL}, not of --encoding")
        refuse(ctx, OF_PALETTES, "is an option of RAD and SOG, not of --encoding")
    if outputs.form is not None and suffix not in ("", outputs.suffix):
        raise click.UsageError(f"--format {outputs.form} writes {outputs.suffix}, not {suffix}")
    if outputs.output is not None and outputs.form is None:
        arrays, trees = (NPZ, *RAW_SUFFIXES), (*TREES, MANIFEST)
        require_suffix("--output", outputs.output, arrays if outputs.encoding else WRITABLE if outputs.unlod else trees)
    if outputs.unlod:
        _check_unlod(ctx, outputs)
    elif outputs.encoding:
        if suffix not in ("", NPZ, *RAW_SUFFIXES):
            raise click.UsageError(f"--encoding writes {', '.join((NPZ, *RAW_SUFFIXES))}, not {suffix}")
        return
    else:
        _check_tree(suffix)
    name = TREES.get(outputs.suffix)
    detail = f"name the output {MANIFEST}, or add --format {STREAMED_SOG}"
    refuse(ctx, OF_DETAIL, f"is an option of {DETAIL}, not of {name or suffix}; {detail}")
    if name != TREES[SPZ]:
        refuse(ctx, OF_SPZ, f"is an option of SPZ, not of {name or suffix}")
    if name != "RAD":
        refuse(ctx, OF_RAD, f"is an option of RAD, not of {name or suffix}; name the output .rad, or add --format rad")
    if name is None:
        refuse(ctx, OF_BOTH, f"is an option of SPZ and RAD, not of {suffix}")
    written = WRITABLE[outputs.suffix].name
    if written not in WITH_PALETTE:
        more = "" if outputs.unlod else "; name the output .rad, or add --format rad"
        refuse(ctx, OF_PALETTES, f"is an option of RAD and SOG, not of {written}{more}")


def _check_streamed_sog(ctx: click.Context, outputs: Outputs) -> None:
    flag = f"--format {STREAMED_SOG}"
    refuse(ctx, ("unlod", "encoding"), f"cannot be used with {flag}")
    if outputs.output == DASH:
        raise click.UsageError(f"{flag} writes several files; name the output, such as web/{MANIFEST}")
    if outputs.output is not None and not outputs.is_manifest:
        raise click.UsageError(
            f"{flag} writes {MANIFEST} and folders beside it, not {outputs.output.name}; name the output"
            f" {outputs.output.parent / outputs.output.stem / MANIFEST}"
        )
    refuse(ctx, OF_SPZ, f"is an option of SPZ, not of {DETAIL}")
    refuse(ctx, OF_RAD, f"is an option of RAD, not of {DETAIL}")
    refuse(ctx, OF_BOTH, f"is an option of SPZ and RAD, not of {DETAIL}")
    if is_given(ctx, "environment"):
        refuse(ctx, ("environment_beyond",), "cannot be used with --environment")


def _check_unlod(ctx: click.Context, outputs: Outputs) -> None:
    suffix = outputs.named_suffix
    if outputs.is_manifest:
        raise click.UsageError(f"--unlod writes splats without detail levels, not {MANIFEST}")
    refuse(ctx, (*OF_TREES, *OF_SELECTION, *OF_PLACE, "encoding"), "cannot be used with --unlod")
    if suffix not in ("", *WRITABLE):
        raise click.UsageError(f"--unlod writes {', '.join(WRITABLE)}, not {suffix}")


def _check_tree(suffix: str) -> None:
    known = f"{', '.join(TREES)} or {MANIFEST}"
    if suffix in (NPZ, *RAW_SUFFIXES):
        raise click.UsageError(f"{suffix} is a file of arrays; choose their layout with --encoding")
    if suffix in PLAIN:
        raise click.UsageError(f"{suffix} cannot hold a tree; name the output {known}")
    if suffix not in ("", *TREES):
        names = f"{', '.join(TREES.values())} or {DETAIL}"
        raise click.UsageError(f"trees are written as {names}, not as {suffix}; name the output {known}")
