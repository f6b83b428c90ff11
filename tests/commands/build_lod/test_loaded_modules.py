"""A job loads what it needs, and no more."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def test_a_bake_of_a_ply_loads_no_other_reader(tmp_path: Path) -> None:
    """Nor what only bakes out of core, of other outputs, or of several files need."""
    scene = Path(__file__).parents[3] / "fixtures" / "sh3.ply"
    code = f"""
import sys
from sparklod_cli import cli
assert cli.run(["build-lod", {str(scene)!r}, "-o", {str(tmp_path / "tree.spz")!r}, "-q"]) == 0
print(*sorted(sys.modules))
"""
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "sparklod_cli.codecs.ply" in loaded
    others = ("cameras.pose", "codecs.sog.sog_container", "codecs.streamed_sog.manifest", "codecs.rad.codec")
    others += (
        "codecs.gpu.dump",
        "bake.out_of_core.cluster",
        "bake.out_of_core.in_blocks",
        "bake.skipping",
        "scenes.instances_file",
    )
    assert {f"sparklod_cli.{name}" for name in others}.intersection(loaded) == set()
    assert "PIL" not in loaded
