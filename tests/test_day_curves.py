"""Forecasts of daily curves: what they learn, what they do not know, how sure they are."""

from datetime import date, timedelta
from pathlib import Path

import numpy as np
import pytest
from scipy.special import expit

from parkenv.forecast.comparison import MODELS, compare, last_four_weekdays, last_week, with_past_errors
from parkenv.forecast.counts import Counts
from parkenv.forecast.day_curves import CurveSettings, fit_settings, forecast_days
from parkenv.forecast.day_forecast import DayForecast
from parkenv.forecast.scores import Scores, crps_of_equally_likely, mean_where

GERMAN = Path(__file__).parents[2] / "shared" / "data" / "german_car_parks" / "hourly_2023_2024.csv.gz"
HOLIDAY = (5, 1)
FIRST = date(2022, 12, 5)  # a Monday


def car_parks(n=6, days=140, seed=0, level_sd=0.6, places=300, sundays=-2.0, drift=0.0):
    """Car parks whose days have levels of their own; Sundays, and 1 May, are emptier. Also the levels, (n, days)."""
    rng = np.random.default_rng(seed)
    dates = tuple(FIRST + timedelta(d) for d in range(days))
    curve = -1.5 + 2.5 * np.exp(-(((np.arange(24) - 13) / 4.0) ** 2))
    free_day = np.array([d.weekday() == 6 or (d.month, d.day) == HOLIDAY for d in dates])
    levels = rng.normal(0.0, level_sd, (n, days)) + rng.normal(0.0, drift, (n, days)).cumsum(axis=1)
    z = rng.normal(0.0, 0.3, (n, 1, 1)) + curve + sundays * free_day[:, None] + levels[:, :, None]
    occupied = rng.binomial(places, expit(z + rng.normal(0.0, 0.1, z.shape))) / places
    names = tuple(f"p{i}" for i in range(n))
    return Counts(names, dates, np.full((n, days), float(places)), occupied, occupied, ({},) * n), levels


def with_values(counts, occupied):
    return Counts(counts.car_parks, counts.days, counts.capacity, occupied, occupied, counts.faults)


@pytest.fixture(scope="module")
def trained():
    counts, levels = car_parks()
    return counts, levels, forecast_days(counts, 0, settings=CurveSettings())


@pytest.mark.slow
def test_nothing_of_a_day_or_later_ones_reaches_its_forecast(trained):
    counts, _, before = trained
    changed = counts.occupied.copy()
    changed[:, 120:] = 1.0 - changed[:, 120:]
    changed = with_values(counts, changed)
    ours = forecast_days(changed, 0, settings=CurveSettings())
    np.testing.assert_array_equal(ours.mean[:, :121], before.mean[:, :121])
    np.testing.assert_array_equal(ours.covariance[:, :121], before.covariance[:, :121])
    assert (ours.mean[:, 121] != before.mean[:, 121]).all()
    few, _ = car_parks(2, 60)
    changed = few.occupied.copy()
    changed[:, 50:] = 1.0 - changed[:, 50:]
    two = few, with_values(few, changed)
    assert fit_settings(few, 50) == fit_settings(two[1], 50) != CurveSettings()
    old, new = ([m.forecast for m in compare(c, 40, CurveSettings())] for c in two)
    for a, b in zip(old, new, strict=True):
        np.testing.assert_array_equal(a.occupancy[:, :11], b.occupancy[:, :11])
        np.testing.assert_array_equal(a.covariance[:, :11], b.covariance[:, :11])


def test_past_learns_nothing_after_its_date_and_says_so():
    counts, _ = car_parks()
    past, rolling = (forecast_days(counts, 100, mode, CurveSettings()) for mode in ("past", "rolling"))
    np.testing.assert_array_equal(past.mean[:, 0], rolling.mean[:, 0])
    without = with_values(counts, np.where(np.arange(140)[:, None] >= 100, np.nan, counts.occupied))
    np.testing.assert_array_equal(past.mean, forecast_days(without, 100, settings=CurveSettings()).mean)
    weekday = counts.weekday[100:] < 5
    assert (past.level_sd[:, weekday][:, 20:] > rolling.level_sd[:, weekday][:, 20:]).mean() > 0.9


def test_few_days_make_a_wide_forecast_and_many_a_narrow_one(trained):
    """In the end, the spread is that of the days themselves: 0.6."""
    forecast = trained[2]
    weekdays = [d for d in range(140) if trained[0].weekday[d] < 5]
    level = np.median(forecast.level_sd, axis=0)
    assert level[0] > 1.2 > 0.9 > level[weekdays[-10:]].mean()
    assert level[weekdays[-20:]].mean() == pytest.approx(0.6, rel=0.35)


def test_intervals_hold_nine_days_of_ten(trained):
    counts, _, forecast = trained
    late = Scores.of(forecast.from_day(40), counts)
    assert mean_where(late.day_covered) == pytest.approx(0.9, abs=0.05)
    assert mean_where(late.hour_covered) == pytest.approx(0.9, abs=0.06)


@pytest.mark.slow
def test_the_settings_follow_the_data():
    noisy, calm = (fit_settings(car_parks(4, 100, level_sd=sd)[0], 100) for sd in (1.0, 0.15))
    assert noisy.day_level_spread + noisy.level_drift > 1.5 * (calm.day_level_spread + calm.level_drift)
    assert fit_settings(car_parks(4, 10)[0], 10) == CurveSettings()


