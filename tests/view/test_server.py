"""The server: files by their names, in ranges, and nothing else to nobody else."""

from __future__ import annotations

import json
import os
import shutil
import socket
from pathlib import Path
from urllib.parse import quote

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.system.errors import SparklodError
from sparklod_cli.view.server import Server, span_of
from sparklod_cli.view.site import MAX_BYTES, Site
from tests.conftest import FIXTURES
from tests.view.conftest import CHUNKED, TREE, ask, prepared, serving

SIZE = 10_000


@pytest.mark.parametrize(
    ("text", "first", "count"),
    [
        ("bytes=0-499", 0, 500),
        ("bytes=500-999", 500, 500),
        ("bytes=-500", 9500, 500),
        ("bytes=9500-", 9500, 500),
        ("bytes=0-0", 0, 1),
        ("bytes=-1", 9999, 1),
        ("bytes=9999-123456", 9999, 1),
        ("bytes=-123456", 0, SIZE),
        ("BYTES = 5 - 7 ", 5, 3),
        ("bytes=000-0001", 0, 2),
    ],
)
def test_the_examples_of_the_standard(text: str, first: int, count: int) -> None:
    assert span_of(text, SIZE) == range(first, first + count)


@pytest.mark.parametrize("text", ["bytes=10000-", "bytes=10000-10001", "bytes=-0", f"bytes={'9' * 5000}-"])
def test_a_range_of_nothing_has_no_bytes(text: str) -> None:
    span = span_of(text, SIZE)
    assert span is not None
    assert not span


@pytest.mark.parametrize(
    "text",
    [
        None,
        "",
        "bytes",
        "bytes=",
        "bytes=-",
        "bytes=5-4",
        "bytes=a-b",
        "items=0-5",
        "bytes=0-4,6-7",
        "bytes=\u0661-\u0662",
    ],
)
def test_what_is_no_single_range_is_ignored(text: str | None) -> None:
    assert span_of(text, SIZE) is None


@given(size=st.integers(0, 50), first=st.integers(0, 60), last=st.integers(0, 60), kind=st.sampled_from("ftx"))
def test_it_is_what_python_slices(size: int, first: int, last: int, kind: str) -> None:
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


def test_the_root_is_the_page(server: Server) -> None:
    answer = ask(server, "/?from=somewhere")
    assert (answer.status, answer.body) == (200, ask(server, "/index.html").body)
    assert answer.headers["Content-Type"].startswith("text/html")


def test_the_settings_name_the_files(server: Server) -> None:
    settings = json.loads(ask(server, "/view.json").body)
    assert [ask(server, f"/{file['url']}").body for file in settings["files"]] == [
        TREE.read_bytes(),
        CHUNKED.read_bytes(),
    ]
    assert [file["chunked"] for file in settings["files"]] == [False, True]


def test_chunk_files_are_served_beside_their_header_and_no_other_file_of_the_folder(tmp_path: Path) -> None:
    folder = tmp_path / "rad"
    shutil.copytree(CHUNKED.parent, folder)
    (folder / "secret.txt").write_text("not yours")
    (folder / "sh3-7.radc").write_text("not named by the header")
    with serving(prepared([folder / CHUNKED.name])) as server:
        for number in range(3):
            assert ask(server, f"/data/0/sh3-{number}.radc").body == (folder / f"sh3-{number}.radc").read_bytes()
        assert ask(server, "/data/0/secret.txt").status == 404
        assert ask(server, "/data/0/sh3-7.radc").status == 404
        assert ask(server, "/data/0/").status == 404


def test_a_range_is_a_part_of_the_file(server: Server) -> None:
    data = TREE.read_bytes()
    answer = ask(server, DATA, Range="bytes=10-19")
    assert (answer.status, answer.body) == (206, data[10:20])
    assert answer.headers["Content-Range"] == f"bytes 10-19/{len(data)}"
    assert answer.headers["Content-Length"] == "10"
    assert ask(server, DATA, Range="bytes=-7").body == data[-7:]
    assert ask(server, DATA, Range=f"bytes={len(data) - 3}-").body == data[-3:]


