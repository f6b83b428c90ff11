"""Every row of the table of formats keeps the contract of codecs, and can be asked for without loading any."""

from __future__ import annotations

import inspect
import subprocess
import sys

import numpy as np
import pytest

from sparklod_cli.codecs.formats import FORMATS, WRITABLE, Format, ending_of
from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.system.errors import FormatError
from tests.scenes import random_splats


def parameters(function: object) -> dict[str, bool]:
    """The parameters of a function, and whether each must be named."""
    found = inspect.signature(function).parameters.values()  # type: ignore[arg-type]
    return {each.name: each.kind == each.KEYWORD_ONLY for each in found}


@pytest.mark.parametrize("form", FORMATS, ids=lambda form: form.name)
def test_a_codec_has_the_signatures_of_all(form: Format) -> None:
    codec = form.codec()
    assert parameters(codec.open_content) == {"source": False}
    is_written = any(each.endings for each in FORMATS if each.module == form.module)  # one may be read in two forms
    assert hasattr(codec, "encode") == hasattr(codec, "settled") == is_written
    if is_written:
        written = {"scene": False, "options": False, "threads": True, "progress": True}
        assert parameters(codec.encode) == written
        assert parameters(codec.settled) == {"scene": False, "options": False}
    assert hasattr(codec, "encode_files") == (form.unbundled is not None or form.parts is not None)
    assert hasattr(codec, "decode_parts") == (form.parts is not None)
    if form.parts is not None:
        named = {"threads": True, "progress": True, "open_companion": True}
        assert parameters(codec.decode_parts) == {"file": False} | named
    assert hasattr(codec, "encoder") == hasattr(codec, "needed") == form.trees
    if form.trees:
        assert parameters(codec.needed) == {"options": False}
        named = {"counting": True, "threads": True, "progress": True}
        assert parameters(codec.encoder) == {"scene": False, "options": False} | named
        assert parameters(codec.stored) == {"source": False, "options": False}


def test_one_format_is_written_by_each_suffix() -> None:
    assert sum(len(form.endings) for form in FORMATS) == len(WRITABLE)
    assert set(WRITABLE) == {".ply", ".spz", ".splat", ".rad", ".sog", "meta.json", ".glb"}


@pytest.mark.parametrize(
    ("name", "ending"),
    [
        ("a.SOG", ".sog"),
        ("x", ""),
        (".ply", ""),
        ("meta.json", "meta.json"),
        ("Meta.JSON", "meta.json"),
        ("a-meta.json", ".json"),
        ("meta.json.ply", ".ply"),
    ],
)
def test_the_name_of_a_file_tells_how_it_is_written(name: str, ending: str) -> None:
    assert ending_of(name) == ending


@pytest.mark.parametrize("suffix", sorted(suffix for suffix, form in WRITABLE.items() if not form.trees))
def test_what_holds_no_tree_says_so_before_a_byte_is_written(suffix: str) -> None:
    tree = Scene(random_splats(2), LodTree(np.array([1, 0], np.uint16), np.array([1, 0], np.uint32)))
    codec = WRITABLE[suffix].codec()
    with pytest.raises(FormatError, match="holds no Level-of-Detail tree"):
        codec.settled(tree, WriteOptions())
    with pytest.raises(FormatError, match="holds no Level-of-Detail tree"):
        next(codec.encode(tree))


def test_tables_load_nothing_heavy() -> None:
    """`--help` names what stands in them."""
    program = (
        "import sys; from sparklod_cli.codecs import formats;"
        "from sparklod_cli.tables import columns; from sparklod_cli.cameras.formats import table;"
        "assert not {'numpy', 'numba'} & set(sys.modules), 'heavy'"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
