"""Maps: the grid, slots, inference over sessions, the map file, discovered slots, and pose errors."""

import math
import os
import signal
import sqlite3
import subprocess
import sys
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from command_line import parkenv
from stored_rows import change_rows

from parkenv import InputError, make_scenario
from parkenv.lots import packaged_lot
from parkenv.mapping.discovery import discover, score_discovery
from parkenv.mapping.grid import OccupancyGrid
from parkenv.mapping.inference import MapPrior, SessionLog, counted, predict
from parkenv.mapping.odometry import PoseNoise
from parkenv.mapping.store import MapStore, Session
from parkenv.perception.range_scan import scan_from_laser
from parkenv.perception.ranging import LocatedCars
from parkenv.perception.slot_filter import P_FREE, P_OCCUPIED, SlotFilter
from parkenv.world.lot_scene import slot_lot
from parkenv.world.occupancy.process import Arrival
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.movers import Movers
from sim_sensors.rig import Mount

LASER, MOUNT = LaserScanner(), Mount(z=0.5)


def test_looks_free_and_fill_cells_as_the_filter_says():
    grid = OccupancyGrid((0.0, -5.0), (14.0, 5.0), 0.25)
    grid.update((0.1, 0.1), 0.0, math.radians(30.0), np.array([[0.0, 5.0]]))
    row, columns = int(5.1 / 0.25), [int(x / 0.25) for x in (3.0, 7.0, 9.6)]  # before, on and behind the car
    assert grid.probability[row, columns] == pytest.approx([P_FREE, P_OCCUPIED, 0.5], abs=1e-6)
    assert not grid.seen[row, columns[-1]]
    assert grid.probability[0, -1] == 0.5
    grid = OccupancyGrid((0.0, -5.0), (12.0, 5.0), 0.25)
    for _ in range(3):
        grid.update((0.1, 0.1), 0.0, 0.5, np.empty((0, 2)))
    odds = (P_FREE / (1 - P_FREE)) ** 3
    assert grid.probability[20, 12] == pytest.approx(odds / (1 + odds), abs=1e-6)
    for _ in range(200):
        grid.update((0.1, 0.1), 0.0, 0.5, np.empty((0, 2)))
    assert grid.log_odds.min() == pytest.approx(-12.0)


@pytest.fixture(scope="module")
def mini():
    return make_scenario("mini").lot


def drive_by(lot, scene, noise=None, slots=None, believed=np.array):
    """A filter after a laser has passed the whole lot, at poses that are `believed` to be others."""
    slots = slots or SlotFilter(lot)
    xs = np.arange(lot.vertex_xy[:, 0].min(), lot.vertex_xy[:, 0].max(), 1.0)
    true = np.column_stack([xs, np.full(len(xs), lot.vertex_xy[:, 1].mean()), np.zeros(len(xs))])
    for pose, belief in zip(true, believed(true), strict=True):
        ranges = LASER.scan(scene.scan_plane, pose, noise)
        slots.update_from_scan(scan_from_laser(LASER, MOUNT, belief, ranges))
    return slots


@pytest.mark.parametrize("seed", range(2))
def test_beams_tell_taken_slots_from_free_ones(mini, seed):
    rng = np.random.default_rng(seed)
    taken = rng.random(mini.n_slots) < 0.5
    states = drive_by(mini, slot_lot(mini).scene(taken, seed), rng).states()
    assert states.in_view.all()
    np.testing.assert_array_equal(states.occupied, taken)


def test_people_and_traffic_are_not_parked_cars_nor_are_those_that_left_during_the_drive(mini):
    full = drive_by(mini, slot_lot(mini).scene(np.ones(mini.n_slots, bool)))
    scene, still = slot_lot(mini).scene(np.zeros(mini.n_slots, bool)), np.zeros(mini.n_slots)
    people = np.column_stack([mini.slot_xy, still])
    driving = np.array([[mini.slot_xy[0, 0] + 6.0, 0.0, 0.0]])
    busy = scene.with_movers(Movers(driving, np.array([2]), people, still, still.astype(int)))
    assert not drive_by(mini, busy).states().occupied.any()
    assert not drive_by(mini, scene, slots=full).states().occupied.any()


