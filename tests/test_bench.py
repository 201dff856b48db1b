"""`parkenv bench`: the table, its rows, and that the peers do the same job."""

import json

import numpy as np
import pytest
from command_line import parkenv
from typer.testing import CliRunner

from parkenv.cli import app
from parkenv.errors import InputError
from parkenv.studies.bench import sensors as bench_sensors
from parkenv.studies.bench.rows import duration, rate, seconds_each
from parkenv.studies.bench.sensors import (
    GRID_CELL,
    camera_rows,
    embree_scanner,
    laser_rows,
    marching_scanner,
    parked_cars,
    pymunk_scanner,
    search_rows,
    walled_lot,
)
from sim_sensors.laser.scanner import LaserScanner


def test_a_ratio_above_one_means_faster():
    (row,) = rate("laser", "a", 300.0, "scans/s", other=100.0)
    assert row == {
        "part": "laser", "case": "a", "value": 300.0, "unit": "scans/s",
        "peer": "other", "peer_value": 100.0, "ratio": 3.0,
    }  # fmt: skip
    assert duration("camera", "a", 2.0, "ms", other=8.0)[0]["ratio"] == 4.0
    assert rate("camera", "a", 1.0, "frames/s")[0]["peer"] is None


def test_the_stop_watch_takes_the_median():
    calls = []
    assert 0.0 <= seconds_each(calls.append, seconds=0.0, least=5) < 10.0
    assert len(calls) == 6


@pytest.mark.parametrize(
    ("scanner", "tolerance"),
    [(marching_scanner, 2 * GRID_CELL), (pymunk_scanner, 2e-3), (embree_scanner, 2e-3)],
)
def test_peers_measure_what_the_laser_measures(scanner, tolerance):
    laser = LaserScanner()
    plane, draw = walled_lot(np.random.default_rng(3), 30)
    peer = scanner(plane, laser)
    poses = draw(3)
    ours, theirs = (np.minimum(s, laser.max_range) for s in (laser.scan_batch(plane, poses), peer(poses)))
    assert ((np.abs(ours - theirs) > tolerance).mean(axis=1) < 0.05).all()
    np.testing.assert_array_equal(peer(poses), np.concatenate([peer(pose[None]) for pose in poses]))


def test_a_peer_that_sees_something_else_is_not_compared(monkeypatch):
    def blind(plane, laser):
        return lambda poses: np.zeros((len(poses), laser.n_beams))

    monkeypatch.setattr(bench_sensors, "pymunk_scanner", blind)
    with pytest.raises(AssertionError, match="pymunk segment_query_first differs from the laser on 100%"):
        laser_rows(seconds=0.0)


def test_the_measured_scene_is_full():
    assert len(parked_cars().present) == 200


@pytest.mark.slow
def test_sensors_are_measured():
    rows = laser_rows(seconds=0.0) + camera_rows(seconds=0.0)
    rows += search_rows(seconds=0.0, scenario="mini", searches=4)
    keys = {"part", "case", "value", "unit", "peer", "peer_value", "ratio"}
    assert all(set(row) == keys and row["value"] > 0 for row in rows)
    assert {row["part"] for row in rows} == {"laser", "camera", "environment"}
    assert any(row["peer"] and "pymunk" in row["peer"] for row in rows)
    stages = {"transform and raster", "of that, transform", "shading", "exposure and noise"}
    assert {row["case"].removeprefix("stages: ") for row in rows} > stages


def test_the_command_shows_and_keeps_its_rows(monkeypatch, tmp_path):
    def measured(seed, seconds):
        return rate("laser", "a", 300.0 * seconds, "scans/s", pymunk=100.0 + seed)

    monkeypatch.setattr(bench_sensors, "sensor_rows", measured)
    done = parkenv("bench", "sensors", "--seconds", 2, "--seed", 20, "--out", tmp_path / "b")
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "b" / "summary.json").read_text())["rows"] == measured(20, 2.0)
    for text in (done.stdout, (tmp_path / "b" / "sensors.md").read_text()):
        assert "pymunk" in text
        assert text.index("600") < text.index("120")
    assert done.stdout.startswith("After an installation each part first compiles")


def test_an_unknown_part_is_named():
    result = CliRunner().invoke(app, ["bench", "engine"])
    assert isinstance(result.exception, InputError)
    assert "PARTS is 'engine', want 'sensors', 'perception', " in str(result.exception)


def test_days_of_fleets_are_measured(monkeypatch):
    from parkenv.studies.bench import sumo
    from parkenv.studies.bench.fleet import fleet_rows

    monkeypatch.setattr(sumo, "sumo_folder", lambda: None)
    *rows, missing = fleet_rows(seed=0, seconds=0.0, worlds=2, large=400, day_cars=20, growth=(5,))
    assert missing["case"] == "SUMO: not installed"
    assert all(row["value"] > 0 for row in rows)
    parts = [row["part"] for row in rows]
    assert parts == ["decisions"] * 2 + ["day", "memory"] * 4 + ["growth"] * 2


def test_steps_are_measured_and_peers_that_are_not_there_are_named(monkeypatch):
    from parkenv.studies.bench import env as bench_env

    monkeypatch.setattr(bench_env, "find_spec", lambda name: None)
    rows = bench_env.env_rows(seed=0, seconds=0.0, batch=4, large=300, places=3)
    measured = [row for row in rows if row["part"] in ("batch", "single") and row["value"] is not None]
    assert len(measured) == 9
    assert all(row["value"] > 0 and row["ratio"] == row["value"] / row["peer_value"] for row in measured)
    absent = [row["case"] for row in rows if row["value"] is None]
    assert absent == [
        f"{name}: not installed"
        for name in ("highway_env parking-v0", "minigrid MiniGrid-Empty-8x8-v0", "envpool CartPole-v1")
    ]
    memory = {row["case"]: row["value"] for row in rows if row["part"] == "memory"}
    # Of each slot 40 + 32 + 4 bytes, and 4 + 16 of the full belief.
    assert memory["batch of 4, 200 slots, full belief"] == pytest.approx(200 * 96 / 1024, rel=0.1)
    tables, whole = (
        memory[f"batch of 4, 3 places, tables {what}"] for what in ("of the places", "and environments")
    )
    assert 0.0 < tables < whole
