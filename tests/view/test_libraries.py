"""Where the page takes Spark and three.js from, and what it may load at all."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from pathlib import Path

import pytest

from sparklod_cli.system.errors import SparklodError
from sparklod_cli.view.site import LICENSES, MODULES, PACKAGES, VERSIONS, Site, from_cdn, from_folder
from tests.conftest import FIXTURES
from tests.view.conftest import TREE, prepared

#: Engines that come from a CDN.
ON_CDN = [engine for engine in PACKAGES if engine != "cesium"]


@pytest.fixture
def shown(tileset: Path) -> dict[str, Path]:
    """A file of each engine."""
    return {"spark": TREE, "playcanvas": FIXTURES / "golden" / "sh1-streamed-sog", "cesium": tileset}


def page_of(site: Site) -> tuple[dict[str, dict[str, str]], str]:
    """The import map of the page, and its policy."""
    index = site.resources["index.html"]
    assert isinstance(index, bytes)
    found = re.search(r'<script type="importmap">(.*?)</script>', index.decode(), re.DOTALL)
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', index.decode())
    assert found and policy
    digest = base64.b64encode(hashlib.sha256(found[1].encode()).digest()).decode()
    assert f"'sha256-{digest}'" in html.unescape(policy[1])
    return json.loads(found[1]), html.unescape(policy[1])


@pytest.mark.parametrize("engine", ON_CDN)
def test_the_cdn_is_asked_for_fixed_versions_by_their_digests(engine: str, shown: dict[str, Path]) -> None:
    mapped, policy = page_of(prepared([shown[engine]]))
    assert all(url.startswith("https://") for url in mapped["imports"].values())
    assert len(mapped["integrity"]) == sum(package in PACKAGES[engine] for package, _ in MODULES)
    for url, digest in mapped["integrity"].items():
        assert any(f"{package}@{version}/" in url for package, version in VERSIONS.items())
        assert re.fullmatch(r"sha384-[A-Za-z0-9+/]{64}", digest)
        assert url in policy
    assert from_cdn(engine).notes() == []


@pytest.mark.parametrize("engine", PACKAGES)
def test_a_folder_needs_no_other_host(packages: Path, engine: str, shown: dict[str, Path]) -> None:
    site = prepared([shown[engine]], spark_dir=packages)
    mapped, policy = page_of(site)
    assert "http" not in json.dumps(mapped) + policy
    assert ("'unsafe-eval'" in policy) == ("'unsafe-inline'" in policy) == (engine == "cesium")
    for url in mapped["imports"].values():
        name = url.removeprefix("./")
        assert any(each == name or (url.endswith("/") and each.startswith(name)) for each in site.resources)
    licenses = [name for name in site.resources if name.endswith(LICENSES)]
    assert len(licenses) == len(PACKAGES[engine])


def test_workers_come_with_an_engine_and_from_no_cdn(packages: Path, tileset: Path) -> None:
    site = prepared([tileset], spark_dir=packages)
    assert "lib/cesium/Build/Cesium/Workers/gaussianSplatone.js" in site.resources
    with pytest.raises(SparklodError, match=r"^CesiumJS cannot be taken from a CDN; install it with npm .* cesium@"):
        prepared([tileset])


def test_node_modules_itself_can_be_given(packages: Path) -> None:
    assert from_folder(packages / "node_modules").files == from_folder(packages).files


def test_links_of_a_package_manager_are_followed(packages: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    (packages / "node_modules" / "three").rename(store)
    (packages / "node_modules" / "three").symlink_to(store)
    assert from_folder(packages).files["lib/three/build/three.module.js"] == store / "build" / "three.module.js"


def test_a_folder_whose_name_is_too_long_has_no_package() -> None:
    with pytest.raises(SparklodError, match="has no @sparkjsdev/spark"):
        from_folder(Path("9" * 300))


@pytest.mark.parametrize("package", VERSIONS)
def test_a_folder_without_a_package_says_how_to_install_it(packages: Path, package: str) -> None:
    (packages / "node_modules" / package).rename(packages / "away")
    with pytest.raises(SparklodError, match=f"has no {package}; install it with npm install --prefix {packages} "):
        from_folder(packages, next(engine for engine, needed in PACKAGES.items() if package in needed))


def test_a_package_without_its_module_is_told(packages: Path) -> None:
    (packages / "node_modules" / "three" / "build" / "three.module.js").unlink()
    with pytest.raises(SparklodError, match=r"three has no build/three.module.js"):
        from_folder(packages)


def test_another_version_is_noted(packages: Path) -> None:
    (packages / "node_modules" / "three" / "package.json").write_text('{"version": "0.180.0"}')
    assert from_folder(packages).notes() == [
        f"{packages} has three 0.180.0; the page was tested with {VERSIONS['three']}"
    ]


@pytest.mark.parametrize("text", ["", "[]", "{}", "nothing"])
def test_a_package_without_a_version_is_told(packages: Path, text: str) -> None:
    (packages / "node_modules" / "three" / "package.json").write_text(text)
    with pytest.raises(SparklodError, match="has no version"):
        from_folder(packages)


def test_the_page_has_all_modules_that_it_imports() -> None:
    site = prepared([TREE])
    sources = {name: content.decode() for name, content in site.resources.items() if name.endswith(".js")}  # type: ignore[union-attr]
    assert sources
    for name, source in sources.items():
        for imported in re.findall(r"(?:from|import\() ?'([^']+)'", source):
            assert imported.removeprefix("./") in sources or imported in VERSIONS, (name, imported)
    index = site.resources["index.html"]
    assert isinstance(index, bytes)
    ids = set(re.findall(r'\bid="([^"]+)"', index.decode()))
    used = {each for source in sources.values() for each in re.findall(r"element\('([^']+)'\)", source)}
    assert used <= ids
    assert not re.search(r"\son\w+=|style=|{{", index.decode()), "the policy forbids it"
