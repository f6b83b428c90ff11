"""Writes the files of an output."""

from __future__ import annotations

from sparklod_cli.system.output import Files, Output


def write_files(out: Output, files: Files) -> int:
    with out:
        return sum(out.write(*file) for file in files)
