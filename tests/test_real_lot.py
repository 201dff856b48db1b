"""The comparison on a real lot with real occupancy: Dragon Lake's map, CNRPark-EXT's log as the world."""

from pathlib import Path

import numpy as np
import pytest

from parkenv import OccupancyLog, RecordedOccupancy, make_scenario
from parkenv.lots import read_lot
from parkenv.studies.compare.cases import Case
from parkenv.studies.statistics import mean_interval

DATA = Path(__file__).parents[2] / "shared" / "data"
MAP, LOG = DATA / "dlp" / "parking_map.yml", DATA / "cnr_ext" / "occupancy_15_days.csv.gz"
needs_data = pytest.mark.skipif(
    not (MAP.exists() and LOG.exists()),
    reason="the Dragon Lake map and the CNRPark-EXT log, which their publishers provide, are not here",
)


@pytest.fixture(scope="module")
def scenario():
    lot = read_lot(MAP)
    return make_scenario(lot, occupancy=RecordedOccupancy(OccupancyLog.read(LOG), lot.walk_m()))


def totals(scenario, agent, episodes):
    return np.array([row["total_s"] for row in Case(scenario, agent).run(range(episodes))])


@pytest.mark.slow
@needs_data
def test_the_world_is_the_log_and_the_forecast_is_not(scenario):
    """Searches fall on recorded weekdays in the window, with the occupancy of the log."""
    rows = Case(scenario, "greedy-drive").run(range(40))
    assert {row["day"] for row in rows} <= set(scenario.occupancy.log.days)
    assert all(8 * 3600 <= row["arrival_s"] % 86400 < 13 * 3600 for row in rows)
    early = [row["occupancy"] for row in rows if row["arrival_s"] % 86400 < 9 * 3600]
    late = [row["occupancy"] for row in rows if row["arrival_s"] % 86400 > 11 * 3600]
    assert max(early) < 0.5 < 0.85 < min(late)


@needs_data
@pytest.mark.slow
def test_the_planner_beats_what_people_do_at_a_low_failure_cost_and_loses_its_lead_at_a_high_one(scenario):
    episodes = 200
    bold = totals(scenario.replace(failure_s=10.0), "mdp", episodes)
    careful = totals(scenario.replace(failure_s=90.0), "mdp", episodes)
    for strategy in ("greedy-goal", "greedy-drive", "first-free"):
        _, low, _ = mean_interval(totals(scenario, strategy, episodes) - bold)
        assert low > 0.0, f"{strategy} is not slower beyond doubt"
    _, low, _ = mean_interval(careful - bold)
    assert low > 0.0
