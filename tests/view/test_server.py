"""`sparklod view`: its server, which sends files by their names and nothing else to nobody else; and the command."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import pytest
from hypothesis import given
from hypothesis import strategies as st

import sparklod_cli as sparklod
from sparklod_cli.api import sites
from sparklod_cli.cli import run
from sparklod_cli.system.errors import SparklodError
from sparklod_cli.view.server import Server, span_of
from sparklod_cli.view.site import MAX_BYTES, Site
from tests.conftest import FIXTURES, Capture
from tests.signals import heed_signals
from tests.view.conftest import CHUNKED, TREE, ask, prepared, serving

SIZE = 10_000


@pytest.mark.parametrize(
    ("text", "span"),
    [
        ("bytes=0-499", range(500)),
        ("bytes=500-999", range(500, 1000)),
        ("bytes=-500", range(9500, SIZE)),
        ("bytes=9500-", range(9500, SIZE)),
        ("bytes=0-0", range(1)),
        ("bytes=-1", range(9999, SIZE)),
        ("bytes=9999-123456", range(9999, SIZE)),
        ("bytes=-123456", range(SIZE)),
        ("BYTES = 5 - 7 ", range(5, 8)),
        ("bytes=000-0001", range(2)),
        ("bytes=10000-", range(0)),
        ("bytes=10000-10001", range(0)),
        ("bytes=-0", range(0)),
        (f"bytes={'9' * 5000}-", range(0)),
        *((text, None) for text in (None, "", "bytes", "bytes=", "bytes=-", "bytes=5-4", "bytes=a-b", "items=0-5")),
        *((text, None) for text in ("bytes=0-4,6-7", "bytes=\u0661-\u0662")),
    ],
    ids=lambda value: str(value)[:20],
)
def test_a_range_is_that_of_the_standard_and_others_are_ignored(text: str | None, span: range | None) -> None:
    assert span_of(text, SIZE) == span


@given(size=st.integers(0, 50), first=st.integers(0, 60), last=st.integers(0, 60), kind=st.sampled_from("ftx"))
def test_a_range_is_a_slice(size: int, first: int, last: int, kind: str) -> None:
    data = bytes(range(size))
    if kind == "f":
        text, wanted = f"bytes={first}-", data[first:]
    elif kind == "t":
        text, wanted = f"bytes=-{last}", data[max(0, size - last) :]
    elif first <= last:
        text, wanted = f"bytes={first}-{last}", data[first : last + 1]
    else:
        return
    span = span_of(text, size)
    assert span is not None
    assert data[span.start : span.stop] == wanted


DATA = f"/data/0/{TREE.name}"


def test_every_resource_is_sent_as_it_is(server: Server, site: Site) -> None:
    for name, content in site.resources.items():
        answer = ask(server, f"/{quote(name)}")
        assert answer.status == 200, name
        assert answer.body == (content if isinstance(content, bytes) else content.read_bytes()), name


def test_the_root_is_the_page_and_its_settings_name_the_files(server: Server) -> None:
    answer = ask(server, "/?from=somewhere")
    assert (answer.status, answer.body) == (200, ask(server, "/index.html").body)
    assert answer.headers["Content-Type"].startswith("text/html")
    files = json.loads(ask(server, "/view.json").body)["files"]
    assert [ask(server, f"/{file['url']}").body for file in files] == [TREE.read_bytes(), CHUNKED.read_bytes()]
    assert [file["chunked"] for file in files] == [False, True]


def test_chunk_files_are_served_beside_their_header_and_no_other_file_of_the_folder(tmp_path: Path) -> None:
    folder = tmp_path / "rad"
    shutil.copytree(CHUNKED.parent, folder)
    for other in ("secret.txt", "sh3-7.radc"):
        (folder / other).write_text("not named by the header")
    with serving(prepared([folder / CHUNKED.name])) as server:
        for number in range(3):
            assert ask(server, f"/data/0/sh3-{number}.radc").body == (folder / f"sh3-{number}.radc").read_bytes()
        for other in ("secret.txt", "sh3-7.radc", ""):
            assert ask(server, f"/data/0/{other}").status == 404


def test_ranges_are_parts_of_the_file(server: Server) -> None:
    data = TREE.read_bytes()
    answer = ask(server, DATA, Range="bytes=10-19")
    assert (answer.status, answer.body) == (206, data[10:20])
    assert answer.headers["Content-Range"] == f"bytes 10-19/{len(data)}"
    assert answer.headers["Content-Length"] == "10"
    assert ask(server, DATA, Range="bytes=-7").body == data[-7:]
    beyond = ask(server, DATA, Range=f"bytes={len(data)}-")
    assert (beyond.status, beyond.headers["Content-Range"]) == (416, f"bytes */{len(data)}")
    whole = ask(server, DATA, Range="bytes=0-4,6-9")
    assert (whole.status, whole.body) == (200, data)


def test_head_is_get_without_a_body(server: Server) -> None:
    whole, head = ask(server, DATA), ask(server, DATA, "HEAD", Range="bytes=0-3")
    assert (head.status, head.body) == (200, b"")
    assert {**head.headers, "Date": ""} == {**whole.headers, "Date": ""}
    assert ask(server, "/none", "HEAD").body == b""


def test_a_file_that_the_browser_has_is_not_sent_again(server: Server) -> None:
    tag = ask(server, DATA).headers["ETag"]
    assert ask(server, DATA, If_None_Match=tag).status == 304
    assert ask(server, DATA, If_None_Match='"other"').status == 200
    assert ask(server, DATA, Range="bytes=0-3", If_Range=tag).status == 206
    assert ask(server, DATA, Range="bytes=0-3", If_Range='"other"').status == 200


@pytest.mark.parametrize(
    "target",
    [
        "/../../../etc/passwd",
        "/data/0/../../../../etc/passwd",
        "/data/0/%2e%2e/%2e%2e/etc/passwd",
        "/data/0/..%2f..%2fetc%2fpasswd",
        "/%2fetc%2fpasswd",
        "//etc/passwd",
        "/etc/passwd",
        "/data/0/..\\..\\etc\\passwd",
        "/data/0/%5c..%5cetc%5cpasswd",
        f"{DATA}%00",
        f"{DATA}/",
        f"{DATA}/../{TREE.name}",
        "/page/index.html",
        "/%ff%fe",
        "http://elsewhere.example/etc/passwd",
    ],
)
def test_no_name_leads_out(server: Server, target: str) -> None:
    assert ask(server, target).status == 404


def test_a_file_that_became_a_link_a_pipe_or_nothing_is_gone(tmp_path: Path) -> None:
    shown, secret = tmp_path / "scene.spz", tmp_path / "secret"
    shown.write_bytes(TREE.read_bytes())
    secret.write_text("not yours")
    with serving(prepared([shown])) as server:
        assert ask(server, "/data/0/scene.spz").status == 200
        shown.unlink()
        assert ask(server, "/data/0/scene.spz").status == 404
        shown.symlink_to(secret)
        assert ask(server, "/data/0/scene.spz").status == 404
        shown.unlink()
        os.mkfifo(shown)
        assert ask(server, "/data/0/scene.spz").status == 404


@pytest.mark.skipif(os.name != "posix", reason="POSIX only")
def test_a_folder_that_became_a_link_is_not_followed(tmp_path: Path) -> None:
    shutil.copytree(FIXTURES / "golden" / "sh1-streamed-sog", tmp_path / "web")
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "meta.json").write_text("not yours")
    with serving(prepared([tmp_path / "web"])) as server:
        target = "/data/0/0_0/meta.json"
        assert ask(server, target).status == 200
        (tmp_path / "web" / "0_0").rename(tmp_path / "web" / "before")
        (tmp_path / "web" / "0_0").symlink_to(tmp_path / "outside")
        assert ask(server, target).status == 404
        (tmp_path / "web" / "0_0").unlink()
        (tmp_path / "web" / "before").rename(tmp_path / "web" / "0_0")
        assert ask(server, target).status == 200


def test_a_name_with_anything_in_it_is_served(tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode("50 % of ümläut?#&\\'\"<b>\xff.spz".encode("utf-8", "surrogateescape"))
    path.write_bytes(TREE.read_bytes())
    with serving(prepared([path])) as server:
        settings = json.loads(ask(server, "/view.json").body)
        assert ask(server, f"/{settings['files'][0]['url']}").body == TREE.read_bytes()
        page = ask(server, "/").body.decode()
        assert "<b>" not in page
        assert "&lt;b&gt;" in page


@pytest.mark.parametrize("host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "", "localhost:"])
def test_a_page_whose_name_leads_here_gets_nothing(server: Server, host: str) -> None:
    for method in ("GET", "HEAD", "OPTIONS", "POST"):
        assert ask(server, DATA, method, Host=host.format(port=server.port)).status == 421
        assert ask(server, DATA, method, Host=None).status == 421


@pytest.mark.parametrize("host", ["localhost:{port}", "127.0.0.1:{port}", "LOCALHOST:{port}", "[::1]:{port}"])
def test_the_names_of_this_machine_are_ours(server: Server, host: str) -> None:
    assert ask(server, DATA, Host=host.format(port=server.port)).status == 200


def test_other_origins_are_shut_out_unless_asked_in(server: Server, site: Site) -> None:
    shut = ask(server, DATA, Origin="https://elsewhere.example")
    assert "Access-Control-Allow-Origin" not in shut.headers
    assert shut.headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert "Access-Control-Allow-Methods" not in ask(server, DATA, "OPTIONS").headers
    with serving(site, cors=True) as opened:
        answer = ask(opened, DATA, Range="bytes=0-3", Origin="https://elsewhere.example")
        assert (answer.status, answer.headers["Access-Control-Allow-Origin"]) == (206, "*")
        assert "Content-Range" in answer.headers["Access-Control-Expose-Headers"]
        asked = ask(opened, DATA, "OPTIONS", Access_Control_Request_Headers="range")
        assert "Range" in asked.headers["Access-Control-Allow-Headers"]


def test_requests_are_logged(site: Site) -> None:
    log: list[str] = []
    with serving(site, log=log) as server:
        ask(server, DATA)
    assert log == [f'127.0.0.1 "GET {DATA} HTTP/1.1" 200 -']


@pytest.mark.parametrize("host", ["192.0.2.1", "no such name", "x" * 70])
def test_an_address_of_another_machine_is_an_error_of_one_line(site: Site, host: str) -> None:
    with pytest.raises(SparklodError, match="is no address of this machine"):
        Server(site, host=host, port=0, cors=False, log=print)


def test_the_address_is_one_that_a_browser_understands(site: Site) -> None:
    with serving(site, host="0.0.0.0") as server:
        assert server.url == f"http://127.0.0.1:{server.port}/"
        assert not server.loopback
        assert ask(server, DATA, Host="the-name-of-this-machine").status == 200
    if socket.has_ipv6:
        with serving(site, host="::1") as server:
            assert server.url == f"http://[::1]:{server.port}/"


# Camera paths that are dropped onto the page


def dropped(*paths: Path) -> bytes:
    files = [{"name": path.name, "data": base64.b64encode(path.read_bytes()).decode()} for path in paths]
    return json.dumps({"files": files}).encode()


JSON = {"Content_Type": "application/json"}

PATHS = ["sparklod.json", "sparklod.csv", "nerfstudio.json", "transforms.json", "inria.json", "supersplat-v2.json"]


@pytest.mark.parametrize(
    "names", [*PATHS, "splat-transform.json", "tum.txt", "colmap-text/cameras.txt colmap-text/images.txt"]
)
def test_a_dropped_path_is_parsed_as_by_read_cameras(server: Server, names: str) -> None:
    paths = [FIXTURES / "cameras" / name for name in names.split()]
    answer = ask(server, "/cameras", "POST", dropped(*paths), **JSON)
    assert answer.status == 200, answer.body
    frames, cameras = json.loads(answer.body)["frames"], sparklod.read_cameras(paths[0])
    for frame, camera in zip(frames, cameras, strict=True):
        assert frame["matrix"] == pytest.approx(camera.camera_to_world.T.ravel().tolist(), abs=1e-8)
        assert frame["time"] == camera.time


def named(name: str) -> bytes:
    return json.dumps({"files": [{"name": name, "data": ""}]}).encode()


NO_FILES = [b"", b"[]", b"{}", b'{"files": []}', b'{"files": 3}', b'{"files": [{"name": "a", "data": "%"}]}', b"\xff"]


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (dropped(TREE), f"{TREE.name}: its content is of no known format"),
        *(
            (named(name), "no name of a file")
            for name in ("../out.json", "/etc/out.json", "a\\b.json", "..", "", "a\0b")
        ),
        *((body, "the request holds no files") for body in NO_FILES),
    ],
)
def test_a_dropped_file_that_is_no_path_is_an_error(server: Server, body: bytes, said: str) -> None:
    answer = ask(server, "/cameras", "POST", body, **JSON)
    assert answer.status == 422
    assert said in json.loads(answer.body)["error"]


def test_only_our_page_may_post(server: Server) -> None:
    body = dropped(FIXTURES / "cameras" / "sparklod.json")
    own = f"http://127.0.0.1:{server.port}"
    assert ask(server, "/cameras", "POST", body, Origin=own, Sec_Fetch_Site="same-origin", **JSON).status == 200
    assert ask(server, "/cameras", "POST", body, Origin="https://elsewhere.example", **JSON).status == 403
    assert ask(server, "/cameras", "POST", body, Sec_Fetch_Site="cross-site", **JSON).status == 403
    assert ask(server, "/cameras", "POST", body, Content_Type="text/plain").status == 403  # which needs no preflight
    assert ask(server, "/view.json", "POST", body, **JSON).status == 405


def test_the_size_of_what_is_posted_is_bounded(server: Server) -> None:
    assert ask(server, "/cameras", "POST", b"x", Content_Length=str(MAX_BYTES + 1), **JSON).status == 413
    assert ask(server, "/cameras", "POST", b"x", Content_Length="9" * 5000, **JSON).status == 413
    assert ask(server, "/cameras", "POST", b"x", Content_Length="-1", **JSON).status == 411
    assert ask(server, "/cameras", "POST", b"x", Transfer_Encoding="chunked", Content_Length="1", **JSON).status == 411


# The command


@contextlib.contextmanager
def started(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """The command as a process of its own."""
    command = [sys.executable, "-m", "sparklod_cli", "view", *map(str, arguments)]
    environment = {
        name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    }
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=environment, preexec_fn=heed_signals, **pipes) as process:  # type: ignore[call-overload]
        try:
            yield process
        finally:
            process.kill()


def test_it_serves_until_it_is_interrupted() -> None:
    with started(TREE, "--no-open") as process:
        url = process.stdout.readline().strip()
        assert url.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(f"{url}data/0/{TREE.name}") as answer:
            assert answer.read() == TREE.read_bytes()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=20)
    assert (process.returncode, out) == (0, "")
    assert err.splitlines() == [f"serving {TREE.name}; Ctrl-C ends it", "stopped"]


def test_json_names_the_address_and_the_files_and_quiet_nothing_else() -> None:
    with started(TREE, CHUNKED, "--json", "-q") as process:
        told = json.loads(process.stdout.readline())
        process.terminate()
        _, err = process.communicate(timeout=20)
    assert told["url"].startswith("http://127.0.0.1:")
    assert [(file["file"], file["format"]) for file in told["files"]] == [(str(TREE), "SPZ"), (str(CHUNKED), "RAD")]
    assert err == ""


def test_without_a_browser_it_says_so() -> None:
    with started(TREE) as process:
        url = process.stdout.readline().strip()
        lines = [process.stderr.readline().strip() for _ in range(2)]
        process.terminate()
    assert sorted(lines) == [
        f"Could not open a browser; open this address yourself: {url}",
        f"serving {TREE.name}; Ctrl-C ends it",
    ]


def test_a_browser_is_opened_with_the_address(monkeypatch: pytest.MonkeyPatch, capfd: Capture) -> None:
    opened: list[str] = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(webbrowser, "open", lambda url: opened.append(url) or True)

    def serve(server: sites.Server) -> None:
        while not opened:
            pass
        raise KeyboardInterrupt

    monkeypatch.setattr(sites.Server, "serve_forever", serve)
    assert run(["view", str(TREE)]) == 0
    assert capfd.readouterr().out.split() == opened


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["missing.spz"], 1, "error: missing.spz: cannot be read: no such file or directory"),
        (
            [TREE, "--spark-dir", "nowhere"],
            1,
            "error: nowhere/node_modules has no @sparkjsdev/spark; install it with npm",
        ),
        ([TREE, "--host", "192.0.2.1"], 1, "error: '192.0.2.1' is no address of this machine; give --host 127.0.0.1"),
        ([TREE, "--overwrite"], 2, "error: --overwrite can only be used with --export"),
        ([TREE, "--export", "site", "--cors"], 2, "error: --cors cannot be used with --export"),
        ([TREE, "--budget", "0"], 2, "'0' is out of range; give 1 or more"),
        ([TREE, "--camera-path", "missing.json"], 1, "error: missing.json cannot be read"),
        ([TREE, "--look-at", "1,2,3"], 2, "is not EYE:TARGET"),
        (["-"], 2, "standard input is not read here"),
        ([], 2, "Missing argument"),
    ],
    ids=str,
)
def test_what_cannot_be_done_is_one_line(
    arguments: list[object],
    code: int,
    text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: Capture,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["view", *map(str, arguments)]) == code
    out, err = capfd.readouterr()
    assert out == ""
    assert text in err.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_a_port_in_use_is_one_line(capfd: Capture) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert run(["view", str(TREE), "--port", str(port)]) == 1
    assert capfd.readouterr() == (
        "",
        f"error: port {port} is in use; give another --port, or none to have a free one\n",
    )


def test_export_writes_a_site(tmp_path: Path, capfd: Capture) -> None:
    folder = tmp_path / "site"
    command = ["view", str(TREE), "--export", str(folder)]
    assert run([*command, "--json"]) == 0
    out, err = capfd.readouterr()
    told = json.loads(out)
    assert told["folder"] == str(folder)
    assert told["bytes"] == sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    assert err.startswith(f"wrote {folder}: ")
    assert run(command) == 1
    assert "add --overwrite" in capfd.readouterr().err
    assert run([*command, "--overwrite", "-q"]) == 0
    assert capfd.readouterr() == ("", "")
