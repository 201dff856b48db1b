"""Days that differ from their forecast: the forecast is the mean over days, and the error has the stated size."""

import dataclasses
import json
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import RegularGridInterpolator
from scipy.special import expit
from scipy.stats import norm

from parkenv import InputError, OccupancyProcess
from parkenv.compiled.keyed_random import world_key
from parkenv.world.occupancy.centred_logits import centred_logits, centring_table
from parkenv.world.occupancy.day_error import DayError, nearness
from parkenv.world.occupancy.process import Arrival


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


def test_a_process_with_a_slope_needs_the_nearness_of_its_slots():
    process = OccupancyProcess.from_demand(np.zeros(3), np.zeros(168))
    with pytest.raises(InputError, match="nearness is None, want numbers"):
        process.with_day_error(DayError(0.0, 0.5))
    with pytest.raises(InputError, match="nearness"):
        dataclasses.replace(process, nearness=[0.0, 1.0, 2.0])


@pytest.mark.parametrize(("sizes", "most"), [((0.8,), 1e-4), ((0.5, 1.0), 5e-3), ((2.0,), 2e-2)])
def test_the_table_of_compiled_code_interpolates_the_centring(sizes, most):
    day_error = DayError(*sizes)
    p, near = np.meshgrid(np.linspace(0.001, 0.999, 997), np.linspace(0.0, 1.0, 7), indexing="ij")
    table = centring_table(day_error)
    rows = np.linspace(0.0, 1.0, len(table)) if len(table) > 1 else [0.0, 1.0]
    grid = np.broadcast_to(table, (len(rows), table.shape[1]))
    at = RegularGridInterpolator((rows, np.linspace(0.0, 1.0, table.shape[1])), grid)
    factor = at(np.stack([near**2, p], axis=-1))
    exact = centred_logits(p, day_error.deviations(near)) - np.log(p / (1.0 - p))
    np.testing.assert_allclose(np.log(factor), exact, atol=most)


@pytest.mark.parametrize("hours", [0.4, 3.5])
@pytest.mark.parametrize("day_error", [DayError(0.8), DayError(0.4, 0.7)])
def test_the_forecast_is_the_mean_over_days_and_days_differ_by_the_stated_error(day_error, hours):
    """At the arrival, in the morning's rise, and hours later, when every slot has changed many times."""
    n_days, copies = 500, 300
    attraction = np.repeat([-2.0, 0.0, 2.0], copies)
    demand = np.tile(np.linspace(-2.0, 1.0, 24), 7)
    near = np.repeat([-1.0, 0.2, 1.0], copies)
    process = OccupancyProcess.from_demand(attraction, demand, 1800.0)
    process = dataclasses.replace(process, day_error=day_error, nearness=near)
    arrival = Arrival(8.4 * 3600.0)
    time = arrival.time + (0.0 if hours < 1.0 else hours * 3600.0)
    slots = np.arange(3 * copies)
    worlds = (process.world(world_key(1, day), arrival) for day in range(n_days))
    states = [world.occupied(slots, time).reshape(3, copies) for world in worlds]
    taken = np.stack(states).mean(axis=2)
    forecast = process.marginal(time)[::copies]
    error = taken.std(axis=0) / np.sqrt(n_days)
    # Hours later, occupancy follows the rates with a delay, which days change.
    delay = 0.004 if hours > 1.0 else 0.0
    assert (np.abs(taken.mean(axis=0) - forecast) < 3.5 * error + delay).all()
    if hours < 1.0:
        p = np.clip(taken, 0.5 / copies, 1.0 - 0.5 / copies)
        logits = np.log(p / (1.0 - p))
        sampling = (1.0 / (copies * p * (1.0 - p))).mean(axis=0)
        spread = np.sqrt(logits.var(axis=0) - sampling)
        np.testing.assert_allclose(spread, day_error.deviations([-1.0, 0.2, 1.0]), rtol=0.16)


def test_a_process_keeps_its_day_error_in_files_parts_and_other_lots(tmp_path):
    process = OccupancyProcess.from_demand(np.linspace(-1.0, 2.0, 5), np.zeros(168))
    days = process.with_day_error(DayError(0.8, 0.3), [30.0, 10.0, 20.0, 40.0, 50.0])
    assert days.nearness.tolist() == [0.0, 1.0, 0.5, -0.5, -1.0]
    days.to_file(tmp_path / "days.json")
    again = OccupancyProcess.from_file(tmp_path / "days.json")
    mapped = days.mapped_to_lot(np.arange(8.0))
    copy = pickle.loads(pickle.dumps(days))
    others = [again, days.take([3, 1]), mapped, days.at_mean_occupancy(0.4, 0.0), copy]
    assert {other.day_error for other in others} == {DayError(0.8, 0.3)}
    assert [other.nearness.tolist() for other in others[:2]] == [days.nearness.tolist(), [-0.5, 1.0]]
    assert mapped.nearness.tolist() == nearness(np.arange(8.0)).tolist()
    arrival = Arrival(9 * 3600.0)
    assert days.forecast(arrival).day_error == DayError(0.8, 0.3)
    # The same forecast, and in the same world other slots taken.
    np.testing.assert_array_equal(days.forecast(arrival).p_occupied, process.forecast(arrival).p_occupied)
    key, slots = world_key(0, 0), np.arange(5)
    free = [p.world(key, arrival).next_free(slots, arrival.time).tolist() for p in (days, again)]
    assert free[0] == free[1]
    # A file of rates alone.
    content = json.loads((tmp_path / "days.json").read_text())
    del content["day_error"], content["nearness"]
    (tmp_path / "rates.json").write_text(json.dumps(content))
    assert not OccupancyProcess.from_file(tmp_path / "rates.json").day_error
