"""The table of layouts in memory that a tree can be dumped in: adding one is a module and a row.

Imports nothing heavy: `--help` names them.
"""

from __future__ import annotations

from ...support import defaults

#: By the name that `--encoding` knows: the module in this package, which has `dump(scene, *, threads)`, the arrays of
#: words of a scene by their names; docs/formats.md has their layout.
ENCODINGS = {"packed": "packed_splats", "ext": "ext_splats", "lodtree": "lod_tree", "texture": "data_texture"}

#: Layouts after which `loaded_nodes` measures nodes, as Spark does when it has loaded a file: ExtSplats, PackedSplats
#: of a file that it loads whole, and those of a RAD file that it streams.
LOADED = ("ext", "packed", "packed-pages")

#: Precisions of the nodes that cuts are found with: the file's, its half floats, and what Spark has in each layout.
PRECISIONS = (*defaults.PRECISIONS, *LOADED)

#: Suffix of dumps with a header.
NPZ = ".npz"

#: Suffixes of dumps without one: nothing but the words of all arrays, one after the other.
RAW_SUFFIXES = (".bin", ".raw")
