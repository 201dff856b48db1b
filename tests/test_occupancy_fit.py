from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import check_grad
from test_occupancy import constant_process

from parkenv.compiled.keyed_random import world_key
from parkenv.errors import InputError
from parkenv.world.occupancy.day_error import DayError
from parkenv.world.occupancy.fit import (
    PRIOR_LEVEL,
    Intervals,
    fit_constant_rates,
    fit_day_error,
    fit_process,
    log_likelihood,
)
from parkenv.world.occupancy.log import OccupancyLog, weekday_of
from parkenv.world.occupancy.process import Arrival, OccupancyProcess
from parkenv.world.week import DAY_S, HOUR_S

REAL_LOG = Path(__file__).parents[2] / "shared" / "data" / "cnr_ext" / "occupancy_15_days.csv.gz"
COLUMNS = ("slot", "day", "second", "occupied")
FIRST_MONDAY = np.datetime64("2024-01-01")


def simulated_log(process, n_weeks, every_s, start_h=7, end_h=19, seed=0):
    """Log of a camera that observes all slots at the same times every day."""
    n, world = process.n_slots, process.world(world_key(seed, 0), Arrival(0.0))
    seconds = np.arange(start_h * HOUR_S, end_h * HOUR_S, every_s)
    times = (np.arange(7 * n_weeks)[:, None] * DAY_S + seconds).ravel()
    states = np.array([world.occupied(np.arange(n), time) for time in times])
    return OccupancyLog(
        tuple(f"s{i}" for i in range(n)),
        tuple(str(FIRST_MONDAY + i) for i in range(7 * n_weeks)),
        np.tile(np.arange(n), times.size),
        np.repeat((times // DAY_S).astype(int), n),
        np.repeat(times % DAY_S, n),
        states.ravel(),
    )


@pytest.mark.parametrize("every_s", [300.0, 1800.0])
def test_constant_rates_are_recovered_however_coarse_the_looks(every_s):
    arrival, departure = 1 / 1500, 1 / 3000
    looks = simulated_log(constant_process(60, arrival, departure), 2, every_s).intervals()
    fitted = fit_constant_rates(looks.end - looks.start, looks.before, looks.after)
    assert fitted == pytest.approx((arrival, departure), rel=0.06)


def test_constant_rates_solve_the_closed_form_for_equal_gaps():
    # With one gap the fit is saturated: both transition probabilities are matched exactly.
    start, end = np.repeat([0, 0, 1, 1], [70, 30, 40, 60]), np.repeat([0, 1, 0, 1], [70, 30, 40, 60])
    arrival, departure = fit_constant_rates(np.full(200, 600.0), start, end)
    total = -np.log(1 - 0.3 - 0.4) / 600
    assert arrival == pytest.approx(total * 3 / 7, rel=1e-4)
    assert departure == pytest.approx(total * 4 / 7, rel=1e-4)


def random_intervals(k, n):
    rng = np.random.default_rng(3)
    start = rng.uniform(0, 20, k) * HOUR_S
    end = start + rng.uniform(60, 3.5 * HOUR_S, k)
    theta = np.concatenate([rng.normal(-8.5, 1, 96), rng.normal(0, 1, 2 * n)])
    states = rng.random((2, k)) < 0.5
    return theta, Intervals(rng.integers(0, n, k), 24 * rng.integers(0, 2, k), start, end, *states)


def test_the_gradient_agrees_with_finite_differences():
    theta, data = random_intervals(200, 4)
    _, gradient = log_likelihood(theta, data)
    error = check_grad(lambda t: log_likelihood(t, data)[0], lambda t: log_likelihood(t, data)[1], theta)
    assert error < 1e-5 * np.linalg.norm(gradient)


def test_intervals_are_split_exactly_at_full_hours():
    # The forward equation, integrated in small steps, gives the same likelihood.
    theta, intervals = random_intervals(5, 2)
    slot, first_bin, start, end, before, after = intervals
    rates, value = np.exp(theta), 0.0
    for k in range(5):
        p, steps = float(before[k]), 40_000
        dt = (end[k] - start[k]) / steps
        bins = first_bin[k] + ((start[k] + (np.arange(steps) + 0.5) * dt) // HOUR_S).astype(int)
        arrival = rates[bins] * rates[96 + slot[k]]
        departure = rates[48 + bins] * rates[98 + slot[k]]
        for a, d in zip(arrival, departure, strict=True):
            p += (a * (1 - p) - d * p) * dt
        value += np.log(p if after[k] else 1 - p)
    assert log_likelihood(theta, intervals)[0] == pytest.approx(value, abs=1e-3)


@pytest.fixture(scope="module")
def hourly():
    """A process with a morning rush, quiet weekends and uneven slots; its fit from observations every half hour."""
    rng = np.random.default_rng(5)
    weekday = 1e-4 * np.exp(2 * np.exp(-(((np.arange(24) - 9) / 2) ** 2)))
    profile = np.concatenate([np.tile(weekday, 5), np.tile(0.3 * weekday, 2)])
    factors = np.exp(rng.normal(0, 0.7, (2, 40)))
    factors /= np.exp(np.log(factors).mean(axis=1, keepdims=True))
    truth = OccupancyProcess(factors[0], profile, factors[1], np.full(168, 1.5e-4))
    return truth, fit_process(simulated_log(truth, 12, 1800.0))


def test_profiles_and_factors_are_recovered(hourly):
    """Within 0.6, twice the largest standard error of a logarithm; the hours of the day that were observed."""
    truth, fit = hourly
    seen = np.tile((np.arange(24) >= 7) & (np.arange(24) < 19), 7)
    for part, which in (("profile", seen), ("factor", np.ones(40, bool))):
        for name in (f"arrival_{part}", f"departure_{part}"):
            off = (np.log(getattr(fit.process, name)) - np.log(getattr(truth, name)))[which]
            assert np.abs(off).max() < 1.0
            assert np.sqrt(np.mean(off**2)) < 0.3


def test_the_fitted_process_forecasts_the_morning_although_nights_were_not_seen(hourly):
    truth, fit = hourly
    for day in (2, 5):
        time = day * DAY_S + 7.1 * HOUR_S
        assert fit.process.marginal(time).mean() == pytest.approx(truth.marginal(time).mean(), abs=0.04)


def test_unobserved_hours_take_the_nearest_and_an_unobserved_class_the_other():
    log = simulated_log(constant_process(20, 2e-4, 2e-4), 1, 600.0)
    seen = (log.day < 5) & ((log.second < 9.9 * HOUR_S) | (log.second >= 13 * HOUR_S))
    fit = fit_process(replace(log, **{name: getattr(log, name)[seen] for name in COLUMNS}))
    profile = fit.process.arrival_profile
    # The gap from 9:50 to 13:00 is too long to count.
    assert profile[10] == profile[11] == profile[9]
    assert profile[12] == profile[13]
    assert np.array_equal(profile[:24], profile[-24:])


def test_a_slot_that_never_changed_gets_a_finite_rate():
    log = simulated_log(constant_process(10, 2e-4, 2e-4), 1, 600.0)
    process = fit_process(replace(log, occupied=np.where(log.slot == 3, True, log.occupied))).process
    assert 1e-4 < process.departure_factor[3] < 0.2


def test_nothing_to_fit_is_refused():
    log = OccupancyLog(("a",), ("2024-01-01",), [0, 0], [0, 0], [0.0, 9000.0], [0, 1])
    with pytest.raises(InputError, match="no two observations of a slot on one day within 7200 s"):
        fit_process(log)
    with pytest.raises(InputError, match=r"prior_sd is 0\.0"):
        fit_process(log, prior_sd=0.0)


def seen_in_worlds(log, process, seed):
    """States of a process at the times and slots of a log's observations, a world for every day, (k,) bool."""
    states = np.empty(log.slot.size, bool)
    for day, name in enumerate(log.days):
        of_day, midnight = np.flatnonzero(log.day == day), weekday_of(name) * DAY_S
        world = process.world(world_key(seed, day), Arrival(midnight + log.second[of_day].min()))
        for second in np.unique(log.second[of_day]):
            these = of_day[log.second[of_day] == second]
            states[these] = world.occupied(log.slot[these], midnight + second)
    return states


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_the_day_error_of_many_days_is_recovered(level):
    rng = np.random.default_rng(0)
    n, weeks = 60, 15
    demand = np.tile(np.linspace(-1.0, 1.0, 24), 7)
    usual = OccupancyProcess.from_demand(rng.normal(0.5, 1.0, n), demand, 5400.0)
    looks = simulated_log(usual, weeks, 3600.0)
    log = replace(looks, occupied=seen_in_worlds(looks, usual.with_day_error(DayError(level)), seed=1))
    fitted = fit_day_error(log, usual)
    # The prior counts as much as 5.7 of the 105 days.
    assert fitted.level == pytest.approx(np.hypot(level, PRIOR_LEVEL * 0.23), rel=0.12)
    assert fitted.slope == 0.0


def days_of(log, days):
    chosen = np.isin(log.day, days)
    columns = {name: getattr(log, name)[chosen] for name in COLUMNS}
    columns["day"] = np.searchsorted(days, columns["day"])
    return replace(log, days=tuple(log.days[day] for day in days), **columns)


def summary(log):
    """Mean occupancy, its standard deviation between days, and changes a slot and hour."""
    each = np.array([log.occupied[log.day == day].mean() for day in range(len(log.days))])
    looks = log.intervals()
    changes = (looks.before != looks.after).sum() / (looks.end - looks.start).sum() * HOUR_S
    return np.array([log.occupied.mean(), each.std(ddof=1), changes])


@pytest.mark.slow
def test_worlds_fitted_to_the_first_days_of_the_real_log_are_like_its_later_days():
    """Weekdays, in order of time: the fit has seen none of the days that its worlds are compared with."""
    if not REAL_LOG.exists():
        pytest.skip("the CNRPark-EXT log is not in shared/data")
    log = OccupancyLog.read(REAL_LOG)
    process = fit_process(days_of(log, np.arange(8))).process
    later = days_of(log, 8 + np.flatnonzero(~log.weekend[8:]))
    worlds = [summary(replace(later, occupied=seen_in_worlds(later, process, seed))) for seed in range(20)]
    mean, spread, changes = np.mean(worlds, axis=0)
    real_mean, real_spread, real_changes = summary(later)
    assert abs(mean - real_mean) < 0.03
    assert spread == pytest.approx(real_spread, rel=0.2)
    assert changes == pytest.approx(real_changes, rel=0.1)
