"""What the comment of a header tells, ours and others'."""

from __future__ import annotations

import json

import pytest

from sparklod_cli.codecs.rad.comment import comment_of, tells_antialiased


@pytest.mark.parametrize("antialiased", [False, True])
def test_a_comment_is_json_that_names_its_writer(antialiased: bool) -> None:
    comment = comment_of(antialiased=antialiased)
    assert json.loads(comment)["generator"].startswith("sparklod ")
    assert tells_antialiased(comment) is antialiased


@pytest.mark.parametrize(
    "comment",
    [
        None,
        "",
        "sparklod antialiased",
        '{"antialiased": true}',
        '{"generator": "another", "antialiased": true}',
        '{"generator": ["sparklod "], "antialiased": true}',
        '{"generator": "sparklod 1", "antialiased": "yes"}',
        '["sparklod 1", "antialiased"]',
        "[" * 10_000,
    ],
)
def test_comments_of_others_tell_nothing(comment: str | None) -> None:
    assert not tells_antialiased(comment)
