"""`benchmarks/run.py`: its rows, and that the peers do the same job."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import env, fleet, planning, sensors
from benchmarks import sumo_days as sumo
from parkenv.lots import grid_lot
from sim_sensors.laser.scanner import LaserScanner

PROGRAM = Path(__file__).parents[1] / "benchmarks" / "run.py"
KEYS = ["part", "case", "value", "unit", "peer", "peer_value", "ratio"]


def run(*words):
    return subprocess.run([sys.executable, PROGRAM, *map(str, words)], capture_output=True, text=True)


def test_a_part_writes_its_rows(tmp_path):
    done = run("drive", "--seconds", 0.01, "--out", tmp_path / "b")
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "b" / "summary.json").read_text())["rows"]
    assert all(list(row) == KEYS for row in rows)
    assert {row["unit"] for row in rows} == {"physics steps/s", "ms"}
    assert all(row["value"] > 0 for row in rows if "not installed" not in row["case"])
    assert all(row["case"] in done.stdout for row in rows)


def test_the_help_page_names_the_parts_and_an_unknown_one_is_refused():
    assert "pomdp" in run("--help").stdout
    refused = run("engine")
    assert (refused.returncode, "'engine'" in refused.stderr) == (2, True)


def rows_of(part):
    if part == "sensors":
        rows = sensors.laser_rows(seconds=0.0) + sensors.camera_rows(seconds=0.0)
        return rows + sensors.search_rows(seconds=0.0, scenario="mini")
    if part == "planning":
        return planning.planning_rows(seconds=0.01, largest=2_000)
    if part == "fleet":
        return fleet.fleet_rows(seconds=0.0, worlds=2, large=400, day_cars=20, growth=(5,))
    return env.env_rows(seconds=0.0, batch=4, large=300, places=3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "parts", "missing"),
    [
        ("sensors", {"laser", "camera", "environment"}, 0),
        ("planning", {"plan", "replan", "search"}, 0),
        ("fleet", {"decisions", "day", "memory", "growth"}, 1),
        ("env", {"batch", "single", "memory"}, 3),
    ],
)
def test_parts_have_rows(part, parts, missing, monkeypatch):
    monkeypatch.setattr(env, "find_spec", lambda name: None)
    monkeypatch.setattr(sumo, "sumo_folder", lambda: None)
    rows = rows_of(part)
    assert all(list(row) == KEYS for row in rows)
    assert {row["part"] for row in rows} == parts
    absent = [row["case"] for row in rows if row["value"] is None]
    assert len(absent) == missing
    assert all(case.endswith(": not installed") for case in absent)
    assert all(row["value"] > 0 for row in rows if row["value"] is not None)


@pytest.mark.parametrize(
    ("scanner", "tolerance"),
    [
        (sensors.marching_scanner, 2 * sensors.GRID_CELL),
        (sensors.pymunk_scanner, 2e-3),
        (sensors.embree_scanner, 2e-3),
    ],
)
def test_peers_measure_what_the_laser_measures(scanner, tolerance):
    laser = LaserScanner()
    plane, draw = sensors.walled_lot(np.random.default_rng(3), 30)
    peer = scanner(plane, laser)
    poses = draw(3)
    ours, theirs = (np.minimum(s, laser.max_range) for s in (laser.scan(plane, poses), peer(poses)))
    assert ((np.abs(ours - theirs) > tolerance).mean(axis=1) < 0.05).all()
    np.testing.assert_array_equal(peer(poses), np.concatenate([peer(pose[None]) for pose in poses]))


def test_solvers_are_given_the_same_process():
    mdp = planning.forecast_process(grid_lot(2, 6), 0)
    p = planning.transitions(mdp)
    n = mdp.n_states
    np.testing.assert_allclose(np.asarray(p.sum(axis=1)).ravel(), 1.0)
    values = np.random.default_rng(0).normal(size=n)
    ahead = (p @ np.append(values, 0.0))[:-1].reshape(n, 5)
    np.testing.assert_allclose(mdp.rewards() + mdp.gamma * ahead, mdp.action_values(values))
