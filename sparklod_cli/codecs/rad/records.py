"""What the headers of RAD files and of their chunks say."""

from __future__ import annotations

import functools
from dataclasses import dataclass

from ..noted import Noted, read_comment
from ..splat_encoding import SplatEncoding

#: The compression of properties: a raw deflate stream, whatever its name says.
GZ = "gz"


@dataclass(frozen=True)
class RadChunkEntry:
    """Where a chunk is.

    Attributes:
        offset: from the first byte after the header, or of the chunk's own file.
        bytes: its size, header included.
        filename: of its own file, beside the header's; None where it is in the same file.
    """

    offset: int
    bytes: int
    filename: str | None = None


@dataclass(frozen=True)
class RadHeader:
    """The header of a file.

    Attributes:
        count: splats, which are the nodes where there is a tree.
        max_sh: SH degree.
        lod_tree: whether the splats are the nodes of a Level-of-Detail tree.
        chunk_size: splats of each chunk but the last.
        all_chunk_bytes: sum of the chunks' sizes.
        chunks: where they are, in order.
        encoding: ranges of the codes; None where the header has none.
        sh_code_count: entries of the SH palette; None without one.
        comment: free text; None without one.
        bytes: of the header with its padding: where the first chunk begins.
        padded_with_zeros: whether the padding is zeros.
    """

    count: int
    max_sh: int
    lod_tree: bool
    chunk_size: int
    all_chunk_bytes: int
    chunks: tuple[RadChunkEntry, ...]
    encoding: SplatEncoding | None = None
    sh_code_count: int | None = None
    comment: str | None = None
    bytes: int = 0
    padded_with_zeros: bool = True

    @property
    def filenames(self) -> tuple[str, ...]:
        """Names of the files that chunks have of their own, each once."""
        return tuple(dict.fromkeys(entry.filename for entry in self.chunks if entry.filename is not None))

    @property
    def chunked(self) -> bool:
        """Whether the chunks are files of their own."""
        return bool(self.filenames)

    @functools.cached_property
    def noted(self) -> Noted:
        """Note of sparklod in the comment."""
        return read_comment(self.comment)


@dataclass(frozen=True)
class Property:
    """A column of a chunk.

    Attributes:
        offset: from the beginning of the payload.
        bytes: as stored.
        name: one of `layout.PROPERTIES`, as far as it is known.
        encoding: one of `layout.SIZES`, as far as it is known.
        compression: "gz" for a raw deflate stream, None for none.
        min, max: ends of the range of the codes; None where there is none.
    """

    offset: int
    bytes: int
    name: str
    encoding: str
    compression: str | None = GZ
    min: float | None = None
    max: float | None = None


@dataclass(frozen=True)
class RadChunkHeader:
    """The header of a chunk.

    Attributes:
        base: index of its first splat in the file.
        count: its splats.
        payload_bytes: of its properties with their padding, as the JSON has it.
        max_sh, lod_tree: as in `RadHeader`.
        properties: in the order of the file.
        encoding: ranges of the codes; None where the header has none.
        stored_payload_bytes: the same number again, as it stands before the payload.
        bytes: of the header with its padding and the size of the payload: where the payload begins.
        padded_with_zeros: whether the padding is zeros.
    """

    base: int
    count: int
    payload_bytes: int
    max_sh: int
    lod_tree: bool
    properties: tuple[Property, ...]
    encoding: SplatEncoding | None = None
    stored_payload_bytes: int = 0
    bytes: int = 0
    padded_with_zeros: bool = True