def test_a_holiday_is_known_from_the_year_before():
    counts, _ = car_parks(days=525, level_sd=0.3)
    forecast = forecast_days(counts, 0, settings=CurveSettings())
    first, second = counts.day_index(date(2023, *HOLIDAY)), counts.day_index(date(2024, *HOLIDAY))
    noon = forecast.mean[:, :, 12]
    assert (noon[:, first] > noon[:, first - 7] - 0.8).all()  # a Monday like others, as far as is known
    assert (noon[:, second] < noon[:, second - 7] - 0.8).all()
    assert np.abs(noon[:, second + 7] - noon[:, second - 7]).max() < 0.6


def test_the_day_so_far_tells_of_its_rest(trained):
    """Days differ in their level alone here, so that the morning says nearly all."""
    counts, _, forecast = trained
    days, late = slice(60, 140), forecast.from_day(60)
    given, observed = late.given(counts, 9), counts.occupied[:, days]
    np.testing.assert_allclose(given.occupancy[:, :, :9], observed[:, :, :9], atol=0.01)
    before, after = (np.abs(f.occupancy - observed)[:, :, 9:].mean() for f in (late, given))
    assert after < 0.5 * before
    assert (given.sd[:, :, 9:] < 0.85 * late.sd[:, :, 9:]).all()
    np.testing.assert_allclose(late.given(counts, 0).mean, late.mean)


def test_gaps_and_car_parks_without_readings_do_no_harm():
    counts, _ = car_parks(4, 90)
    occupied = counts.occupied.copy()
    occupied[0] = np.nan
    occupied[1, :60] = np.nan
    occupied[2, 20:80] = np.nan
    occupied[3, :, ::2] = np.nan
    holey = with_values(counts, occupied)
    for compared in compare(holey, 45, fit_settings(holey, 45)):
        assert np.isfinite(compared.forecast.occupancy).all(), compared.model
        assert np.isfinite(compared.forecast.sd).all(), compared.model
        assert np.isfinite(mean_where(compared.scores.log_loss)), compared.model


def test_one_full_or_empty_car_park_is_no_trouble():
    counts, _ = car_parks(2, 60)
    for value in (0.0, 1.0):
        forecast = forecast_days(with_values(counts, np.full_like(counts.occupied, value)), 30)
        assert np.abs(forecast.occupancy - value).max() < 0.05


def test_baselines_are_what_their_names_say():
    counts, _ = car_parks(2, 60)
    y = counts.occupied
    np.testing.assert_array_equal(last_week(counts)[:, 30], y[:, 23])
    np.testing.assert_allclose(last_four_weekdays(counts)[:, 30], y[:, [2, 9, 16, 23]].mean(axis=1))
    np.testing.assert_allclose(last_four_weekdays(counts)[:, 10], y[:, 3])
    forecast = with_past_errors(last_week(counts), counts, 30)
    np.testing.assert_array_equal(forecast.occupancy[:, 0], y[:, 23])


@pytest.mark.slow
def test_our_model_is_ahead_of_every_baseline():
    counts, _ = car_parks(6, 160, level_sd=0.3, drift=0.1)
    compared = list(compare(counts, 110, fit_settings(counts, 110)))
    assert [c.model for c in compared] == list(MODELS)
    ours, *others = (c.scores.log_loss_beyond(compared[0].scores, np.random.default_rng(0)) for c in compared)
    assert ours == (0.0, 0.0, 0.0)
    assert all(low > 0 for _, low, _ in others)
    assert all(c.scores.crps.mean() > compared[0].scores.crps.mean() for c in compared[1:])


def test_the_score_of_a_sample_is_that_of_its_definition():
    rng = np.random.default_rng(1)
    values, y = np.sort(rng.normal(size=(9, 5)), axis=0), rng.normal(size=5)
    grid = np.linspace(-8, 8, 40_001)
    below = (values[:, :, None] <= grid).mean(axis=0)
    expected = ((below - (y[:, None] <= grid)) ** 2).sum(axis=1) * (grid[1] - grid[0])
    np.testing.assert_allclose(crps_of_equally_likely(values, y), expected, atol=1e-3)


def test_reliability_and_bands_of_a_known_forecast():
    counts, _ = car_parks(2, 30)
    covariance = np.tile(np.eye(24, dtype=np.float32), (2, 30, 1, 1))
    half = DayForecast(0, np.zeros((2, 30, 24)), covariance, np.full((2, 30, 24), 0.5))
    scores = Scores.of(half, with_values(counts, np.full((2, 30, 24), 0.3)))
    np.testing.assert_allclose(scores.reliability(), [[0.5], [0.3], [2 * 30 * 24.0]])
    assert mean_where(scores.log_loss) == pytest.approx(-np.log(0.5))
    assert mean_where(scores.brier) == pytest.approx(0.04)
    bands = scores.coverage_by_band()
    assert [band["days"] for band in bands] == [0, 0, 60, 0, 0]
    assert bands[2]["coverage_90"] == 0.0  # 24 independent hours of odds 1 are not all at 0.3
    assert [band["days"] for band in scores.coverage_by_band(observed=True)] == [0, 60, 0, 0, 0]


@pytest.mark.slow  # ten months of every sixth German car park
def test_forecasts_of_german_car_parks():
    if not GERMAN.exists():
        pytest.skip("the German car parks are not in shared/data")
    counts = Counts.read(GERMAN, timezone="Europe/Berlin")
    year, first = counts.day_index(date(2024, 1, 1)), 150
    counts = counts.part(range(0, len(counts.car_parks), 6), year - first, year + 150)
    compared = list(compare(counts, first, fit_settings(counts, first)))
    losses = [mean_where(c.scores.log_loss) for c in compared]
    assert losses[0] < min(losses[1:])
    ours = compared[0].scores
    assert 0.87 < mean_where(ours.day_covered) < 0.93
    for band in ours.coverage_by_band():
        assert band["days"] < 30 or 0.8 < band["coverage_90"] < 0.97
