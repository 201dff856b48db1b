"""The week of a lot alone, and how it is condensed from counts of car parks."""

from datetime import date, timedelta
from pathlib import Path

import numpy as np
import pytest
from scipy.special import expit, logit

from parkenv.forecast.counts import Counts
from parkenv.forecast.typical_week_fit import LEVEL_SHARES, fit_typical_week
from parkenv.lots import grid_lot, packaged_lot
from parkenv.scenarios.build import make_scenario
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.world.occupancy.real_week_figures import DAY_ERROR, LEVELS, OCCUPIED
from parkenv.world.occupancy.typical_week import real_week_occupancy

GERMAN = Path(__file__).parents[2] / "shared" / "data" / "german_car_parks" / "hourly_2023_2024.csv.gz"


@pytest.mark.parametrize("lot", [packaged_lot("mini"), packaged_lot("street"), grid_lot(4, 30)])
@pytest.mark.parametrize("options", [{}, {"fuller_than": 0.3, "mean_stay_s": 3600.0, "pull": 0.0}])
def test_the_mean_over_the_slots_is_as_counted_at_full_hours(lot, options):
    process = real_week_occupancy(lot, **options)
    level = np.interp(options.get("fuller_than", 0.9), LEVEL_SHARES, LEVELS)
    expected = expit(logit(OCCUPIED / 100.0) + level)
    means = [process.marginal(3600.0 * (hour + 1)).mean() for hour in range(168)]
    np.testing.assert_allclose(means, expected, atol=1e-4)


def test_cars_that_stay_long_leave_later_than_the_counts_fall():
    found = real_week_occupancy(packaged_lot("campus"), mean_stay_s=86_400.0)
    evening = found.marginal(22 * 3600.0).mean()
    assert evening > expit(logit(0.27) + 1.01) + 0.02
    assert found.arrival_profile[20] < 1e-8


def test_a_scenario_file_says_how_full(tmp_path):
    file = tmp_path / "half.toml"
    file.write_text('lot = "mini"\n[occupancy]\nreal_week = { fuller_than = 0.5 }\nday_error = 0.0\n')
    made, noon = make_scenario(file), 24 * 3600.0 + 12 * 3600.0
    assert made.occupancy.marginal(noon).mean() == pytest.approx(0.64, abs=1e-4)
    spec = ScenarioSpec.parse({"lot": "mini", "occupancy": "real-week"}, "test")
    assert spec.occupancy.real_week is not None


def test_slots_spread_as_in_the_recorded_log():
    for lot in (packaged_lot("campus"), grid_lot(2, 60)):
        attraction = np.log(real_week_occupancy(lot).arrival_factor)
        assert attraction.std() == pytest.approx(1.18, abs=0.05)


def test_the_fit_finds_the_week_the_levels_and_the_days():
    rng = np.random.default_rng(0)
    days = tuple(date(2024, 1, 1) + timedelta(i) for i in range(210))
    week, level = logit(OCCUPIED / 100.0).reshape(7, 24), np.linspace(-1.0, 1.0, 9)
    shift = rng.normal(0.0, 0.5, (9, len(days)))
    by_day = week[[day.weekday() for day in days]]
    occupied = expit(by_day + level[:, None, None] + shift[:, :, None])
    occupied[:, :, 3] = np.nan  # closed
    occupied[0, :50] = np.nan
    names = tuple(f"park {i}" for i in range(9))
    counts = Counts(names, days, np.full((9, len(days)), 100.0), occupied, occupied, ({},) * 9)
    fitted = fit_typical_week(counts)
    assert fitted is not None
    assert np.isnan(fitted.occupied[:, 3]).all()
    open_hours = np.delete(np.arange(24), 3)
    apart = logit(fitted.occupied[:, open_hours]) - week[:, open_hours]
    assert np.abs(apart - np.median(apart)).max() < 0.25
    np.testing.assert_allclose(fitted.levels[[0, 3, -1]], [-1.0, 0.0, 1.0], atol=0.2)
    np.testing.assert_allclose(fitted.day_errors, 0.5, atol=0.08)


@pytest.mark.slow
@pytest.mark.skipif(not GERMAN.exists(), reason="the counts of German car parks are not here")
def test_the_table_is_that_of_the_counts():
    fitted = fit_typical_week(Counts.read(GERMAN, timezone="Europe/Berlin"))
    assert fitted is not None
    np.testing.assert_allclose(100.0 * fitted.occupied.ravel(), OCCUPIED, atol=0.51)
    np.testing.assert_allclose(fitted.levels, LEVELS, atol=0.006)
    assert np.nanmedian(fitted.day_errors) == pytest.approx(DAY_ERROR, abs=0.05)
