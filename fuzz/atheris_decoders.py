"""Fuzzes the decoders with atheris, which is guided by the branches that an input takes.

    python -m fuzz.atheris_decoders -max_total_time=600 corpus

Run `pip install atheris` first; it exists for Linux only. The first byte of an input chooses the format, so that
sniffing does not stand in the way. `--seeds DIR` writes the seeds of the other fuzzers in this form and exits. Compiled
kernels are not instrumented.
"""

from __future__ import annotations

import contextlib
import io
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

from sparklod_cli.codecs.formats import FORMATS, HEAD, sniff
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.system.errors import FormatError, SparklodError

from .containers import seeds, split_file, valid_seeds


def decode(data: bytes) -> None:
    """Runs the decoder that the first byte names; lets through every exception but sparklod's own."""
    if not data:
        return
    form = FORMATS[data[0] % len(FORMATS)]
    body = data[1:]
    files: Mapping[str, bytes] = {}
    if form.companions:
        with contextlib.suppress(Exception):
            files = split_file(body)[0]

    def open_companion(name: str) -> BinaryIO:
        if name not in files:
            raise FormatError("there is no such file")
        return io.BytesIO(files[name])

    with contextlib.suppress(SparklodError):
        scene = decode_file(
            form.codec(), io.BytesIO(body), open_companion=open_companion if form.companions else None, threads=1
        )
        if scene.tree is not None:
            scene.tree.validate()


def write_seeds(folder: Path) -> None:
    """Writes the seeds of the other fuzzers, each behind the byte that chooses its format."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in valid_seeds():
        form = sniff(seeds()[name][:HEAD], Path(name).suffix)
        if form is not None:
            (folder / name.replace("/", "-")).write_bytes(bytes([FORMATS.index(form)]) + seeds()[name])


def main() -> None:
    """Runs libFuzzer, which reads its own options from the command line."""
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
    """Instruments the functions that a loaded module defines, but not those it imports, such as numba's."""
    for name, value in vars(module).copy().items():
        if callable(value) and hasattr(value, "__code__") and value.__module__ == module.__name__:  # type: ignore[attr-defined]
            with contextlib.suppress(Exception):
                setattr(module, name, atheris.instrument_func(value))  # type: ignore[attr-defined]


if __name__ == "__main__":
    main()
