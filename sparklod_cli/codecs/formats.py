"""Tables of file formats and of layouts in a viewer's memory, options of writing, and names of the files of a scene.

Adding a format is a module and a row here. Imports nothing heavy, since `--help` lists formats and options.
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, BinaryIO, ClassVar, Literal

from ..system.setting_fields import CheckedSettings, Quantity, setting, whole
from ..system.untrusted import keys_of_object, printable

if TYPE_CHECKING:
    from .spark_codings import SplatEncoding

#: Bytes at the beginning of a file from which its format is recognized; more for JSON, whose first value may be long.
HEAD, JSON_HEAD = 1 << 16, 1 << 22

#: Name of the format that can be read chunk by chunk.
RAD = "RAD"

#: First bytes of a zip that is not empty.
ZIP = b"PK\x03\x04"


@dataclass(frozen=True)
class Format:
    """A file format.

    Attributes:
        name: name for display.
        module: module in this package, with `open_content(source) -> Reader`, which raises `FormatError` for a file
            of another format, and for one that is cut short or corrupt.
        suffixes: suffixes of files that are read, in lower case and with the dot.
        beginning: regular expression that matches the first bytes of files; None for formats without one.
        keys: keys at the top level of files that are JSON objects; else empty. If there is neither `beginning` nor
            `keys`, files may begin with any bytes, and only the suffix decides.
        endings: ends of the names of files that are written, which are suffixes or `unbundled`; empty for formats that
            are only read. The module also has `encode(scene, options, *, threads, progress) -> Iterator[bytes]`;
            `settled(scene, options) -> WriteOptions`, which replaces None in the options by values for the scene, and
            raises `FormatError` if it cannot be written; and, if values are clamped, `held(options, sh_degree)`, the
            `encoder.CodeRange`s of values that are not.
        unbundled: name of the file that names the others, for a format that can also be written as several files in
            one folder; else None. The module then also has `encode_files(scene, options, *, threads, progress)`,
            which yields the name and the bytes of each file, this one last.
        trees: files can be written with a Level-of-Detail tree. `settled` then also takes the `Statistics` that
            `needed(options)` names; `encoder(scene, options, *, counting, threads, progress)` returns an
            `encoder.Encoder`; and `stored(source, options)` returns the codes of a file, for `Encoder.keeping`, and
            the options, in which the values of the file replace None.
        companions: files name other files beside them, which the `open_companion` of a source opens.
        folders: companions may be in folders.
        parts: units that viewers choose instead of single splats: "levels" of detail, or "tiles" that replace each
            other; None for single splats. The module then has `decode_parts(file, *, threads, progress,
            open_companion)`, which returns a `DetailScene` or a `TileScene`, and `encode_files` takes such a scene.
        bare: files store splats only, and no notes, see `reader.note_of`.
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


#: The formats in the order in which they are tried: compressed PLY is PLY, too. No beginning may have two bytes or
#: fewer: a .splat file begins with any float, and a .hier file with any number of splats and a float.
FORMATS = (
    Format(
        "compressed PLY", "ply", (".ply",), rb"ply\s(?:(?!end_header).)*[\r\n]\s*property\s+\w+\s+packed_position\s"
    ),
    Format("PLY", "ply", (".ply",), rb"ply[\r\n]", (".ply",)),
    # Gzipped up to version 3.
    Format("SPZ", "spz", (".spz",), rb"\x1f\x8b\x08[\0-\x1f]|NGSP", (".spz",), trees=True),
    # A file that begins with RADC is a chunk; the error of the codec says which file to give instead.
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
        "3D Tiles", "tiles_3d", (".json",), None, companions=True, folders=True, parts="tiles", keys=("geometricError",)
    ),
    # JSON with keys in any order; a meta.json of SOG is JSON, too.
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
    # Version 0.1 or later, which is a denormal as a float, and fewer than 2 ** 24 sections, which are denormal, too.
    Format("KSPLAT", "ksplat", (".ksplat",), rb"\0[\x01-\xff]\0\0...\0"),
    Format("HIER", "hier", (".hier",), None),
    Format("SPLAT", "splat", (".splat",), None, (".splat",), bare=True),
)

