"""The belief about the day: the posterior by hand, levels found, sensors that err, repeated observations, parts."""

import itertools

import numpy as np
import pytest
from scipy.special import logit

from parkenv.belief import day_belief
from parkenv.belief.day_belief import EVENT, DayBelief, independent_share
from parkenv.belief.day_belief import UNINFORMATIVE_SLOT_PROBABILITY as DOUBT
from parkenv.belief.slot_belief import SlotBelief
from parkenv.world.occupancy.centred_logits import centred_logits
from parkenv.world.occupancy.day_error import DayError, nearness


def forecast_of(n, seed=0, level=0.8, slope=0.0, decay_rate=0.0, least=0.3):
    """Forecast of at least `least`, nearness, and belief before any observation."""
    rng = np.random.default_rng(seed)
    near, p = nearness(rng.uniform(10.0, 90.0, n)), rng.uniform(least, 0.95, n)
    return p, near, SlotBelief.of_forecast(p, np.full(n, decay_rate), (level, slope))


@pytest.mark.parametrize(("level", "slope"), [(0.0, 0.0), (0.8, 0.0), (0.5, 0.5), (1.5, 0.0)])
def test_before_any_observation_the_forecast_is_believed(level, slope):
    p, near, belief = forecast_of(60, level=level, slope=slope)
    np.testing.assert_allclose(DayBelief(belief, near).p_occupied(belief.time), p, atol=0.01)


@pytest.mark.parametrize(("level", "slope"), [(0.0, 0.0), (0.8, 0.4)])
def test_a_forecast_of_certainty_is_doubted(level, slope):
    """A slot that is surely taken according to the forecast is free in half a `DOUBT` of all cases."""
    _, near, belief = forecast_of(60, level=level, slope=slope)
    belief.forecast[0] = 0.9999
    sure, doubted = (DayBelief(belief, near, doubt=doubt).p_occupied(belief.time) for doubt in (0.0, DOUBT))
    expected = belief.forecast + DOUBT * (0.5 - belief.forecast)
    np.testing.assert_allclose(doubted - sure, expected - belief.forecast, atol=0.2 * DOUBT)
    assert doubted[0] < 1.0 - 0.4 * DOUBT
    known = DayBelief(belief, near, certain=True, doubt=DOUBT).p_occupied(belief.time)
    np.testing.assert_allclose(known, belief.forecast, atol=1e-6)


def test_it_finds_the_level_of_the_day_from_its_observations():
    """On days drawn from the forecast's own error, P(taken) of what is not observed is right in the mean."""
    p, near, before = forecast_of(300, level=0.8, slope=0.4)
    rng, error, found, forecast_errors = np.random.default_rng(1), DayError(0.8, 0.4), [], []
    centre = centred_logits(p, error.deviations(near))
    for _ in range(60):
        level, slope = error.level * rng.standard_normal(), error.slope * rng.standard_normal()
        truth = 1.0 / (1.0 + np.exp(-(centre + level + slope * near)))
        seen = rng.permutation(300)[:100]
        belief = before.update(seen, rng.random(100) < truth[seen])
        day = DayBelief(before, near, event=0.0)
        day.update(belief.observations)
        rest = np.setdiff1d(np.arange(300), seen)
        found.append((day.p_occupied(belief.time) - truth)[rest])
        forecast_errors.append((p - truth)[rest])
    assert abs(np.mean(found)) < 0.015
    assert np.abs(found).mean() < 0.35 * np.abs(forecast_errors).mean()


def test_an_event_is_told_from_a_fuller_day():
    """Slots near the goal are all taken, those further on as forecast: the belief changes near the goal alone."""
    p, near, before = forecast_of(120, level=0.3, least=0.6)
    seen = np.flatnonzero((near > 0.3) | (near < -0.8))
    belief = before.update(seen, np.where(near[seen] > 0.0, True, np.arange(len(seen)) % 3 > 0))
    day = DayBelief(before, near)
    day.update(belief.observations)
    found = day.p_occupied(belief.time)
    assert found[(near < 0.3) & (near > 0.0)].min() > 0.98
    far = (near < -0.6) & (near > -0.8)
    assert abs((logit(found[far]) - logit(p[far])).mean()) < 0.25


@pytest.mark.parametrize(("taken_in_a_row", "believed"), [(2, False), (16, True)])
def test_filling_a_nearly_empty_lot_takes_more_than_two_taken_slots(taken_in_a_row, believed):
    """Where an event would begin, some slots in a row are taken; otherwise the lot is as empty as forecast."""
    near = nearness(np.arange(200.0))
    before = SlotBelief.of_forecast(np.full(200, 0.2), np.zeros(200), (0.8, 0.0))
    far, beyond, rest = np.split(np.argsort(near), [80, 80 + taken_in_a_row])
    seen = np.concatenate([far, beyond])
    belief = before.update(seen, np.concatenate([np.arange(80) % 5 == 0, np.ones(taken_in_a_row, bool)]))
    day = DayBelief(before, near)
    day.update(belief.observations)
    found = day.p_occupied(belief.time)[rest]
    assert found.min() > 0.99 if believed else found.max() < 0.25


