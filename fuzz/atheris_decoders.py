"""The decoders under atheris, which follows the branches that an input takes.

    python -m fuzz.atheris_decoders -max_total_time=600 corpus

`pip install atheris` first, which is there for Linux. The first byte of an input chooses the format, so that sniffing
is no obstacle; `--seeds DIR` writes the seeds of the other fuzzers in this form and ends. Kernels are compiled, and not
followed.
"""

from __future__ import annotations

import contextlib
import io
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

from sparklod_cli.codecs.formats import FORMATS, HEAD, sniff
from sparklod_cli.support.errors import FormatError, SparklodError

from .containers import good, opened, seeds


def decode(data: bytes) -> None:
    """Runs the decoder that the first byte names; anything but a scene or an error of ours is raised."""
    if not data:
        return
    form = FORMATS[data[0] % len(FORMATS)]
    body = data[1:]
    files: Mapping[str, bytes] = {}
    if form.companions:
        with contextlib.suppress(Exception):
            files = opened(body)[0]

    def beside(name: str) -> BinaryIO:
        if name not in files:
            raise FormatError("there is no such file")
        return io.BytesIO(files[name])

    more = {"beside": beside} if form.companions else {}
    with contextlib.suppress(SparklodError):
        scene = form.codec().decode(io.BytesIO(body), threads=1, **more)
        if scene.tree is not None:
            scene.tree.validate()


def write_seeds(folder: Path) -> None:
    """The seeds of the other fuzzers, with the byte before them that chooses their format."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in good():
        form = sniff(seeds()[name][:HEAD], Path(name).suffix)
        if form is not None:
            (folder / name.replace("/", "-")).write_bytes(bytes([FORMATS.index(form)]) + seeds()[name])


def main() -> None:
    """Hands over to libFuzzer, whose options those of the command line are."""
    if "--seeds" in sys.argv:
        write_seeds(Path(sys.argv[sys.argv.index("--seeds") + 1]))
        return
    try:
        import atheris
    except ImportError:
        sys.exit("atheris is not installed: pip install atheris")
    for form in FORMATS:
        form.codec()
    for name, module in list(sys.modules.items()):
        if name.startswith("sparklod_cli.codecs") and "kernels" not in name:
            _instrument(atheris, module)
    atheris.Setup(sys.argv, decode)
    atheris.Fuzz()


def _instrument(atheris: object, module: object) -> None:
    """Lets atheris follow the functions of a module that is loaded already; not those of others, as of numba."""
    for name, value in vars(module).copy().items():
        if callable(value) and hasattr(value, "__code__") and value.__module__ == module.__name__:  # type: ignore[attr-defined]
            with contextlib.suppress(Exception):
                setattr(module, name, atheris.instrument_func(value))  # type: ignore[attr-defined]


if __name__ == "__main__":
    main()
