"""The belief about slots: one law, in plain arithmetic, in the compiled environment, and in each agent's input."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from parkenv import InputError
from parkenv.belief.slot_belief import SlotBelief

CHANCES = st.floats(0.0, 1.0)


@given(p=CHANCES, rate=st.floats(0.0, 0.1), taken=st.booleans(), hit=CHANCES, false_alarm=CHANCES)
def test_an_observation_is_bayes_rule_and_decays_to_the_forecast(p, rate, taken, hit, false_alarm):
    belief = SlotBelief.of_forecast([p, p], [rate, rate]).decay(5.0)
    assert belief.p_occupied.tolist() == [p, p]
    after = belief.update([1], [taken], hit, false_alarm)
    if_taken, if_free = (hit, false_alarm) if taken else (1.0 - hit, 1.0 - false_alarm)
    evidence = if_taken * p + if_free * (1.0 - p)
    # An observation with prior probability 0 is believed.
    posterior = if_taken * p / evidence if evidence > 0.0 else float(taken)
    np.testing.assert_allclose(after.p_occupied, [p, posterior], atol=1e-12)
    assert after.age.tolist() == [np.inf, 0.0]
    later = after.decay(30.0).decay(70.0)
    np.testing.assert_allclose(later.p_occupied, [p, p + (posterior - p) * np.exp(-rate * 100.0)], atol=1e-12)
    assert later.age.tolist() == [np.inf, 100.0]
    # What was observed is not forgotten however far it has decayed, and the first belief is unchanged.
    assert later.observed.tolist() == [False, True]
    assert belief.observed.tolist() == [False, False]


def test_observed_slots_are_free_or_taken_even_where_the_forecast_was_certain():
    belief = SlotBelief.of_forecast([0.0, 0.0, 1.0, 1.0, 0.5, 0.5, 0.5], np.zeros(7))
    after = belief.update(range(6), [False, True, False, True, False, True])
    assert after.observed_free.tolist() == [True, False, True, False, True, False, False]
    assert after.observed_taken.tolist() == [False, True, False, True, False, True, False]


def test_parts_and_observations_keep_the_belief():
    before = SlotBelief.of_forecast([0.2, 0.5, 0.8], np.full(3, 1e-3), (0.5, 0.25)).decay(10.0)
    belief = before.update([2], [True]).decay(5.0)
    part = belief.take(np.array([2, 0]))
    assert part.day_error.tolist() == [0.5, 0.25]
    assert (part.age.tolist(), part.observed_taken.tolist()) == ([5.0, np.inf], [True, False])
    again = SlotBelief.of_observation({"time": np.array([0.0, 15.0]), **belief.to_observation()})
    np.testing.assert_allclose(again.p_occupied, belief.p_occupied, rtol=1e-6)
    assert again.age.tolist() == belief.age.tolist()
    assert again.day_error.tolist() == [0.5, 0.25]


def test_observations_of_other_environments_are_refused():
    with pytest.raises(InputError, match="has no 'p_occupied'; want one of parkenv/Search-v2, got vertex"):
        SlotBelief.of_observation({"vertex": 0})
