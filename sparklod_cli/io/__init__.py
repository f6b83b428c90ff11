"""The only package that opens paths: tells formats, reads scenes, and writes files whole or not at all.

What reads one format is not loaded to read another: names are found in their modules when they are first asked for.
"""

from typing import TYPE_CHECKING

from ..support.lazy import loader_of

if TYPE_CHECKING:
    from .beside import companions
    from .chunks import read_rad_chunk, read_rad_header
    from .details import detail_files, detail_sink
    from .identity import Identity, content_of, files_of, identity_of, stamp_of
    from .level_files import LevelFiles, has_levels, read_level_files
    from .names import is_file_name
    from .rad_file import RadFile
    from .reading import (
        examine_scene,
        opened,
        read_arrays,
        read_coded,
        read_levels,
        read_scene,
        read_stored,
        size_of_input,
    )
    from .scenes import SceneSink, scene_sink
    from .streams import PlacedFile, open_stream, open_streams
    from .texts import MAX_TEXT, read_rgba, read_text, read_together
    from .together import SinkTogether, chunk_files, sink_together, write_together
    from .writing import Sink, check_writable, sink, write_stdout, write_whole

#: By module, the names that it has, as above.
_NAMES = {
    "io.beside": ("companions",),
    "io.chunks": ("read_rad_chunk", "read_rad_header"),
    "io.details": ("detail_files", "detail_sink"),
    "io.identity": ("Identity", "content_of", "files_of", "identity_of", "stamp_of"),
    "io.level_files": ("LevelFiles", "has_levels", "read_level_files"),
    "io.names": ("is_file_name",),
    "io.rad_file": ("RadFile",),
    "io.reading": (
        *("examine_scene", "opened", "read_arrays", "read_coded", "read_levels", "read_scene", "read_stored"),
        "size_of_input",
    ),
    "io.scenes": ("SceneSink", "scene_sink"),
    "io.streams": ("PlacedFile", "open_stream", "open_streams"),
    "io.texts": ("MAX_TEXT", "read_rgba", "read_text", "read_together"),
    "io.together": ("SinkTogether", "chunk_files", "sink_together", "write_together"),
    "io.writing": ("Sink", "check_writable", "sink", "write_stdout", "write_whole"),
}

__getattr__ = loader_of(__name__, _NAMES)

__all__ = [
    "MAX_TEXT",
    "Identity",
    "LevelFiles",
    "PlacedFile",
    "RadFile",
    "SceneSink",
    "Sink",
    "SinkTogether",
    "check_writable",
    "chunk_files",
    "companions",
    "content_of",
    "detail_files",
    "detail_sink",
    "examine_scene",
    "files_of",
    "has_levels",
    "identity_of",
    "is_file_name",
    "open_stream",
    "open_streams",
    "opened",
    "read_arrays",
    "read_coded",
    "read_level_files",
    "read_levels",
    "read_rad_chunk",
    "read_rad_header",
    "read_rgba",
    "read_scene",
    "read_stored",
    "read_text",
    "read_together",
    "scene_sink",
    "sink",
    "sink_together",
    "size_of_input",
    "stamp_of",
    "write_stdout",
    "write_together",
    "write_whole",
]
