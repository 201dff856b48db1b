import json
from pathlib import Path

import pytest
from command_line import parkenv
from test_slot_days import simulated

from parkenv.forecast.slot_comparison import OURS, compare_slot_days

REAL_LOG = Path(__file__).parents[2] / "shared" / "data" / "cnr_ext" / "occupancy_15_days.csv.gz"


def test_ours_is_first_where_slots_have_habits_and_the_lot_drifts():
    weekdays, _ = simulated(20, 0.6, seed=5, drift=0.06)
    weekend, _ = simulated(5, 0.6, seed=6)
    first, done = int(weekdays.days.number[14]), []
    rows = compare_slot_days([weekdays, weekend], first, lambda: done.append(1))
    assert rows[0].model == OURS
    assert {row.days for row in rows} == {6} == {len(done)}
    for row in rows[1:]:
        # The slots of this lot differ in one thing only, which suits gradient boosting.
        margin = 0.02 if row.model == "gradient-boosting" else 0.0
        assert rows[0].log_loss < (1 + margin) * row.log_loss
        assert rows[0].brier < (1 + margin) * row.brier
        assert rows[0].crps < 1.1 * row.crps
    assert rows[0].coverage_90 >= 4 / 6


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
    done = parkenv("occupancy", "evaluate", REAL_LOG, "--from", "2017-01-01", "--out", tmp_path)
    assert done.returncode == 2
    assert "has no day from then on with one of its class before it" in done.stderr