def test_a_full_kerb_is_no_full_district():
    """Twelve taken slots say less of the others if they are of one kerb, and as much if each is of its own."""
    near = nearness(np.arange(60.0))
    before = SlotBelief.of_forecast(np.full(60, 0.7), np.zeros(60), (0.5, 0.0))
    belief = before.update(np.arange(12), np.full(12, True))
    kerbs = {"one": np.repeat(np.arange(5), 12), "own": np.arange(60), "none": np.full(60, -1)}
    elsewhere = {}
    for name, facility in kerbs.items():
        day = DayBelief(before, near, evidence=independent_share(facility))
        day.update(belief.observations)
        elsewhere[name] = day.p_occupied(belief.time)[12:].mean()
        assert day.p_occupied(belief.time)[:12].min() == 1.0
    day = DayBelief(before, near)
    day.update(belief.observations)
    assert elsewhere["own"] == elsewhere["none"] == day.p_occupied(belief.time)[12:].mean()
    assert 0.7 < elsewhere["one"] < 0.7 + 0.6 * (elsewhere["own"] - 0.7)


def test_sensor_errors_and_repeated_observations_count_for_what_they_say():
    """Against Bayes' rule by enumeration of the states of three slots under each hypothesis."""
    p, near, belief = forecast_of(3, level=1.0)

    weight, p_if = day_belief._hypotheses(p, near, belief.day_error, EVENT)
    posterior, day = np.zeros((len(weight), 8)), DayBelief(belief, near)
    states = np.array(list(itertools.product((False, True), repeat=3)))
    for h in range(len(weight)):
        posterior[h] = weight[h] * np.prod(np.where(states, p_if[:, h], 1.0 - p_if[:, h]), axis=1)
    looks = [([0, 1], [True, True], 0.9, 0.2), ([0], [True], 0.7, 0.1), ([1], [False], 0.9, 0.2)]
    for slots, taken, hit, alarm in looks:
        belief = belief.decay(5.0).update(slots, taken, hit, alarm)
        day.update(belief.observations)
        for s, said in zip(slots, taken, strict=True):
            chance = np.where(states[:, s], hit, alarm)
            posterior *= chance if said else 1.0 - chance
    expected = posterior.sum(axis=0) @ states / posterior.sum()
    np.testing.assert_allclose(day.p_occupied(belief.time), expected, rtol=1e-9)


def test_seen_again_at_once_says_nothing_and_after_long_says_as_much_as_another_slot():
    p, near, before = forecast_of(40, decay_rate=1e-2)
    unseen = np.arange(20, 40)

    def moved(*gaps):
        belief, day = before, DayBelief(before, near)
        for gap in gaps:
            belief = belief.decay(gap).update(np.arange(20), np.ones(20, dtype=bool))
            day.update(belief.observations)
        return (logit(day.p_occupied(belief.time)[unseen]) - logit(p[unseen])).mean()

    once = moved(1.0)
    assert moved(1.0, 0.0) == pytest.approx(once, rel=1e-6)
    assert moved(1.0, 1.0) == pytest.approx(once, rel=0.05)
    assert moved(1.0, 1e5) > 1.2 * once


def test_another_part_of_the_lot_starts_with_what_is_known_of_the_day():
    _, near, whole = forecast_of(80)
    seen = whole.update(np.arange(30), np.ones(30, dtype=bool))
    first, second = np.arange(0, 50), np.arange(20, 80)
    at_once = DayBelief(whole, near, event=0.0)
    old, new = (DayBelief(whole.take(part), near[part], event=0.0) for part in (first, second))
    at_once.update(seen.observations)
    old.update(seen.take(first).observations)
    new.carry_over(old, np.arange(30), np.arange(20, 50))
    new.update(seen.take(second).observations)
    np.testing.assert_allclose(new.p_occupied(seen.time), at_once.p_occupied(seen.time)[second], rtol=1e-9)


def test_what_is_observed_last_holds_even_if_it_was_excluded():
    """A guidance system's word is final until its next one: what it withdraws is taken, not free."""
    _, near, before = forecast_of(10, decay_rate=0.0)
    day, slots = DayBelief(before, near), np.arange(10)
    for slot in (3, 7, 2):
        guided = before.decay(5.0 + slot).with_reservation((slots == slot).astype(np.int8))
        day.update(guided.observations)
        np.testing.assert_allclose(day.p_occupied(guided.time), slots != slot, atol=1e-9)
