"""Bakes from, to and by way of an S3: the server of moto, which runs in this process."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

from sparklod_cli.bake.flow import bake
from sparklod_cli.bake.out_of_core.cluster import cluster
from sparklod_cli.bake.settings import BakeSettings, Resources
from sparklod_cli.cli import run
from sparklod_cli.system.addresses import Address, Place
from tests.conftest import FIXTURES

pytest.importorskip("s3fs", reason="s3:// needs the extra cloud")
server = pytest.importorskip("moto.server", reason="moto[server] is not installed")

DEMO = FIXTURES / "demo.ply"
pytestmark = pytest.mark.slow


def contents(folder: Place, names: list[str]) -> dict[str, bytes]:
    """Return the bytes of files of a folder by their names."""
    found = {}
    for name in names:
        with (folder / name).open("rb") as file:
            found[name] = file.read()
    return found


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """An empty bucket of a server on this machine."""
    import fsspec

    running = server.ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    variables = {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "nobody",
        "AWS_SECRET_ACCESS_KEY": "nothing",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    name = f"scans-{uuid.uuid4().hex}"  # the server's buckets are those of the process
    fsspec.filesystem("s3").mkdir(name)
    try:
        yield f"s3://{name}"
    finally:
        running.stop()
        fsspec.filesystem("s3").clear_instance_cache()


@pytest.mark.parametrize(
    "options", [[], ["--format", "rad"], ["--format", "rad-chunked"]], ids=["spz", "rad", "chunks"]
)
def test_the_command_bakes_from_bucket_to_bucket(bucket: str, options: list[str], tmp_path: Path) -> None:
    Address(f"{bucket}/demo.ply").write([DEMO.read_bytes()])
    assert run(["build-lod", f"{bucket}/demo.ply", "--output-dir", f"{bucket}/web", "--quiet", *options]) == 0
    assert run(["build-lod", str(DEMO), "--output-dir", str(tmp_path), "--quiet", *options]) == 0
    folder = Address(f"{bucket}/web")
    assert contents(folder, folder.files()) == contents(tmp_path, [path.name for path in tmp_path.iterdir()])


def test_workers_share_a_scratch_folder_in_a_bucket(bucket: str, tmp_path: Path) -> None:
    Address(f"{bucket}/demo.ply").write([DEMO.read_bytes()])
    resources = Resources(block_splats=14_000, scratch_dir=Address(f"{bucket}/scratch"))
    target = Address(f"{bucket}/demo-lod.spz")
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    with cluster(workers=2, threads=2) as engine:
        baked = bake(
            Address(f"{bucket}/demo.ply"), target, BakeSettings(), resources=resources, engine=engine, threads=2
        )
    assert baked.blocks is not None and baked.blocks > 1
    bake(DEMO, tmp_path / "demo-lod.spz", BakeSettings())
    assert contents(Address(bucket), ["demo-lod.spz"]) == contents(tmp_path, ["demo-lod.spz"])
    assert sorted(Address(bucket).files()) == ["demo-lod.spz", "demo.ply"]
