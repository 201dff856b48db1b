"""Days that differ from their forecast: the forecast is the mean over days, and the error has the stated size."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import expit
from scipy.stats import norm

from parkenv import InputError
from parkenv.world.day_error import DayError, centred_logits, nearness


@given(p=st.floats(1e-6, 1.0 - 1e-6), deviation=st.floats(0.0, 3.0))
def test_the_mean_over_days_of_a_centred_logit_is_the_probability(p, deviation):
    centre = float(centred_logits(p, deviation))
    mean, _ = quad(lambda z: expit(centre + deviation * z) * norm.pdf(z), -9.0, 9.0, points=[0.0], limit=200)
    assert mean == pytest.approx(p, rel=1e-6, abs=1e-9)
    # A day's error pulls probabilities to a half, so the centre is farther from it.
    assert abs(centre) >= abs(np.log(p / (1.0 - p))) - 1e-9
    assert float(centred_logits(1.0 - p, deviation)) == pytest.approx(-centre, abs=1e-6)


def test_certain_forecasts_stay_certain_and_shapes_broadcast():
    assert centred_logits([0.0, 1.0], 0.8).tolist() == [-np.inf, np.inf]
    assert centred_logits(np.full((3, 1), 0.5), np.ones(2)).shape == (3, 2)


def test_nearness_falls_by_rank_from_one_to_minus_one():
    assert nearness([30.0, 10.0, 20.0, 40.0, 50.0]).tolist() == [0.0, 1.0, 0.5, -0.5, -1.0]
    assert nearness([7.0]).tolist() == [1.0]


@pytest.mark.parametrize("value", [-0.1, 5.1, float("nan"), "0.8", None, True])
def test_sizes_out_of_range_are_refused(value):
    with pytest.raises(InputError, match=r"day_error.slope is .* want a number of logits from 0 to 5"):
        DayError(0.8, value)