def test_unseen_slots_stay_unknown_and_a_detection_goes_to_its_slot_alone(mini):
    slots, pose = SlotFilter(mini), np.array([*mini.vertex_xy[0], 0.0])
    wall = np.full(LASER.n_beams, 0.5, np.float32)
    slots.update_from_scan(scan_from_laser(LASER, MOUNT, pose, wall))
    states = slots.states()
    assert not states.in_view.any()
    assert (states.p_occupied == 0.5).all()
    xy = np.array([mini.slot_xy[3] + [0.3, -0.4], mini.slot_xy[3] + [0.0, 50.0]])
    cars = LocatedCars(xy, np.zeros(2), np.ones((2, 2)), np.ones(2), np.ones(2, np.float32), np.arange(2))
    slots = SlotFilter(mini)
    assert slots.update_from_cars(cars).tolist() == [3, -1]
    states = slots.states()
    assert states.occupied.tolist() == [i == 3 for i in range(mini.n_slots)]
    assert states.p_occupied[3] == pytest.approx(P_OCCUPIED)


def sessions(times, occupied, known=None):
    occupied = np.array(occupied, bool)
    known = np.ones_like(occupied) if known is None else np.array(known, bool)
    return SessionLog(np.array(times, float), occupied, known)


def test_counts_are_the_thesis_and_predictions_of_the_asked_hour_and_kind_of_day():
    log = sessions([0, 1, 2, 3], [[1, 0], [1, 0], [1, 1], [0, 0]], [[1, 1], [1, 1], [1, 0], [1, 0]])
    np.testing.assert_allclose(counted(log), [0.75, 0.0])
    assert counted(sessions([0], [[0]], [[0]]))[0] == 0.5
    tuesday, sunday, hour = 86_400.0, 6 * 86_400.0, 3600.0
    times = [tuesday + 9 * hour] * 6 + [tuesday + 20 * hour] * 6 + [sunday + 9 * hour] * 6
    log = sessions(times, [[1, 1]] * 6 + [[0, 0]] * 6 + [[0, 1]] * 6)
    morning = predict(log, 3 * 86_400.0 + 9 * hour)  # a Thursday
    evening = predict(log, 3 * 86_400.0 + 20 * hour)
    weekend = predict(log, 5 * 86_400.0 + 9 * hour)
    assert (morning.p_occupied > 0.75).all()
    assert (evening.p_occupied < 0.3).all()
    assert weekend.p_occupied[0] < 0.5 < weekend.p_occupied[1]


def test_few_sessions_are_unsure_many_are_sharp_and_a_slot_that_was_never_seen_is_like_its_lot():
    one, many = sessions([0.0], [[1, 0]]), sessions(np.zeros(60), [[1, 0]] * 60)
    a, b = predict(one), predict(many)
    assert (a.low <= a.p_occupied).all()
    assert (a.p_occupied <= a.high).all()
    assert ((b.high - b.low) < 0.3 * (a.high - a.low)).all()
    assert b.p_occupied[0] > 0.9 > 0.7 > a.p_occupied[0]
    known = np.ones((20, 3), bool)
    known[:, 2] = False
    found = predict(sessions(np.zeros(20), [[1, 1, 0]] * 20, known))
    assert found.p_occupied[2] > 0.8
    assert found.sessions.tolist() == [20, 20, 0]
    assert found.high[2] - found.low[2] > found.high[0] - found.low[0]


def test_intervals_hold_the_truth_as_often_as_they_say():
    rng = np.random.default_rng(0)
    true = rng.beta(4, 4, 400)
    found = predict(sessions(np.zeros(12), rng.random((12, 400)) < true), 0.0)
    assert 0.8 < ((found.low <= true) & (true <= found.high)).mean() <= 1.0


def test_a_map_is_a_prior_of_a_search():
    log = sessions([40_000.0] * 9, [np.arange(make_scenario("mini").lot.n_slots) % 2 == 0] * 9)
    scenario = make_scenario("mini", prior=MapPrior(log))
    p = gym.make("parkenv/Search-v2", scenario=scenario).reset(seed=0)[0]["p_occupied"]
    assert p[::2].min() > p[1::2].max()
    assert (MapPrior(log).forecast(Arrival(40_000.0)).decay_rate > 0).all()


