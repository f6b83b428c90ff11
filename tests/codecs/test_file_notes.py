"""What sparklod notes in files, and that notes of others, or broken ones, say nothing."""

from __future__ import annotations

import json

import pytest

from sparklod_cli.codecs.reader import FileNote, comment_of, note_of, read_comment, read_note
from sparklod_cli.model.scene import AXES


@pytest.mark.parametrize("up", [None, *AXES])
@pytest.mark.parametrize("antialiased", [False, True])
def test_a_note_is_json_that_names_its_writer_and_comes_back(antialiased: bool, up: str | None) -> None:
    comment = comment_of(antialiased=antialiased, up=up)
    assert json.loads(comment)["generator"].startswith("sparklod ")
    assert comment.isascii()
    assert "\n" not in comment
    assert "\0" not in comment
    assert (
        read_comment(comment)
        == read_note(note_of(antialiased=antialiased, up=up))
        == FileNote(antialiased, up, is_ours=True)
    )


def test_what_is_not_known_is_not_noted() -> None:
    assert list(note_of()) == ["generator"]


@pytest.mark.parametrize(
    "comment",
    [
        None,
        "",
        b"",
        b"\xff\xfe",
        "sparklod antialiased",
        '{"antialiased": true, "up": "y"}',
        '{"generator": "another", "antialiased": true, "up": "y"}',
        '{"generator": ["sparklod "], "antialiased": true, "up": "y"}',
        '["sparklod 1", "antialiased"]',
        "[" * 10_000,
    ],
)
def test_comments_of_others_say_nothing(comment: str | bytes | None) -> None:
    assert read_comment(comment) == FileNote()


def test_values_of_other_kinds_say_nothing() -> None:
    assert read_comment('{"generator": "sparklod 1", "antialiased": "yes", "up": null}') == FileNote(is_ours=True)


@pytest.mark.parametrize("up", ["Y", "--help", "", 1, True, [], ["y"], {"y": 1}, "y" * 1000, "\x1b[31m"])
def test_an_up_axis_that_is_none_is_ignored_with_a_problem(up: object) -> None:
    noted = read_note({"generator": "sparklod 1", "up": up})
    assert noted.up is None
    (problem,) = noted.problems
    assert "up axis" in problem
    assert problem.isprintable()
    assert len(problem) < 250
