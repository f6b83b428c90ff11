"""The only package that opens paths: tells formats, reads scenes, and writes files whole or not at all.

What most jobs need is imported here; `rad_file` and `details` are imported by those who need them.
"""

from .local_files import companions, is_file_name
from .reading import (
    MAX_TEXT,
    opened,
    read_arrays,
    read_parts,
    read_rgba,
    read_stored,
    read_text,
    read_together,
    size_of_input,
)
from .streams import PlacedFile, open_reader, open_readers, read_scene
from .writing import parts_output, scene_output, siblings_of, write_scene
