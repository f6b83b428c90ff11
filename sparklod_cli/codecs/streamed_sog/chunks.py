"""The chunks of a folder of Streamed SOG: SOG scenes."""

from __future__ import annotations

from ..content import OpenCompanion
from ..file_names import MANIFEST
from ..scene_files import SceneFiles
from ..sog import codec as sog


def chunk_files(open_companion: OpenCompanion | None) -> SceneFiles:
    """Return the SOG scenes beside a manifest, which names the meta.json of each."""
    return SceneFiles(
        open_companion, MANIFEST, "streamed-sog.chunk-files", lambda name, source: sog.open_content(source)
    )
