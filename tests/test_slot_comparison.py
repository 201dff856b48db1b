import json
from pathlib import Path

import pytest
from command_line import parkenv

from parkenv.forecast.slot_comparison import OURS

REAL_LOG = Path(__file__).parents[2] / "shared" / "data" / "cnr_ext" / "occupancy_15_days.csv.gz"


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