#: The formats that can be written, by the end of the file name, see `Format.endings`.
WRITABLE = {ending: form for form in FORMATS for ending in form.endings}

#: SPZ versions that can be written, those that hold trees, and the default; see docs/decisions/05-spz.md.
SPZ_VERSIONS, TREE_SPZ_VERSIONS, DEFAULT_SPZ_VERSION = (2, 3, 4), (2, 3), 3

#: Largest number of fractional bits of an SPZ position.
MAX_FRACTIONAL_BITS = 24

#: Deflate levels, and the default; measured in docs/decisions/05-spz.md.
MIN_COMPRESSION, MAX_COMPRESSION, DEFAULT_COMPRESSION = 1, 9, 5

#: Most entries of a palette of spherical harmonics: labels have 16 bits in RAD and in SOG.
MAX_SH_CODES = 65_536
SH_CODES = whole(2, MAX_SH_CODES)

#: Profiles of GLB: attributes as KHR_gaussian_splatting defines them, and SPZ as CesiumJS reads it.
KHRONOS, CESIUM = PROFILES = ("khronos", "cesium")


def _bits(text: str) -> int | None:
    if text != "auto" and not text.isdecimal():
        raise ValueError(f"{text!r} is neither auto nor a whole number")
    return None if text == "auto" else int(text)


#: Encodings of each property of RAD that Spark reads; the first is the one that Spark writes.
RAD_ENCODINGS = {
    "center": ("f32_lebytes", "f32", "f16_lebytes", "f16"),
    "alpha": ("f16", "r8", "f32"),
    "rgb": ("r8_delta", "r8", "f16", "f32"),
    "scales": ("ln_0r8", "ln_f16", "f32"),
    "orientation": ("oct88r8", "f16", "f32"),
    "sh": ("s8", "s8_delta", "r8", "r8_delta", "f16", "f32"),
}

#: The writer chooses an encoding that suits the scene.
AUTO = "auto"

#: Values of the options of RAD encodings.
RAD_CHOICES = {name: (AUTO, *encodings) for name, encodings in RAD_ENCODINGS.items()}


@dataclass(frozen=True)
class RadOptions(CheckedSettings):
    """Options of RAD files; for encodings see `rad.property_codings`.

    Attributes:
        chunked: write each chunk to a file of its own.
        ranges: ranges of the codes; None for ranges that suit the scene.
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
    """Options of splat files; PLY and .splat ignore all of them.

    Attributes:
        sh_bits: upper bits kept of each SH byte of SPZ, 4 to 8; None for as many as colours need (`statistics.enough`).
            Merged splats keep 4, and 5 of degree 1, as other writers do with all splats.
        covering: opacities compensate for the rounding of scales, see `quantize.compensated`; False when a tree is
            converted to another format, so that opacities stay the same.
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


#: Default options: the writer makes every choice.
DEFAULTS = WriteOptions()


#: Layouts of `convert --layout`, see `layouts.pack_layout`; docs/formats/memory.md has the arrays of each.
ENCODINGS = ("packed", "ext", "lodtree", "texture")

#: Layouts of splats in Spark, for which `spark_nodes.nodes` measures nodes: ExtSplats, PackedSplats of a file that is
#: loaded whole, and those of a RAD file that is streamed.
LOADED = ("ext", "packed", "packed-pages")

#: Encodings whose rounding `losses.after` simulates: PackedSplats with Spark's ranges, ExtSplats, and SPZ and RAD as
#: build-lod writes them.
ROUND_TRIPS = ("packed", "ext", "spz", "rad")

#: Precisions of the nodes of a traversal: that of the file, half floats, and those of Spark's layouts.
PRECISIONS = ("float32", "float16", *LOADED)

#: Suffix of files of arrays.
NPZ = ".npz"

#: Suffixes of files of arrays without a header: the words of all arrays, one array after the other.
RAW_SUFFIXES = (".bin", ".raw")


def ending_of(name: str) -> str:
    """Return the end of a file name as in `WRITABLE`, in lower case: "meta.json", or the suffix, known or not."""
    name = name.lower()
    return name if any(name == form.unbundled for form in FORMATS) else PurePath(name).suffix


