import numpy as np
import pytest
from scipy.special import expit

from parkenv.forecast.slot_days import Days, SlotDays, fit_slot_days

N_SLOTS, PERIODS = 80, 48
SHOWN = slice(14, 38)  # observed from 7:00 to 19:00
NOON = 24


def simulated(n_days, level_sd, seed=0, drift=0.0, start=0):
    """Return independent states of slots with habits, and their P(taken), (m, d, p)."""
    rng, number = np.random.default_rng(seed), start + np.arange(n_days) * 3
    level = level_sd * rng.normal(size=n_days) + drift * np.arange(n_days)
    habit = np.linspace(-1.5, 1.5, N_SLOTS)[:, None]
    profile = 2.5 * np.sin(np.linspace(0, np.pi, PERIODS)) - 0.5
    p = expit(habit[:, None] + level[:, None] + profile)
    seen = np.zeros(p.shape)
    seen[:, :, SHOWN] = 1.0
    return SlotDays(Days(number, number % 5), (rng.random(p.shape) < p).astype(float), seen), p


def next_day(days, after=3):
    number = days.number[-1:] + after
    return Days(number, number % 5)


def level_sd(fitted, days):
    return np.sqrt(fitted.forecast(next_day(days)).level_covariance[NOON, 0, 0])


@pytest.mark.parametrize("true_sd", [0.4, 1.0])
def test_level_and_habits_are_found(true_sd):
    data, _ = simulated(40, true_sd, seed=1)
    fitted = fit_slot_days(data)
    found = fitted.forecast(next_day(data.days))
    assert fitted.level_sd == pytest.approx(true_sd, rel=0.25)
    assert fitted.dispersion == pytest.approx(1.0, abs=0.3)
    expected = simulated(2000, true_sd, seed=2)[1].mean(axis=1)[:, SHOWN]
    assert np.abs(found.p_taken[0][:, SHOWN] - expected).mean() < 0.03
    # Before the first observed period and after the last one, the nearest one's forecast holds.
    assert np.array_equal(found.p_taken[0][:, 0], found.p_taken[0][:, SHOWN.start])
    assert np.array_equal(found.p_taken[0][:, -1], found.p_taken[0][:, SHOWN.stop - 1])


def test_few_days_make_a_wide_forecast_and_many_a_narrow_one():
    logs = [simulated(n, 0.3)[0] for n in (3, 10, 60)]
    widths = [level_sd(fit_slot_days(data), data.days) for data in logs]
    assert widths[0] > 1.3 * widths[1] > 1.3**2 * widths[2]
    assert widths[2] == pytest.approx(0.3, abs=0.1)


@pytest.mark.parametrize("n_days", [1, 2, 10])
def test_no_slot_is_surer_than_the_days_allow(n_days):
    """Slots that never changed: what n days show is a tenth of a day short of certain."""
    data, _ = simulated(n_days, 0.3)
    data.taken[: N_SLOTS // 2], data.taken[N_SLOTS // 2 :] = 1.0, 0.0
    p = fit_slot_days(data).forecast(next_day(data.days)).p_taken[0]
    least = 0.05 / (n_days + 0.1)
    assert least <= p.min() < p[N_SLOTS // 2 :].max() < 0.3
    assert 0.7 < p[: N_SLOTS // 2].min() < p.max() <= 1.0 - least


def test_recent_days_count_more_where_the_lot_drifts():
    data, p = simulated(40, 0.3, seed=3, drift=0.05)
    found = fit_slot_days(data).forecast(next_day(data.days)).p_taken[0][:, SHOWN].mean()
    now, ever = p[:, -5:, SHOWN].mean(), p[:, :, SHOWN].mean()
    assert abs(found - now) < 0.5 * abs(ever - now)


def test_days_far_ahead_share_their_error():
    data, _ = simulated(4, 0.5)
    ahead = data.days.number[-1] + np.array([3, 6, 9])
    covariance = fit_slot_days(data).forecast(Days(ahead, ahead % 5)).level_covariance[NOON]
    correlation = covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    assert np.all(np.linalg.eigvalsh(covariance) > 0)
    assert np.all((correlation[np.triu_indices(3, 1)] > 0.02) & (correlation[np.triu_indices(3, 1)] < 0.8))


@pytest.mark.parametrize("state", [0.0, 1.0])
def test_a_lot_that_never_changed_may_still_change(state):
    data, _ = simulated(3, 0.5)
    found = fit_slot_days(data._replace(taken=np.full(data.taken.shape, state))).forecast(next_day(data.days))
    p = found.p_taken[0]
    assert np.all((p > 0.0) & (p < 1.0))
    assert np.abs(p - state)[:, SHOWN].mean() < 0.1