def session(lot, key, p=0.9):
    values = np.full(lot.n_slots, p)
    values[0] = np.nan
    return Session(key, 36_000.0, "laser", "sunny", values, np.array([[1.0, 2.0, 0.5]]))


def test_what_is_written_comes_back(mini, tmp_path):
    with MapStore(tmp_path / "m.sqlite", mini) as store:
        store.add(session(mini, "a"))
        store.add(session(mini, "b", 0.1))
        assert store.has("a")
        assert not store.has("c")
    with MapStore(tmp_path / "m.sqlite", mini, create=False) as store:
        a, b = store.sessions()
        np.testing.assert_array_equal(a.p_occupied, session(mini, "a").p_occupied)
        np.testing.assert_array_equal(b.cars, [[1.0, 2.0, 0.5]])
        log = store.log()
    assert log.known.sum() == 2 * (mini.n_slots - 1)
    assert log.occupied[0, 1:].all()
    assert not log.occupied[1].any()


def test_files_that_are_no_maps_are_refused(mini, tmp_path):
    (tmp_path / "text").write_text("this is a letter to my aunt, and no map at all" * 20)
    MapStore(tmp_path / "newer", mini).close()
    for name, sql in (("other", "CREATE TABLE t (x)"), ("newer", "PRAGMA user_version = 99")):
        with sqlite3.connect(tmp_path / name) as database:
            database.execute(sql)
    MapStore(tmp_path / "else", packaged_lot("jam")).close()
    for name, message in (
        ("text", "is no map file"),
        ("other", "no map file of parkenv"),
        ("newer", "another parkenv .schema 99, want 3"),
        ("else", "is a map of lot 'jam', not of 'mini'"),
        ("none", "no such map file"),
    ):
        with pytest.raises(InputError, match=message):
            MapStore(tmp_path / name, mini, create=False)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda row: row["p_occupied"].pop(), r"has \(9,\) slots, want \(10,\)"),
        (lambda row: row.update(p_occupied=[7.0] * 10), "want .n_slots,. from 0 to 1"),
        (lambda row: row.update(time="noon"), "must be real number"),
        (lambda row: row.update(time=9e999), "time of session 'a' is inf"),
        (lambda row: row.update(cars=[[1e300, 0.0, 0.0]]), "want .n, 3. of finite numbers, at most 1e"),
        (lambda row: row.pop("rig") and None, "rig"),
    ],
)
def test_rows_of_a_stranger_are_checked(mini, tmp_path, change, message):
    with MapStore(tmp_path / "m.sqlite", mini) as store:
        store.add(session(mini, "a"))
    change_rows(tmp_path, lambda row: change(row) and None, "m.sqlite")
    file = tmp_path / "m.sqlite"
    with pytest.raises(InputError, match=message), MapStore(file, mini, create=False) as store:
        store.log()


