"""Laws of the choice of detail levels; tests/interop compares it with PlayCanvas's own modules."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.viewers.playcanvas import Chains, DetailChoice, Distant, RegionBounds, choose
from sparklod_cli.viewers.viewer_settings import DetailRule
from tests.lod.details import random_regions, random_view
from tests.lod.sights import CutView

RULES = (DetailRule(), DetailRule(mode="limit"), DetailRule(finest=1, coarsest=2), DetailRule(multiplier=1.2))


def distant(seed: int, *, gaps: float = 0.0, several: int = 1, rule: DetailRule) -> list[Distant]:
    """Instances of random regions as a random camera sees them."""
    random = np.random.default_rng(seed)
    view = random_view(random)
    found = []
    for _ in range(several):
        regions = random_regions(random, int(random.integers(1, 60)), int(random.integers(1, 6)), gaps=gaps)
        distances = RegionBounds(regions.bounds).squared_distances(view, np.eye(4), rule)
        found.append(Distant(Chains.of(regions.counts, rule), distances, rule.base_distance))
    return found


def places(choice: DetailChoice, instances: Sequence[Distant]) -> list[np.ndarray]:
    """(R,) for each instance, the place of each level in its chain."""
    return [
        np.argmax(each.chains.level == levels[:, None], axis=1)
        for each, levels in zip(instances, choice.levels, strict=True)
    ]


@given(st.integers(0, 10_000), st.sampled_from(RULES), st.floats(0, 1.2), st.sampled_from([0.0, 0.4]))
def test_the_budget_holds_unless_the_coarsest_levels_are_more(
    seed: int, rule: DetailRule, share: float, gaps: float
) -> None:
    instances = distant(seed, gaps=gaps, several=1 + seed % 2, rule=rule)
    budget = max(1, int(share * sum(each.chains.count[:, 0].sum() for each in instances)))
    choice = choose(instances, budget, rule)
    coarsest = sum(each.chains.count[:, -1].sum() for each in instances)
    assert choice.splats <= max(budget, coarsest)
    assert choice.splats == sum(
        each.chains.count[np.arange(len(at)), at].sum()
        for each, at in zip(instances, places(choice, instances), strict=True)
    )


@given(st.integers(0, 10_000), st.sampled_from(RULES))
def test_a_larger_budget_makes_no_region_coarser(seed: int, rule: DetailRule) -> None:
    """Where the counts of every region fall from level to level."""
    instances = distant(seed, several=2, rule=rule)
    finest = sum(each.chains.count[:, 0].sum() for each in instances)
    before = None
    for share in (0.0, 0.1, 0.3, 0.31, 0.6, 0.99, 1.0, 1.5):
        now = np.concatenate(places(choose(instances, max(1, int(share * finest)), rule), instances))
        assert before is None or (now <= before).all()
        before = now


@given(st.integers(0, 10_000), st.sampled_from(RULES), st.floats(0.01, 1))
def test_nearer_regions_are_never_coarser(seed: int, rule: DetailRule, share: float) -> None:
    """Whatever their counts, for the threshold is the same for all regions of an instance."""
    (instance,) = distant(seed, rule=rule)
    budget = max(1, int(share * instance.chains.count[:, 0].sum()))
    (place,) = places(choose([instance], budget, rule), [instance])
    assert (np.diff(place[np.argsort(instance.squared_distance, kind="stable")]) >= 0).all()


@pytest.mark.parametrize("rule", RULES)
def test_a_budget_for_all_shows_the_finest_levels_and_one_splat_the_coarsest(rule: DetailRule) -> None:
    (instance,) = distant(5, rule=rule)
    most = choose([instance], 1 << 40, rule)
    assert rule.mode == "limit" or (
        most.reason == "exhausted" and (most.levels[0] == instance.chains.level[:, 0]).all()
    )
    least = choose([instance], 1, rule)
    assert least.reason == "budget" and (least.levels[0] == instance.chains.level[:, -1]).all()


def test_a_limit_shows_the_levels_that_are_due_at_their_distances() -> None:
    """Level 1 from the base distance on, and each further one at the multiple of that distance."""
    rule = DetailRule(mode="limit", base_distance=5.0, multiplier=3.0)
    edges = np.array([0.1, 4.7, 5.3, 14.3, 15.7, 43.0, 47.0, 1e6])
    counts = np.tile([800, 400, 200, 100], (len(edges), 1))
    choice = choose([Distant(Chains.of(counts, rule), edges**2, rule.base_distance)], 1 << 30, rule)
    assert choice.levels[0].tolist() == [0, 0, 1, 1, 2, 2, 3, 3] and choice.reason == "distance"
    near = choose([Distant(Chains.of(counts[:2], rule), edges[:2] ** 2, rule.base_distance)], 1 << 30, rule)
    assert near.levels[0].tolist() == [0, 0] and near.reason == "exhausted"


def test_a_region_without_a_level_shows_a_finer_one_and_beyond_its_last_nothing() -> None:
    counts = np.array([[9, 0, 4, 0, 0], [0, 7, 0, 3, 1], [0, 0, 0, 0, 0], [5, 0, 0, 0, 0]])
    chains = Chains.of(counts, DetailRule())
    assert chains.level.tolist() == [[0, 0, 2, 3, 3], [1, 1, 1, 3, 4], [-1] * 5, [0, 1, 1, 1, 1]]
    assert chains.count.tolist() == [[9, 9, 4, 0, 0], [7, 7, 7, 3, 1], [0] * 5, [5, 0, 0, 0, 0]]


def test_what_is_behind_or_seen_by_a_wide_lens_is_farther() -> None:
    bounds = np.array([[[-1.0, -1, -11], [1, 1, -9]], [[-1.0, -1, 9], [1, 1, 11]]])  # before the camera, and behind it

    def distances(fov: float, **rule: float) -> list[float]:
        view = CutView(np.eye(4), fov, fov)
        return np.sqrt(RegionBounds(bounds).squared_distances(view, np.eye(4), DetailRule(**rule))).tolist()

    assert distances(np.pi / 4, behind_penalty=2.0) == pytest.approx([9.0, 18.0])
    assert distances(np.pi / 4, behind_penalty=1.0) == pytest.approx([9.0, 9.0])
    assert distances(np.pi / 2, behind_penalty=1.0) == pytest.approx([9.0 / np.tan(np.pi / 8)] * 2)


def test_distances_go_to_bounds_that_shrink_by_what_they_exceed_the_median() -> None:
    sides = np.array([2.0, 2.0, 10.0])
    bounds = np.array(
        [[[20 * at, -side / 2, -side / 2], [20 * at + side, side / 2, side / 2]] for at, side in enumerate(sides)]
    )
    camera = np.eye(4)
    camera[:3, 3] = [45.0, 105.0, 0.0]
    for shrink, high in ((0.0, 5.0), (1.0, 1.0), (0.5, 3.0)):
        rule = DetailRule(behind_penalty=1.0, shrink=shrink)
        found = RegionBounds(bounds).squared_distances(CutView(camera, np.pi / 4, np.pi / 4), np.eye(4), rule)
        assert np.sqrt(found[2]) == pytest.approx(105.0 - high)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"mode": "most"}, "there is no budget mode 'most'; give one of target, limit"),
        ({"base_distance": 0.0}, "base_distance is 0.0; give 0.1 or more"),
        ({"multiplier": 1.0}, "multiplier is 1.0; give 1.2 or more"),
        ({"behind_penalty": float("nan")}, "behind_penalty is nan; give 1 or more"),
        ({"shrink": 1.5}, "shrink is 1.5; give 0 to 1"),
        ({"finest": 2, "coarsest": 1}, "levels 2 to 1 are no range; give 0 <= finest <= coarsest"),
    ],
)
def test_rules_refuse_numbers_out_of_range(wrong: dict[str, float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        DetailRule(**wrong)
