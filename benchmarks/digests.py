"""Record digests of what sparklod computes, or compare with a record: `python benchmarks/digests.py --help`.

A change that is to leave results as they are is held to that: record before it, compare after it, on the same machine,
since the last digit of a float may depend on the processor and on the versions of numpy and numba.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FIXTURES = ROOT / "fixtures"

#: Scenes of the repository: every SH degree and input format, and what is degenerate.
OWN_SCENES = (
    "demo.ply",
    "sh0.ply",
    "sh1.ply",
    "sh2.ply",
    "sh3.ply",
    "coincident.ply",
    "flat.ply",
    "huge.ply",
    "needle.ply",
    "one.ply",
    "golden/hand-v1.spz",
    "golden/hand-v4.spz",
    "golden/sh0.splat",
    "golden/sh2-level1.ksplat",
    "golden/sh2-v1.sog",
    "golden/sh3-compressed.ply",
    "golden/sh3-v2.sog",
)

#: Scenes that are not part of the repository, in the folder that --scenes names.
REAL_SCENES = ("biker.ply", "meadow.sog", "playbot-125k.ply")

#: Command lines by name, which run on each scene in this order; {scene} is its file. Later lines read the output of
#: earlier ones. The digests cover all files that a line writes, and its standard output.
LINES = {
    "quick": "build-lod {scene} -o quick.spz",
    "quick, base 1.1": "build-lod {scene} --base 1.1 -o base11.spz --spz-version 2",
    "quick, base 2": "build-lod {scene} --base 2 -o base20.rad",
    "quality": "build-lod {scene} --method quality -o quality.spz",
    "quality, growth 2": "build-lod {scene} --method quality --growth 2 -o growth.rad",
    "transformed": "build-lod {scene} --up -y --rotate 10,20,30 --scale 2 --translate 1,2,3 -o turned.spz",
    "selected": "build-lod {scene} --max-sh 1 --min-opacity 0.1 -o selected.spz",
    "out of core": "build-lod {scene} --memory 1G -o memory.rad",
    "chunks": "build-lod quality.spz --format rad-chunked -o chunked.rad",
    "exact rad": "build-lod quality.spz -o exact.rad --rad-center f32 --rad-alpha f32 --rad-rgb f32 --rad-scales f32 "
    "--rad-orientation f32 --rad-sh f32",
    "palette": "build-lod quality.spz -o palette.rad --cluster-sh 16",
    "streamed sog": "build-lod {scene} -o web/lod-meta.json",
    "streamed sog, quick": "build-lod {scene} --method quick --levels 50%,10% -o quick-web/lod-meta.json",
    **{name: f"convert quality.spz {name}.npz --layout {name}" for name in ("packed", "ext", "lodtree", "texture")},
    "refined": "build-lod quality.spz --refine 8 -o refined.spz",
    **{f"unlod {suffix}": f"convert quality.spz unlod.{suffix} --leaves" for suffix in ("ply", "sog", "splat", "spz")},
    "cuts": "traverse quality.spz --orbit 3 --budget 20% --no-timing -o cuts.csv --indices-out cuts",
    "cuts, as Spark": "traverse growth.rad --dolly --every 15 --budget 5% --precision packed --no-timing -o spark.csv",
    "streaming": "traverse growth.rad --orbit 4 --budget 30% --bandwidth 20Mbit --no-timing -o stream.csv",
    "levels": "traverse web/lod-meta.json --orbit 3 --budget 20% --no-timing -o levels.csv",
    "picture": "render {scene} --size 320x180 -o scene.npy",
    "picture of a cut": "render quality.spz --budget 10% --size 320x180 -o cut.npy",
    "picture, continuous": "render quality.spz --budget 10% --continuous --size 320x180 -o continuous.npy",
    "picture of levels": "render web/lod-meta.json --budget 20% --size 320x180 -o levels.npy",
    "comparison": "render quality.spz --orbit 2 --compare --budget 5%,50% --size 160x90 --json",
    **{
        f"report of {name}": f"inspect {name} --json --stats --check --chunks"
        for name in ("quick.spz", "growth.rad", "palette.rad", "web/lod-meta.json")
    },
}

#: Keys of JSON reports that differ from run to run.
VOLATILE = {"seconds", "file", "input", "output", "files"}

#: Seconds after which a command counts as failed.
PATIENCE = 600


def digest(content: bytes) -> str:
    """Return the first half of the SHA-256 of some bytes, in hexadecimal."""
    return hashlib.sha256(content).hexdigest()[:32]


def digests_of_report(text: str) -> Iterator[tuple[str, str]]:
    """Yield the name and digest of each key of a JSON object, except for those in `VOLATILE`."""
    for key, value in json.loads(text).items():
        if key not in VOLATILE:
            yield key, digest(json.dumps(value, sort_keys=True).encode())


def record_scene(scene: Path) -> dict[str, str]:
    """Run all `LINES` on a scene.

    Args:
        scene: file of splats.

    Returns:
        digests by the names of the scene, the line, and the file or key of the report. A line that fails, as some do
        on degenerate scenes, is recorded by its exit status.
    """
    digests: dict[str, str] = {}
    package = {**os.environ, "PYTHONPATH": str(ROOT)}
    with tempfile.TemporaryDirectory() as name:
        folder, before = Path(name), set[Path]()
        for line, command in LINES.items():
            arguments = [sys.executable, "-m", "sparklod_cli", *(word.format(scene=scene) for word in command.split())]
            process = subprocess.run(
                arguments, cwd=folder, env=package, capture_output=True, timeout=PATIENCE, check=False
            )
            place = f"{scene.name}: {line}"
            if process.returncode:
                digests[place] = f"exit status {process.returncode}"
            if process.stdout:
                digests |= {f"{place}: {key}": value for key, value in digests_of_report(process.stdout.decode())}
            after = {path for path in folder.rglob("*") if path.is_file()}
            for path in sorted(after - before):
                digests[f"{place}: {path.relative_to(folder).as_posix()}"] = digest(path.read_bytes())
            before = after
    return digests


def record(scenes: list[Path], processes: int) -> dict[str, str]:
    """Run all `LINES` on some scenes, several at a time; see `record_scene`."""
    digests: dict[str, str] = {}
    with ThreadPoolExecutor(processes) as pool:
        for scene, part in zip(scenes, pool.map(record_scene, scenes), strict=True):
            print(f"{scene.name}: {len(part)} digests", file=sys.stderr, flush=True)
            digests |= part
    return digests


def differences(before: dict[str, str], after: dict[str, str]) -> list[str]:
    """Return a line for each digest that changed, was lost or is new."""
    lines = [f"changed: {name}" for name in before if name in after and before[name] != after[name]]
    lines += [f"lost: {name}" for name in before if name not in after]
    return lines + [f"new: {name}" for name in after if name not in before]


def main() -> int:
    """Parse the arguments, and record or compare; return the exit status: 1 where something differs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0].split(":")[0])
    parser.add_argument("action", choices=("record", "compare"))
    parser.add_argument("file", type=Path, help="JSON file of the digests")
    parser.add_argument("--scenes", type=Path, help=f"folder of the real scenes {', '.join(REAL_SCENES)}")
    parser.add_argument("--processes", type=int, default=os.cpu_count(), help="scenes to work on at a time")
    arguments = parser.parse_args()
    scenes = [FIXTURES / name for name in OWN_SCENES]
    if arguments.scenes:
        scenes = [arguments.scenes.resolve() / name for name in REAL_SCENES] + scenes
    digests = record(scenes, arguments.processes)
    if arguments.action == "record":
        arguments.file.write_text(json.dumps(digests, indent=1) + "\n", encoding="utf-8")
        print(f"{len(digests)} digests written to {arguments.file}")
        return 0
    lines = differences(json.loads(arguments.file.read_text(encoding="utf-8")), digests)
    print("\n".join([*lines, f"{len(digests)} digests, {len(lines)} differ"]))
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
