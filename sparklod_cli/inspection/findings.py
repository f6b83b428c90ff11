"""`Finding`, something that a check has found, and the table of all that can be found."""

from __future__ import annotations

from dataclasses import dataclass

ERROR, WARNING, NOTE = "error", "warning", "note"

#: Every code, how bad it is, and what it means. Codes stay what they are from version to version.
CODES: dict[str, tuple[str, str]] = {
    "file.unreadable": (ERROR, "the file cannot be opened, or is empty"),
    "file.format": (ERROR, "it is of no format that sparklod reads"),
    "file.not-splats": (ERROR, "it is of a known format, but holds something else than splats"),
    "container.cut-short": (ERROR, "the file ends before what it promises"),
    "container.promise": (ERROR, "the header promises more than a file of this size can hold"),
    "container.version": (ERROR, "a version, compression level or SH degree that the format does not have"),
    "container.corrupt": (ERROR, "the bytes are not what the format says"),
    "container.checksum": (ERROR, "a checksum does not match"),
    "container.too-long": (ERROR, "a stream is longer than the header promises"),
    "container.members": (ERROR, "a second gzip member follows; Spark stops after the first"),
    "container.trailing": (WARNING, "bytes follow that belong to nothing"),
    "container.flags": (WARNING, "flags or reserved bytes of the header that mean nothing are set"),
    "container.left-out": (WARNING, "the file holds something that is left out when it is read"),
    "values.empty": (ERROR, "there are no splats"),
    "values.non-finite": (ERROR, "a number is not finite, or a rotation has the length 0"),
    "values.rotation": (ERROR, "the length of a rotation is not 1"),
    "values.negative-scale": (ERROR, "a scale is below 0"),
    "values.opacity": (ERROR, "an opacity is below 0, or above 1 in a file that is no tree"),
    "values.invisible": (WARNING, "many splats, of a tree many leaves, have opacity 0 or scale 0 and cannot be drawn"),
    "values.scale-clamped": (
        WARNING,
        "scales of many splats, of a tree of many leaves, lie at an end of what SPZ holds",
    ),
    "values.center-clamped": (ERROR, "centres lie at the end of what the format holds"),
    "values.center-far": (WARNING, "centres lie so far out that a viewer's float16 cannot hold them"),
    "tree.root": (ERROR, "node 0 is the child of another node"),
    "tree.range": (ERROR, "a node has children past the last node"),
    "tree.order": (ERROR, "a node comes after one of its children"),
    "tree.shared": (ERROR, "a node is the child of more than one"),
    "tree.orphan": (ERROR, "a node is nobody's child"),
    "tree.unreachable": (ERROR, "a node has a parent, but the root does not lead to it: there is a cycle"),
    "tree.leaf-start": (WARNING, "a leaf has a child_start, which should be 0"),
    "tree.leaf-opacity": (ERROR, "a leaf is more than opaque, which only merged splats can be"),
    "tree.single-child": (WARNING, "an inner node has one child, of which it is only a copy"),
    "tree.size": (
        WARNING,
        "a node is less than a third as large as its children in the mean, by what they cover: it comes too late",
    ),
    "tree.coarse-first": (NOTE, "the file is not ordered coarse before fine, so a part of it is not a coarse scene"),
    "expect.bytes": (ERROR, "the file is larger than expected"),
    "expect.splats": (ERROR, "there are fewer or more splats than expected"),
    "expect.sh": (ERROR, "another SH degree than expected"),
    "expect.lod": (ERROR, "a tree was expected, or none"),
    "expect.growth": (ERROR, "the tree has more nodes for its leaves than expected"),
    "expect.leaves": (ERROR, "the leaves are not the splats of the original"),
    "expect.value": (ERROR, "a value of the report is not what was expected"),
}


@dataclass(frozen=True)
class Finding:
    """One finding.

    Attributes:
        code: one of `CODES`.
        message: what was found, with numbers, in a line.
        index: of the first splat or node that it is about, where there is one.
        count: of the splats or nodes that it is about.
    """

    code: str
    message: str
    index: int | None = None
    count: int | None = None

    def __post_init__(self) -> None:
        if self.code not in CODES:
            raise ValueError(f"{self.code} is not a known code")

    @property
    def severity(self) -> str:
        """error, warning or note."""
        return CODES[self.code][0]