def head_of(file: BinaryIO) -> bytes:
    """Read the first bytes of a file, from which its format is recognized, and return to its beginning."""
    head = file.read(HEAD)
    if len(head) == HEAD and _keys(head) and sniff(head, "") is None:
        head += file.read(JSON_HEAD - HEAD)
    file.seek(0)
    return head


#: `keys_of_object`, cached since several functions need the keys of the same head.
_keys = functools.lru_cache(1)(keys_of_object)


def sniff(head: bytes, suffix: str) -> Format | None:
    """Recognize the format of a file by its first bytes, see `head_of`, or else by its suffix; None if it is unknown.

    The suffix decides only for formats that may begin with any bytes, unless the file is recognized as something else.
    The suffix `NPZ` distinguishes arrays from a scene: both are zips.
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


#: Description, and regular expression, of the placeholder of a file in a clone that was made without Git LFS.
POINTER = "a Git LFS pointer; run git lfs pull to get the file"
POINTED = rb"version https://git-lfs\.github\.com/spec/v1\s"

#: Bytes at the beginning of a file that suffice to recognize a pointer.
SHORT = 64

#: Most keys of an unknown JSON object that a message names, and most characters of them.
FEW, QUOTED = 5, 100

_CAMERAS = "a file of cameras; give it as --camera-path"

#: Kinds of files without splats, or with splats that are not read, in the order in which they are tried: a description
#: and advice, to follow "not a splat file, but"; a regular expression that matches the first bytes, None for any JSON
#: object with the keys; and the keys at the top level.
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
    """Describe a file of no known format by its first bytes; None if they identify nothing."""
    keys = _keys(head)
    for text, beginning, required in LOOKALIKES:
        if beginning is not None and re.match(beginning, head):
            return text
        if required and set(required) <= set(keys):
            return text
    if not keys:
        return None
    named = printable(", ".join(keys[:FEW]), QUOTED) + (", ..." if len(keys) > FEW else "")
    return f"a JSON object of no format that holds splats ({named})"


def is_pointer(head: bytes) -> bool:
    """Return whether a file with these first bytes is a pointer of Git LFS."""
    return re.match(POINTED, head) is not None


# Names of files, which are those of Spark and of PlayCanvas's tools.

#: Suffixes of a RAD file, and of a chunk in a file of its own.
RAD_SUFFIX, RAD_CHUNK_SUFFIX = ".rad", ".radc"

#: The file of an unpacked SOG that names its images, and the images of each texture, in the order of that file.
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
#: Babylon.js read. Older versions wrote it unpacked to the same folder.
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
    """Return the file name of a chunk of a RAD file with this stem."""
    return f"{stem}-{number}{RAD_CHUNK_SUFFIX}"


def rad_chunk_number(name: str, stem: str) -> int | None:
    """Return the number of a chunk by its file name; None for other names."""
    match = re.fullmatch(r"(0|[1-9][0-9]{0,8})" + re.escape(RAD_CHUNK_SUFFIX), name.removeprefix(f"{stem}-"))
    return int(match[1]) if match and name.startswith(f"{stem}-") else None


def sog_image_number(name: str) -> int | None:
    """Return the number of an image of a SOG, counted over all textures, by its file name; None for other names."""
    return _ALL_IMAGES.index(name) if name in _ALL_IMAGES else None


def is_chunk_folder(name: str) -> bool:
    """Return whether a name is that of a folder of a Streamed SOG."""
    return name == ENVIRONMENT or _CHUNK_FOLDER.fullmatch(name) is not None


def is_in_manifest(name: str) -> bool:
    """Return whether the manifest of a Streamed SOG may name a file: the meta.json of a chunk, or the environment."""
    folder, _, file = name.partition("/")
    return name == ENVIRONMENT_FILE or (is_chunk_folder(folder) and file == META)


def is_of_streamed_sog(name: str) -> bool:
    """Return whether a file may belong to a Streamed SOG: one that the manifest may name, or an image of a chunk."""
    folder, _, file = name.partition("/")
    return is_in_manifest(name) or (is_chunk_folder(folder) and sog_image_number(file) is not None)


def is_of_tileset(name: str) -> bool:
    """Return whether a file may belong to 3D Tiles: a tile or a nested tileset in their folder."""
    return _TILE.fullmatch(name) is not None