def test_a_range_beyond_the_end_is_refused_with_the_size(server: Server) -> None:
    size = TREE.stat().st_size
    answer = ask(server, DATA, Range=f"bytes={size}-")
    assert (answer.status, answer.headers["Content-Range"]) == (416, f"bytes */{size}")


@pytest.mark.parametrize("text", ["bytes=0-4,6-9", "lines=1-2", "bytes=9-3"])
def test_other_ranges_are_ignored(server: Server, text: str) -> None:
    answer = ask(server, DATA, Range=text)
    assert (answer.status, answer.body) == (200, TREE.read_bytes())


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


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "", "localhost:", None]
)
def test_a_page_whose_name_leads_here_gets_nothing(server: Server, host: str | None) -> None:
    given = host.format(port=server.port) if host is not None else None
    for method in ("GET", "HEAD", "OPTIONS", "POST"):
        assert ask(server, DATA, method, Host=given).status == 421


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


def test_a_port_in_use_is_one_line(server: Server, site: Site) -> None:
    with pytest.raises(SparklodError, match=f"^port {server.port} is in use; give another --port"):
        Server(site, host="127.0.0.1", port=server.port, cors=False, log=print)


@pytest.mark.parametrize("host", ["192.0.2.1", "no such name", "x" * 70])
def test_an_address_of_another_machine_is_one_line(site: Site, host: str) -> None:
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


# --- camera paths


def dropped(*paths: Path, name: str | None = None) -> bytes:
    import base64

    files = [{"name": name or path.name, "data": base64.b64encode(path.read_bytes()).decode()} for path in paths]
    return json.dumps({"files": files}).encode()


JSON = {"Content_Type": "application/json"}


@pytest.mark.parametrize(
    "names",
    [
        ["sparklod.json"],
        ["sparklod.csv"],
        ["nerfstudio.json"],
        ["transforms.json"],
        ["inria.json"],
        ["supersplat-v2.json"],
        ["splat-transform.json"],
        ["tum.txt"],
        ["colmap-text/cameras.txt", "colmap-text/images.txt"],
    ],
    ids=lambda names: names[-1],
)
def test_a_dropped_path_is_parsed_as_by_read_cameras(server: Server, names: list[str]) -> None:
    import sparklod_cli as sparklod

    paths = [FIXTURES / "cameras" / name for name in names]
    answer = ask(server, "/cameras", "POST", dropped(*paths), **JSON)
    assert answer.status == 200, answer.body
    found = json.loads(answer.body)
    cameras = sparklod.read_cameras(paths[0])
    assert len(found["frames"]) == len(cameras)
    for frame, camera in zip(found["frames"], cameras, strict=True):
        assert frame["matrix"] == pytest.approx(camera.camera_to_world.T.ravel().tolist(), abs=1e-8)
        assert frame["time"] == camera.time


def test_a_file_that_is_no_path_is_told(server: Server) -> None:
    answer = ask(server, "/cameras", "POST", dropped(TREE), **JSON)
    assert answer.status == 422
    assert json.loads(answer.body)["error"].startswith(f"{TREE.name}: its content is of no known format")


@pytest.mark.parametrize("name", ["../out.json", "/etc/out.json", "a\\b.json", "..", "", "a\0b"])
def test_a_dropped_name_does_not_lead_out(server: Server, name: str) -> None:
    body = json.dumps({"files": [{"name": name, "data": ""}]}).encode()
    answer = ask(server, "/cameras", "POST", body, **JSON)
    assert answer.status == 422
    assert "no name of a file" in json.loads(answer.body)["error"]


@pytest.mark.parametrize(
    "body", [b"", b"[]", b"{}", b'{"files": []}', b'{"files": 3}', b'{"files": [{"name": "a", "data": "%"}]}', b"\xff"]
)
def test_a_request_without_files_is_told(server: Server, body: bytes) -> None:
    answer = ask(server, "/cameras", "POST", body, **JSON)
    assert (answer.status, json.loads(answer.body)) == (422, {"error": "the request holds no files"})


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
