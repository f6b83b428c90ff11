"""Tables of file formats and of layouts in a viewer's memory, options of writing, and names of the files of a scene.

Adding a format is a module and a row here. Imports nothing heavy, since `--help` lists formats and options.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Collection
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, BinaryIO, ClassVar, Literal

from ..system.setting_fields import CheckedSettings, Quantity, setting, whole
from ..system.untrusted import keys_of_object, printable

if TYPE_CHECKING:
    from .spark_codings import SplatEncoding

#: Bytes at the beginning of a file by which its format is recognized, and of a JSON object, whose first value may be
#: long.
HEAD, JSON_HEAD = 1 << 16, 1 << 22


#: The name of the format that can be read chunk by chunk.
RAD = "RAD"

#: Beginning of a zip that is not empty.
ZIP = b"PK\x03\x04"


@dataclass(frozen=True)
class Format:
    """A file format.

    Attributes:
        name: for display.
        module: in this package; has `open_content(source) -> Reader`, which raises `FormatError` if the file is of
            another format, cut short or corrupt.
        endings: of the names of files that are written, suffixes or the name in `unbundled`; empty if it is only read.
            Its module also has `encode(scene, options, *, threads, progress) -> Iterator[bytes]`;
            `settled(scene, options) -> WriteOptions`, the options with nothing left open, which raises `FormatError`
            if the scene cannot be written; and, if it clamps values, `held(options, sh_degree)`, the
            `encoder.CodeRange`s that it can hold.
        unbundled: the name of the first of the files as which a scene can also be written, all in one folder; None if
            there is no such way. Its module then has `encode_files(scene, options, *, threads, progress)`, too, which
            yields the name and the bytes of each, this one last.
        trees: it can be written with a Level-of-Detail tree. Its `settled` then takes the `Statistics`, too, that
            `needed(options)` names; `encoder(scene, options, *, counting, threads, progress)` gives its
            `encoder.Encoder`, and `stored(source, options)` the codes of a file, for `Encoder.keeping`, and the
            options, which have the value of the file where they leave a choice open.
        suffixes: lower case, with the dot.
        beginning: a regular expression that the first bytes of its files match; None for formats without one.
        keys: that its files have at the top level, which are JSON objects; empty if they are not. Without `beginning`
            and `keys`, any bytes are possible, so that only the suffix decides.
        companions: its files refer to others beside them, which the `open_companion` of a source opens.
        folders: those may be in folders there.
        parts: the units that viewers choose instead of single splats: "levels" of detail, or "tiles" that replace each
            other; None if its files have neither. Its module then has `decode_parts(file, *, threads,
            progress, open_companion)`, which gives a `DetailScene` or a `TileScene`, and `encode_files` of such a
            scene, as above.
        bare: its files hold only splats, and no notes, see `reader.note_of`.
    """

    name: str
    module: str
    suffixes: tuple[str, ...]
    beginning: bytes | None
    endings: tuple[str, ...] = ()
    trees: bool = False
    unbundled: str | None = None
    companions: bool = False
    folders: bool = False
    parts: Literal["levels", "tiles"] | None = None
    bare: bool = False
    keys: tuple[str, ...] = ()

    @property
    def unmarked(self) -> bool:
        """Whether its files may begin with any bytes."""
        return self.beginning is None and not self.keys

    def codec(self) -> Any:
        """Import the module."""
        return import_module(f".{self.module}", __package__)


#: The formats in the order in which they are tried: compressed PLY is PLY too. A .splat file begins with any float, a
#: .hier file with any number of splats and a float, so no beginning may have two bytes or fewer.
FORMATS = (
    Format(
        "compressed PLY",
        "ply",
        (".ply",),
        rb"ply\s(?:(?!end_header).)*[\r\n]\s*property\s+\w+\s+packed_position\s",
    ),
    Format("PLY", "ply", (".ply",), rb"ply[\r\n]", (".ply",)),
    # Gzipped up to version 3.
    Format("SPZ", "spz", (".spz",), rb"\x1f\x8b\x08[\0-\x1f]|NGSP", (".spz",), trees=True),
    # RADC begins a chunk, which the codec refuses with what to give instead.
    Format(RAD, "rad.rad_writer", (".rad",), rb"RAD[0C]", (".rad",), trees=True, companions=True),
    Format(
        "Streamed SOG",
        "streamed_sog",
        (".json",),
        None,
        companions=True,
        folders=True,
        parts="levels",
        keys=("lodLevels",),
    ),
    Format(
        "3D Tiles",
        "tiles_3d",
        (".json",),
        None,
        companions=True,
        folders=True,
        parts="tiles",
        keys=("geometricError",),
    ),
    # GLB as JSON, whose keys are in any order; a meta.json of SOG is JSON, too.
    Format(
        "glTF",
        "gltf",
        (".gltf",),
        rb"(?:\xef\xbb\xbf)?\s*\{.*?\"(?:accessors|bufferViews|buffers|meshes)\"\s*:\s*\[",
        companions=True,
        folders=True,
    ),
    # A zip that begins with NAME/data.pkl; SOG is a zip, too.
    Format("checkpoint", "checkpoint", (".pt", ".ckpt"), rb"PK\x03\x04.{26}[^/]{1,200}/data\.pkl"),
    # A zip, or its meta.json unpacked.
    Format(
        "SOG",
        "sog",
        (".sog", ".json"),
        rb"PK\x03\x04",
        (".sog", "meta.json"),
        unbundled="meta.json",
        companions=True,
        keys=("means", "quats"),
    ),
    Format("GLB", "gltf", (".glb",), rb"glTF", (".glb",), companions=True, folders=True),
    # Version 0.1 on, as a float denormal, and fewer than 2 ** 24 sections, which as a float would be, too.
    Format("KSPLAT", "ksplat", (".ksplat",), rb"\0[\x01-\xff]\0\0...\0"),
    Format("HIER", "hier", (".hier",), None),
    Format("SPLAT", "splat", (".splat",), None, (".splat",), bare=True),
)

#: The formats that can be written, by how the name of the file ends, see `Format.endings`.
WRITABLE = {ending: form for form in FORMATS for ending in form.endings}

#: SPZ versions that can be written, those that hold trees, and the default; see docs/decisions/05-spz.md.
SPZ_VERSIONS, TREE_SPZ_VERSIONS, DEFAULT_SPZ_VERSION = (2, 3, 4), (2, 3), 3

#: Largest number of fractional bits of an SPZ position.
MAX_FRACTIONAL_BITS = 24

#: Deflate levels, and the default; measured in docs/decisions/05-spz.md.
MIN_COMPRESSION, MAX_COMPRESSION, DEFAULT_COMPRESSION = 1, 9, 5

#: Entries of a palette of spherical harmonics: labels have 16 bits in RAD and in SOG.
MAX_SH_CODES = 65_536
SH_CODES = whole(2, MAX_SH_CODES)

#: Profiles of GLB: attributes as KHR_gaussian_splatting defines them, and SPZ as CesiumJS reads it.
KHRONOS, CESIUM = PROFILES = ("khronos", "cesium")


def _bits(text: str) -> int | None:
    if text != "auto" and not text.isdecimal():
        raise ValueError(f"{text!r} is neither auto nor a whole number")
    return None if text == "auto" else int(text)


#: The encodings that each property of RAD may be in, as Spark reads them; the first is the one that Spark writes.
RAD_ENCODINGS = {
    "center": ("f32_lebytes", "f32", "f16_lebytes", "f16"),
    "alpha": ("f16", "r8", "f32"),
    "rgb": ("r8_delta", "r8", "f16", "f32"),
    "scales": ("ln_0r8", "ln_f16", "f32"),
    "orientation": ("oct88r8", "f16", "f32"),
    "sh": ("s8", "s8_delta", "r8", "r8_delta", "f16", "f32"),
}

#: Leaves the choice of an encoding to the writer, which goes by the scene.
AUTO = "auto"

#: The values of their options.
RAD_CHOICES = {name: (AUTO, *encodings) for name, encodings in RAD_ENCODINGS.items()}


@dataclass(frozen=True)
class RadOptions(CheckedSettings):
    """Options of RAD files; encodings are explained in `rad.property_codings`.

    Attributes:
        chunked: write each chunk into a file of its own.
        ranges: of the codes; None for those that suit the scene.
    """

    HEADING: ClassVar[str] = "RAD"

    center: str = setting("Encoding of centres; auto suits the scene.", RAD_CHOICES["center"], AUTO, name="rad_center")
    alpha: str = setting("Encoding of opacities; auto suits the scene.", RAD_CHOICES["alpha"], AUTO, name="rad_alpha")
    rgb: str = setting("Encoding of colours; auto suits the scene.", RAD_CHOICES["rgb"], AUTO, name="rad_rgb")
    scales: str = setting("Encoding of scales; auto suits the scene.", RAD_CHOICES["scales"], AUTO, name="rad_scales")
    orientation: str = setting(
        "Encoding of rotations; auto suits the scene.", RAD_CHOICES["orientation"], AUTO, name="rad_orientation"
    )
    sh: str = setting("Encoding of spherical harmonics; auto suits the scene.", RAD_CHOICES["sh"], AUTO, name="rad_sh")
    chunked: bool = False
    sh_codes: int | None = setting(
        "Most entries of a palette of spherical harmonics, which a label for each splat points into; None for"
        " coefficients of each splat's own.",
        SH_CODES,
        only_api=True,
    )
    center_bits: int | None = setting(
        "Round centres to multiples of 2 ** -center_bits; None leaves them as they are, but where `center` is auto it"
        " is chosen, too.",
        whole(-149, 149),  # the smallest number of float32 has 149 binary digits after the point
        only_api=True,
    )
    ranges: SplatEncoding | None = None


@dataclass(frozen=True)
class SogOptions(CheckedSettings):
    """Options of SOG files."""

    sh_codes: int | None = setting(
        "Most entries of the palette of spherical harmonics, which a label for each splat points into; None for as many"
        " as suit the number of splats, see `sog.codes_for`.",
        SH_CODES,
        only_api=True,
    )


@dataclass(frozen=True)
class WriteOptions(CheckedSettings):
    """Options of splat files. PLY and .splat have none of these choices, and ignore all of them.

    Attributes:
        rad: of RAD.
        sog: of SOG.
        sh_bits: upper bits kept of each SH byte of SPZ, 4 to 8; None for as many as colours need (`statistics.enough`).
            Merged splats keep 4, and 5 of degree 1, as other writers do with all splats.
        covering: opacities make up for the rounding of scales, see `quantize.compensated`; False where splats of a tree
            are written in another format, so that they keep their opacities.
    """

    HEADING: ClassVar[str] = "File format"

    spz_version: int | None = setting(
        "SPZ version: 2 gives files 4 to 8 % smaller, 3 rotations ten times as exact. 4 is 3 in zstd, for files without"
        f" a tree (convert, simplify).  [default: {DEFAULT_SPZ_VERSION}]",
        SPZ_VERSIONS,
    )
    fractional_bits: int | None = setting(
        "Bits after the binary point of SPZ positions, 0 to 24; auto goes by the extent of the scene and its smallest"
        " splats.  [default: auto]",
        Quantity("auto|N", _bits, whole(0, MAX_FRACTIONAL_BITS)),
    )
    compression_level: int = setting(
        "Compression of SPZ and RAD, from 1 (fast) to 9 (small).",
        whole(MIN_COMPRESSION, MAX_COMPRESSION),
        DEFAULT_COMPRESSION,
    )
    rad: RadOptions = field(default_factory=RadOptions)
    sog: SogOptions = field(default_factory=SogOptions)
    sh_bits: int | None = None
    covering: bool = True
    glb_profile: str | None = setting(
        "GLB with 32-bit floats, as KHR_gaussian_splatting defines it, or with SPZ inside, as CesiumJS reads it."
        f"  [default: {KHRONOS}; {CESIUM} of 3D Tiles]",
        PROFILES,
    )


#: Options that leave every choice to the writer.
DEFAULTS = WriteOptions()


#: Layouts of `convert --layout`, see `layouts.pack_layout`; docs/formats/memory.md has the arrays of each.
ENCODINGS = ("packed", "ext", "lodtree", "texture")

#: Layouts after which `spark_nodes.nodes` measures nodes, as Spark does once it has loaded a file: ExtSplats,
#: PackedSplats of a file that it loads whole, and those of a RAD file that it streams.
LOADED = ("ext", "packed", "packed-pages")

#: Encodings whose rounding `losses.after` shows: PackedSplats as Spark has them for a scene, ExtSplats, and SPZ and RAD
#: as build-lod writes them.
ROUND_TRIPS = ("packed", "ext", "spz", "rad")

#: Precisions of the nodes that cuts are found with: the file's, its half floats, and what Spark has in each layout.
PRECISIONS = ("float32", "float16", *LOADED)

#: Suffix of dumps with a header.
NPZ = ".npz"

#: Suffixes of dumps without one: nothing but the words of all arrays, one after the other.
RAW_SUFFIXES = (".bin", ".raw")


def ending_of(name: str) -> str:
    """Return how a name ends, as `WRITABLE` knows it, in lower case: "meta.json", or the suffix, which may be other."""
    name = name.lower()
    return name if any(name == form.unbundled for form in FORMATS) else PurePath(name).suffix


def head_of(file: BinaryIO) -> bytes:
    """Read the bytes at the beginning of a file by which its format is recognized, and return to it."""
    head = file.read(HEAD)
    if len(head) == HEAD and _keys(head) and sniff(head, "") is None:
        head += file.read(JSON_HEAD - HEAD)
    file.seek(0)
    return head


#: The keys of the object that a file begins with, see `keys_of_object`: several functions ask for those of one head.
_keys = functools.lru_cache(1)(keys_of_object)


def sniff(head: bytes, suffix: str) -> Format | None:
    """Return the format of a file by its first bytes, see `head_of`, or else by its suffix; None if that is not known.

    The suffix decides only for formats that may begin with any bytes, and not if the file is recognized as something
    else; and that of `NPZ` tells arrays from a scene, which are a zip both.
    """
    if not head or (head.startswith(ZIP) and suffix.lower() == NPZ):
        return None
    for form in FORMATS:
        if form.beginning is not None and re.match(form.beginning, head, re.DOTALL):
            return form
        if form.keys and set(form.keys) <= set(_keys(head)):
            return form
    if lookalike_of(head) is not None:
        return None
    return next((form for form in FORMATS if form.unmarked and suffix.lower() in form.suffixes), None)


#: What a clone that was made without Git LFS has in place of a file, of any kind.
POINTER = "a Git LFS pointer; run git lfs pull to get the file"
POINTED = rb"version https://git-lfs\.github\.com/spec/v1\s"

#: Bytes at the beginning of a file that suffice to recognize a pointer.
SHORT = 64

#: Keys of an unknown object that a message names, and the characters that they may take.
FEW, QUOTED = 5, 100


_CAMERAS = "a file of cameras; give it as --camera-path"

#: Kinds of files that hold no splats, or none that are read, in the order in which they are tried: a description and
#: advice, to follow "not a splat file, but"; a regular expression that the first bytes match, None if any JSON object
#: with the keys is one; and the keys at the top level.
LOOKALIKES: tuple[tuple[str, bytes | None, tuple[str, ...]], ...] = (
    (POINTER, POINTED, ()),
    ("a web page, perhaps of a download that failed", rb"\s*<(?i:!doctype html|html)", ()),
    ("a glTF without splats", None, ("asset", "nodes")),
    (_CAMERAS, None, ("frames",)),
    (_CAMERAS, None, ("cameras",)),
    (_CAMERAS, None, ("keyframes",)),
    (_CAMERAS, None, ("camera_path",)),
    ("the manifest of an LCC scene; convert it to another format", None, ("totalLevel",)),
    # Longer than two bytes, as a .splat or .hier file may begin with any number.
    ("a JSON list; if it holds cameras, give it as --camera-path", rb"(?:\xef\xbb\xbf)?\s*\[\s*\{\s*\"\w+\"\s*:", ()),
)


def lookalike_of(head: bytes) -> str | None:
    """Describe a file of no known format by its first bytes; None if they do not identify it."""
    keys = _keys(head)
    for text, beginning, wanted in LOOKALIKES:
        if beginning is not None and re.match(beginning, head):
            return text
        if wanted and set(wanted) <= set(keys):
            return text
    if not keys:
        return None
    named = printable(", ".join(keys[:FEW]), QUOTED) + (", ..." if len(keys) > FEW else "")
    return f"a JSON object of no format that holds splats ({named})"


def is_pointer(head: bytes) -> bool:
    """Return True if a file that begins so is a pointer of Git LFS."""
    return re.match(POINTED, head) is not None


# Names of files, as Spark and PlayCanvas's tools choose them.

#: Suffixes of a RAD file, and of a chunk that is a file of its own.
RAD_SUFFIX, RAD_CHUNK_SUFFIX = ".rad", ".radc"

#: The file of an unpacked SOG that names its images, and these by texture, in the order in which it names them.
META = "meta.json"
SOG_IMAGES = {
    "means": ("means_l.webp", "means_u.webp"),
    "scales": ("scales.webp",),
    "quats": ("quats.webp",),
    "sh0": ("sh0.webp",),
    "shN": ("shN_centroids.webp", "shN_labels.webp"),
}

#: The manifest of a Streamed SOG. Its other files are in folders beside it.
MANIFEST = "lod-meta.json"

#: The folder of the environment of a Streamed SOG, and its file: a bundled SOG, the only form that both PlayCanvas and
#: Babylon.js read. Former outputs have it unpacked in the same folder.
ENVIRONMENT = "env"
ENVIRONMENT_FILE = f"{ENVIRONMENT}/env.sog"

#: The manifest of 3D Tiles, and the folder of its other files: tiles, by level and number, and nested tilesets.
TILESET, TILES = "tileset.json", "tiles"

#: Files that name all other files of a scene, in a folder or in a zip.
FIRST_FILES = (MANIFEST, TILESET, META)

_ALL_IMAGES = [name for names in SOG_IMAGES.values() for name in names]
_TILE = re.compile(re.escape(TILES) + r"/(?:0|[1-9]\d{0,8})-(?:0|[1-9]\d{0,8})\.(?:glb|json)", re.ASCII)
_CHUNK_FOLDER = re.compile(r"(?:0|[1-9]\d{0,8})_(?:0|[1-9]\d{0,8})", re.ASCII)


def rad_chunk_name(stem: str, number: int) -> str:
    """Return the name of the file of a chunk."""
    return f"{stem}-{number}{RAD_CHUNK_SUFFIX}"


def rad_chunk_number(name: str, stem: str) -> int | None:
    """Return the number of the chunk whose file has this name; None for other names."""
    match = re.fullmatch(r"(0|[1-9][0-9]{0,8})" + re.escape(RAD_CHUNK_SUFFIX), name.removeprefix(f"{stem}-"))
    return int(match[1]) if match and name.startswith(f"{stem}-") else None


def sog_image_number(name: str) -> int | None:
    """Return the number of the image of a SOG whose file has this name, over all textures; None for other names."""
    return _ALL_IMAGES.index(name) if name in _ALL_IMAGES else None


def chunk_folder(level: int, number: int) -> str:
    """Return the folder of a chunk of a detail level of a Streamed SOG."""
    return f"{level}_{number}"


def is_chunk_folder(name: str) -> bool:
    """Return True if a folder has the name of one of a Streamed SOG."""
    return name == ENVIRONMENT or _CHUNK_FOLDER.fullmatch(name) is not None


def is_in_manifest(name: str) -> bool:
    """Return True if the manifest of an output could name a file: the meta.json of a chunk, or the environment."""
    folder, _, file = name.partition("/")
    return name == ENVIRONMENT_FILE or (is_chunk_folder(folder) and file == META)


def is_of_streamed_sog(name: str) -> bool:
    """Return True if a file could be of an output: named by its manifest, or an image in a folder of it."""
    folder, _, file = name.partition("/")
    return is_in_manifest(name) or (is_chunk_folder(folder) and sog_image_number(file) is not None)


def is_of_tileset(name: str) -> bool:
    """Return True if a file could be of an output of 3D Tiles: a tile or a nested tileset in their folder."""
    return _TILE.fullmatch(name) is not None


def folders_of(names: Collection[str]) -> list[str]:
    """Return the folders of files, by their names."""
    return sorted({folder for folder, mark, _ in (name.partition("/") for name in names) if mark})
