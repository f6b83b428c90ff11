"""SECURITY.md: its figures are those of the code."""

from __future__ import annotations

from sparklod_cli.cameras import camera
from sparklod_cli.codecs import compression
from sparklod_cli.inspection import tree
from sparklod_cli.io import local_files as io
from sparklod_cli.system import untrusted
from tests.conftest import ROOT


def test_the_figures_of_security_are_those_of_the_code() -> None:
    text = " ".join((ROOT / "SECURITY.md").read_text().split())
    for said in (
        f"promises more than {compression.TRUSTED_SIZE >> 20} MiB",
        f"at most {compression.MAX_RATIO} times the size of the file",
        f"read up to {io.MAX_TEXT >> 20} MiB and {untrusted.MAX_DEPTH} levels deep",
        f"shorten texts to {untrusted.MOST} characters",
    ):
        assert said in text
    assert (tree.MAX_DEPTHS, camera.MAX_FRAMES) == (1000, 1 << 20)
    assert "a thousand levels" in text
    assert "(a million at most)" in text
