"""Opens inputs, recognises their formats and reads them; decides which files a scene becomes.

What most jobs need is imported here; `rad_file` is imported where it is needed.
"""

from .local_files import (
    MAX_TEXT,
    companions,
    is_file_name,
    read_rgba,
    read_text,
    read_together,
    size_of_input,
)
from .reading import (
    Merged,
    open_reader,
    opened,
    read_arrays,
    read_parts,
    read_scene,
    read_stored,
)
from .writing import parts_output, scene_output, siblings_of, write_scene
