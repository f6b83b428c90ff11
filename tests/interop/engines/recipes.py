"""The pages that docs/playcanvas.md and docs/spark.md give their readers."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache

from tests.conftest import ROOT

#: Headings of the engines' sections.
PLAYCANVAS, SUPERSPLAT, BABYLON = "PlayCanvas", "SuperSplat's viewer", "Babylon.js"
#: Headings in docs/cesium.md: of its page.
CESIUM = "A page"
#: Headings in docs/spark.md: of its page, and of the lines that change where a tree is streamed.
SPARK, STREAMED = "A page", "Streamed"
#: Names of the scene in the pages.
MANIFEST, SOG, GLB, TREE, RAD = "lod-meta.json", "scene.sog", "scene.glb", "scene-lod.spz", "scene-lod.rad"


@cache
def blocks(heading: str, language: str, document: str = "playcanvas.md") -> tuple[str, ...]:
    """The blocks of code of a language in a section of a document."""
    text = (ROOT / "docs" / document).read_text(encoding="utf-8")
    (section,) = re.findall(rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", text, re.DOTALL | re.MULTILINE)
    return tuple(re.findall(rf"^```{language}\n(.*?)^```", section, re.DOTALL | re.MULTILINE))


def page(heading: str, name: str = MANIFEST) -> str:
    """The page of a section, for a scene of another name."""
    (html,) = blocks(heading, "html")
    return replaced(html, {MANIFEST: name})


def playcanvas_of_glb(name: str = GLB) -> str:
    """The page of PlayCanvas, in which the lines for a GLB take the place of those of a Streamed SOG."""
    html = page(PLAYCANVAS)
    (lines,) = blocks(PLAYCANVAS, "js", "gltf.md")
    start, end = html.index("  const asset ="), html.index("  const camera =")
    return replaced(html[:start] + lines + "\n" + html[end:], {GLB: name})


def babylon_of_one_file(name: str = SOG) -> str:
    """The page of Babylon.js, in which the lines for a plain SOG take the place of those that stream."""
    html = page(BABYLON)
    (lines,) = blocks(BABYLON, "js")
    return replaced(html[: html.index("  const metadata")] + lines + "</script>", {SOG: name})


def spark(*, streamed: bool) -> str:
    """The page of Spark, for a tree that is loaded as a whole or streamed."""
    (html,) = blocks(SPARK, "html", "spark.md")
    if not streamed:
        return html
    (lines,) = blocks(STREAMED, "js", "spark.md")
    first = next(line for line in html.splitlines() if "new SparkRenderer(" in line)
    second = next(line for line in html.splitlines() if "new SplatMesh(" in line)
    return replaced(html, {f"{first}\n{second}\n": lines})


def cesium() -> str:
    """The page of docs/cesium.md, which shows tileset.json."""
    (html,) = blocks(CESIUM, "html", "cesium.md")
    return html


def replaced(html: str, changes: Mapping[str, str]) -> str:
    """A page with some of its text replaced, all of which it must have."""
    for old, new in changes.items():
        assert old in html, f"the page has no {old}"
        html = html.replace(old, new)
    return html
