"""Texts of `--assert`, for `traverse` and for `render --compare`."""

from __future__ import annotations

from pathlib import Path

from sparklod_cli.simulation.results import COLUMNS
from sparklod_cli.tables.assertions import parse

from ..case import Case, Rng
from ..command import command
from ..mutate import WORDS, pick, text_mutated
from .cameras import tree

SEEDS = (
    *("churn_p95<0.2", "selected_max<=500k", "pixel_scale_min_max < 1e-3", "leaves != 0", "share_mean>=20%"),
    *("level_max_p99.9<12", "overdraw_estimate_median>.5", "missing==0", "bytes_new_sum<2M", "time_s_last>0"),
)
COMPARISONS = ("psnr_min>30", "5%:psnr>30", "100: ssim_mean >= 0.9", "worst_tile_psnr_p05>10")

#: Characters of an argument: what Linux passes to a program, with its terminating zero. Lines that are repeated grow
#: to hundreds of megabytes.
LONGEST = (1 << 17) - 1


def make(rng: Rng) -> Case:
    """Changes the text of an assertion; most cases only parse it, some run a command with it."""
    compares = rng.integers(20) == 0
    text = text_mutated(rng, pick(rng, COMPARISONS if compares else SEEDS))
    text = text[: int(rng.integers(len(text) + 1))] + pick(rng, WORDS) if rng.integers(8) == 0 else text
    text = text.encode("utf-8", "replace").decode().replace("\0", "")[:LONGEST]
    if compares:
        line = ["render", "tree.spz", "--compare", "--budget", "5", "--size", "16x12"]
    else:
        line = ["traverse", "tree.spz", "--orbit", "2", "--no-timing"] if rng.integers(10) == 0 else []
    return Case(repr(text)[:60], {"tree.spz": tree()}, {"text": text, "arguments": line})


def check(case: Case, folder: Path) -> None:
    """The text is parsed as an assertion, or refused with an error."""
    text, arguments = case.run["text"], case.run["arguments"]
    if arguments:
        command([*arguments, f"--assert={text}"])
        return
    asserted = parse(text, COLUMNS)
    asserted.holds(1)
    asserted.holds(0.5)
