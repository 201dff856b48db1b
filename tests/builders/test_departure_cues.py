"""Cues of departures, in scenes of a lot that they were not fitted in."""

import departure_cues
import pytest

from parkenv.perception.departure_cues import log_likelihood_ratio


@pytest.mark.slow
def test_lit_lamps_are_seen_near_by_and_parked_cars_are_seldom_mistaken(monkeypatch):
    for name, value in (("WEATHERS", ("overcast", "dusk")), ("N_LEAVING", 20), ("N_ELSEWHERE", 15)):
        monkeypatch.setattr(departure_cues, name, value)
    rows = departure_cues.rows_of(("jam",), 7000)
    ratio, near = log_likelihood_ratio(rows.features), rows.distance < departure_cues.NEAR_M
    _, lit, _, precision = departure_cues.rates(rows.only(near), ratio[near])
    false_alarm = departure_cues.rates(rows, ratio)[2]
    assert lit > 0.15
    assert precision > 5.0 * departure_cues.SHARE
    assert false_alarm < 0.02
