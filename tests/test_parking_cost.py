"""Parking costs count like the walk, for solvers, planners, bound and heuristics."""

import json
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from command_line import parkenv as command
from small_lots import features, lasting

from parkenv import OccupancyProcess, ParkingLot, simulate
from parkenv.lots import packaged_lot, write_lot
from parkenv.studies.episodes import EpisodeRunner
from parkenv.world.cost_terms import COST_FIELDS
from planners import make_agent
from planners.bounds.oracle import best_slot
from planners.routes import DriveRoutes

DEAR_S = 600.0


def empty_lot(lot):
    return lasting(lot, np.zeros(lot.n_slots, bool), said=-0.5)


def parked_at(name, scenario):
    row = EpisodeRunner(scenario, name, make_agent(name, scenario)).run(0).row
    return scenario.lot.slot_ids.index(row["slot"])


def priced(lot, cost_s):
    return ParkingLot(**{**features(lot), "slot_parking_cost_s": cost_s})


@pytest.mark.parametrize(
    "name",
    "mdp mdp-static mdp-tuned belief exact oracle greedy-goal greedy-total first-free".split(),
)
def test_agents_park_elsewhere_where_that_pays(name):
    lot = packaged_lot("mini")
    plain = empty_lot(lot)
    chosen = parked_at(name, plain)
    # The chosen half of the lot is expensive.
    walk_m = lot.walk_m()
    near = walk_m <= np.median(walk_m) if walk_m[chosen] <= np.median(walk_m) else walk_m > np.median(walk_m)
    dear = empty_lot(priced(lot, np.where(near, DEAR_S, 0.0)))
    assert not near[parked_at(name, dear)]
    # The same price for all slots changes nothing.
    alike = empty_lot(priced(lot, np.full(lot.n_slots, DEAR_S)))
    assert parked_at(name, alike) == chosen


def test_the_bound_counts_prices():
    rng = np.random.default_rng(4)
    lot = packaged_lot("campus")
    scenario = replace(
        empty_lot(priced(lot, rng.uniform(0.0, 120.0, lot.n_slots))),
        occupancy=OccupancyProcess.from_demand(np.full(lot.n_slots, 2.0), np.zeros(168), 600.0),
    )
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    for seed in range(5):
        env.reset(seed=seed)
        state = env.unwrapped.state
        routes = DriveRoutes(scenario)
        drive_s = routes.seconds_from(state.vertex)[: lot.n_slots]
        free_at = [float(state.world.next_free([s], state.time + d)[0]) for s, d in enumerate(drive_s)]
        total_s = np.array(free_at) - state.time + scenario.walk_s + scenario.lot.slot_parking_cost_s
        best = best_slot(scenario, routes, state.world, state.vertex, state.time)
        assert best.total_s == pytest.approx(total_s.min())
        # The oracle waits in whole steps.
        reached_s = simulate(env, make_agent("oracle", scenario), seed).info["total_s"]
        assert best.total_s - 1e-6 <= reached_s <= best.total_s + 2 * scenario.wait_s


def test_a_comparison_shows_what_parking_cost(tmp_path):
    lot = packaged_lot("mini")
    write_lot(priced(lot, np.where(np.arange(lot.n_slots) % 2 == 0, 30.0, 5.0)), tmp_path / "dear.geojson")
    done = command(
        "compare", "--lot", tmp_path / "dear.geojson", "--agents", "mdp,greedy-goal", "--episodes", 5,
        "--day-error", 0, "--occupancy-levels", "none", "--no-figures", "--out", tmp_path / "run",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "parking" in done.stdout
    for row in json.loads((tmp_path / "run" / "summary.json").read_text())["rows"]:
        assert 4.0 < row["parking_cost_s"] <= 30.0
        assert row["total_s"] == pytest.approx(sum(row[name] for name in COST_FIELDS))
