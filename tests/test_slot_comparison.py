import json
from pathlib import Path

import numpy as np
import pytest
from command_line import parkenv
from test_slot_days import simulated

from parkenv.forecast.slot_comparison import OURS, compare_slot_days

REAL_LOG = Path(__file__).parents[2] / "shared" / "data" / "cnr_ext" / "occupancy_15_days.csv.gz"


@pytest.mark.slow
def test_ours_is_first_where_slots_have_habits_and_the_lot_drifts():
    weekdays, _ = simulated(20, 0.6, seed=5, drift=0.06)
    weekend, _ = simulated(5, 0.6, seed=6)
    first, done = int(weekdays.days.number[14]), []
    rows = compare_slot_days([weekdays, weekend], first, lambda: done.append(1))
    assert rows[0].model == OURS
    means = [row.scores.means() for row in rows]
    assert {len(row.days) for row in rows} == {6} == {len(done)} == {row["days"] for row in means}
    assert {row["car_parks"] for row in means} == {1}
    for row, theirs in zip(rows[1:], means[1:], strict=True):
        # The slots of this lot differ in one thing only, which suits gradient boosting.
        margin = 0.02 if row.model == "gradient-boosting" else 0.0
        assert means[0]["log_loss"] < (1 + margin) * theirs["log_loss"]
        assert means[0]["brier"] < (1 + margin) * theirs["brier"]
        assert means[0]["crps"] < 1.1 * theirs["crps"]
    assert means[0]["coverage_90"] >= 4 / 6
    numbers = [day.number for day in rows[0].days]
    assert numbers == sorted(numbers)
    ours = rows[0].scores
    for bands in (ours.coverage_by_band(), ours.coverage_by_band(observed=True)):
        assert sum(band["days"] for band in bands) == 6
    forecast, observed, weight = ours.reliability()
    assert weight.sum() == pytest.approx(sum(day.seen.sum() for day in rows[0].days))
    # Over all slots and half-hours, six days of one level each are not far from their forecast.
    assert abs(np.average(forecast - observed, weights=weight)) < 0.1
    mean, low, high = rows[1].scores.log_loss_beyond(ours, np.random.default_rng(0))
    assert low < mean < high
    assert mean == pytest.approx(means[1]["log_loss"] - means[0]["log_loss"])


@pytest.mark.slow  # fits five models to ten days of a real log
def test_the_real_logs_slots_are_forecast_better_than_by_simple_models(tmp_path):
    if not REAL_LOG.exists():
        pytest.skip("the CNRPark-EXT log is not in shared/data")
    done = parkenv("occupancy", "evaluate", REAL_LOG, "--from", "2015-11-25", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "summary.json").read_text())["rows"]
    assert rows[0]["model"] == OURS
    assert rows[0]["days"] == 10
    assert rows[0]["log_loss"] < 0.96 * min(row["log_loss"] for row in rows[1:])
    assert rows[0]["brier"] < min(row["brier"] for row in rows[1:])
    assert min(row["difference_ci95"][0] for row in rows[1:]) > 0
    assert all((tmp_path / f"{row['model']}.png").exists() for row in rows)
    done = parkenv("occupancy", "evaluate", REAL_LOG, "--from", "2017-01-01", "--out", tmp_path)
    assert done.returncode == 2
    assert "has no day from then on with one of its class before it" in done.stderr