def test_reading_changes_and_makes_no_file(mini, tmp_path):
    with MapStore(tmp_path / "m", mini) as store:
        store.add(session(mini, "a"))
    (tmp_path / "empty").touch()
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with MapStore(tmp_path / "m", mini, create=False) as store:
        assert len(store.sessions()) == 1
        with pytest.raises(InputError, match="cannot be written"):
            store.add(session(mini, "b"))
    with pytest.raises(InputError, match="is empty, no map file"):
        MapStore(tmp_path / "empty", mini, create=False)
    for name in ("empty", "m", "none"):
        asked = parkenv("map", tmp_path / name, "--scenario", "mini")
        assert asked.returncode == (0 if name == "m" else 2), asked.stderr
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_strangers_journal_removes_no_file(mini, tmp_path):
    """A journal may name the file of a larger transaction, which SQLite removes after rolling back."""
    path, mine = tmp_path / "map.sqlite", tmp_path / "mine.txt"
    with MapStore(path, mini) as store:
        store.add(session(mini, "a"))
    mine.write_text("mine")
    magic, name, size = bytes.fromhex("d9d505f920a163d7"), os.fsencode(mine), path.stat().st_size
    page = int.from_bytes(path.read_bytes()[16:18], "big")
    head = (magic + b"".join(n.to_bytes(4, "big") for n in (0, 1, size // page, 512, page))).ljust(512, b"\0")
    place, length, checksum = (n.to_bytes(4, "big") for n in (2**30 // page + 1, len(name), sum(name)))
    (tmp_path / "map.sqlite-journal").write_bytes(head + place + name + length + checksum + magic)
    (tmp_path / "link").symlink_to(path)
    for opened in (path, tmp_path / "link"):
        for create in (False, True):
            with pytest.raises(InputError, match=r"map\.sqlite-journal: is not the journal of a map file"):
                MapStore(opened, mini, create=create)
    assert mine.read_text() == "mine"


_WRITER = """
import sys, numpy as np
from pathlib import Path
from parkenv.lots import packaged_lot
from parkenv.mapping.store import MapStore, Session
lot = packaged_lot("mini")
with MapStore(Path(sys.argv[1]), lot) as store:
    for k in range(int(sys.argv[3])):
        store.add(Session(f"{sys.argv[2]}{k:04d}", 0.0, "laser", "rain", np.full(lot.n_slots, 0.7), np.zeros((50, 3))))
        print(k, flush=True)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_two_processes_write_at_once_and_a_kill_leaves_whole_sessions_only(mini, tmp_path):
    file = tmp_path / "m.sqlite"
    words = [sys.executable, "-c", _WRITER, file]
    both = [subprocess.Popen([*words, name, "15"], stdout=subprocess.PIPE) for name in "ab"]
    assert [writer.wait(60) for writer in both] == [0, 0]
    killed = subprocess.Popen([*words, "c", "5000"], stdout=subprocess.PIPE, text=True)
    for _ in range(5):
        killed.stdout.readline()
    os.kill(killed.pid, signal.SIGKILL)
    killed.wait(30)
    with MapStore(file, mini, create=False) as store:
        there = store.sessions()
    assert len(there) >= 35
    assert all(len(session.cars) == 50 and np.isfinite(session.p_occupied).all() for session in there)


def test_slots_are_found_where_cars_stand_again_and_again():
    lot, rng = packaged_lot("campus"), np.random.default_rng(3)
    seen = []
    for _ in range(20):
        taken = np.flatnonzero(rng.random(lot.n_slots) < 0.6)
        n = len(taken)
        turned = lot.slot_yaw[taken] + rng.normal(0, 0.05, n) + np.pi * rng.integers(0, 2, n)
        seen.append(np.column_stack([lot.slot_xy[taken] + rng.normal(0, 0.2, (n, 2)), turned]))
    passing = np.column_stack([rng.uniform(0, 100, (30, 2)), rng.uniform(0, 3, 30)])
    score = score_discovery(discover(np.concatenate([*seen, passing])), lot)
    assert min(score.recall, score.precision) > 0.98
    assert score.error < 0.25
    assert len(discover(np.empty((0, 3))).xy) == 0


def test_pose_errors_are_as_large_as_stated_and_grow_along_the_way():
    path = np.column_stack([np.arange(0.0, 4000.0, 1.0), np.zeros(4000), np.zeros(4000)])
    error = PoseNoise(0.5, 0.02, 30.0).estimated(path, np.random.default_rng(0)) - path
    assert error[:, 0].std() == pytest.approx(0.5, rel=0.25)
    assert error[:, 2].std() == pytest.approx(0.02, rel=0.25)
    near = np.corrcoef(error[:-1, 0], error[1:, 0])[0, 1]
    assert near > 0.9 > 0.4 > abs(np.corrcoef(error[:-300, 0], error[300:, 0])[0, 1])
    np.testing.assert_array_equal(PoseNoise().estimated(path, np.random.default_rng(0)), path)


def test_half_a_metre_of_pose_error_is_borne_and_two_are_not(mini):
    taken = np.arange(mini.n_slots) % 3 == 0
    scene = slot_lot(mini).scene(taken, 5)

    def accuracy(position):
        right = []
        for seed in range(6):
            estimated = partial(PoseNoise(position).estimated, rng=np.random.default_rng(seed))
            right.append(drive_by(mini, scene, believed=estimated).states().occupied == taken)
        return np.mean(right)

    assert accuracy(0.0) == 1.0
    assert accuracy(0.3) > 0.9
    assert accuracy(2.0) < accuracy(0.3)
