"""Slots and lanes of an unknown street, from parked cars that drives have passed."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import ran, rows_in
from hypothesis import given, settings
from hypothesis import strategies as st

from parkenv.errors import InputError
from parkenv.files.limited_reading import read_yaml
from parkenv.lots import check_lot, packaged_lot, read_lot, write_lot
from parkenv.mapping.car_tracks import ParkedCars
from parkenv.mapping.grid import OccupancyGrid
from parkenv.mapping.map_files import FREE, OCCUPIED, UNKNOWN, write_grid
from parkenv.mapping.route import survey_route
from parkenv.mapping.store import MapStore
from parkenv.mapping.street_lanes import driven_lanes, lane_ends, street_lot
from parkenv.mapping.street_slots import CAR, GAP, LONE_CAR, ONCE, discover_street
from parkenv.world.lot import Mouth

DRIVES = Path(__file__).parents[2] / "shared" / "data" / "drives"
TRACK = np.stack([np.arange(0.0, 80.0), np.zeros(80)], axis=1)


def cars_at(xy, yaw=0.0, std=0.1, sightings=5):
    xy = np.asarray(xy, np.float64).reshape(-1, 2)
    n = len(xy)
    yaw = np.broadcast_to(np.asarray(yaw, np.float64), n) % math.pi
    return ParkedCars(
        xy, yaw, np.tile([4.4, 1.8], (n, 1)), np.full(n, std), np.full(n, 0.9),
        np.broadcast_to(sightings, n).astype(np.int64), np.full(n, 3.0), np.zeros(n),
    )  # fmt: skip


def along(*x, y=-3.0):
    return [(value, y) for value in x]


def places(found, source):
    return found.slots.xy[found.source == source].round(2).tolist()


def test_a_gap_along_the_kerb_holds_as_many_slots_as_fit():
    """Cars of 4.4 m at 10, 15, 25.2 and 45.4 m: no room, 5.8 m for one, 15.8 m for two."""
    found = discover_street([cars_at(along(10.0, 15.0, 25.2, 45.4))], [TRACK])
    assert places(found, CAR) == [[x, -3.0] for x in (10.0, 15.0, 25.2, 45.4)]
    assert places(found, GAP) == [[20.1, -3.0], [31.35, -3.0], [39.25, -3.0]]
    assert (found.slots.mouth == Mouth.LEFT).all()
    np.testing.assert_allclose(found.slots.yaw, 0.0, atol=1e-9)
    np.testing.assert_allclose(found.kerbs[0][:, 1], -4.0)
    left = discover_street([cars_at(along(10.0, 16.0, y=3.0))], [TRACK])
    np.testing.assert_allclose(np.cos(left.slots.yaw), -1.0)


def test_bays_across_the_kerb_are_filled_at_the_pitch_of_the_row():
    found = discover_street([cars_at(along(10.0, 12.6, 15.2, 23.0, y=-6.0), math.pi / 2)], [TRACK])
    assert places(found, GAP) == [[17.8, -6.0], [20.4, -6.0]]
    assert (found.slots.mouth == Mouth.REAR).all()
    np.testing.assert_allclose(found.slots.yaw, -math.pi / 2)
    assert found.slots.width.max() <= 2.6


def test_a_gap_that_may_be_a_side_street_is_filled_only_where_scans_show_it_free():
    cars = [cars_at(along(10.0, 15.0, 42.0))]
    assert not places(discover_street(cars, [TRACK]), GAP)
    asked = []
    found = discover_street(cars, [TRACK], lambda slots: asked.append(slots.xy) or np.ones(len(slots), bool))
    assert len(places(found, GAP)) == len(asked[0]) == 4


def test_no_row_crosses_a_driven_street_and_no_slot_is_where_the_car_drove():
    corner = np.concatenate([TRACK[:40], [[39.0, -20.0]]])
    found = discover_street([cars_at([*along(30.0, 48.0), (20.0, 0.4), (15.0, 1.1)])], [corner])
    assert not places(found, GAP)
    assert (found.source == LONE_CAR).all()


def test_a_car_with_a_wrong_heading_is_of_the_row_that_it_stands_in():
    cars = cars_at(along(10.0, 16.0, 22.0, 28.0), [0.0, 0.05, 1.2, -0.05])
    found = discover_street([cars], [TRACK])
    assert (found.source == CAR).all()
    assert np.abs(found.slots.yaw).max() < 0.1


def test_a_car_between_two_rows_does_not_join_them():
    rows = along(10.0, 12.5, 15.0, 17.5, 20.0, y=-6.0) + along(24.0, 26.5, 29.0, 31.5, 34.0, y=-7.8)
    found = discover_street([cars_at([*rows, (22.0, -6.9)], math.pi / 2)], [TRACK])
    assert {(10.0, -6.0), (34.0, -7.8)} <= set(map(tuple, found.slots.xy.round(1).tolist()))


def test_what_may_have_moved_is_no_slot_or_a_guess():
    once = discover_street([cars_at(along(10.0, 16.0, 40.0), sightings=[5, 1, 5])], [TRACK])
    assert places(once, ONCE) == [[16.0, -3.0]]
    assert not len(discover_street([cars_at(along(10.0), sightings=1)], [TRACK]))
    assert not len(discover_street([cars_at(along(10.0, 16.0), std=2.0)], [TRACK]))
    with pytest.raises(InputError, match="no track"):
        discover_street([cars_at(along(10.0))], [TRACK[:1]])


def test_drives_are_joined_by_their_errors():
    one, two = cars_at(along(10.0, 30.0), std=0.1), cars_at(along(10.5, 20.0), std=0.2)
    found = discover_street([one, two], [TRACK, TRACK])
    assert places(found, CAR) == [[10.1, -3.0], [20.0, -3.0], [30.0, -3.0]]
    assert found.sightings[found.source == CAR].tolist() == [10, 5, 5]


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32), turn=st.floats(-math.pi, math.pi), noise=st.floats(0.0, 0.25))
def test_slots_follow_the_cars_and_never_overlap(seed, turn, noise):
    rng = np.random.default_rng(seed)
    x = np.cumsum(rng.uniform(5.0, 14.0, 7)) + 5.0
    true = np.array(along(*x) + along(*(x + 2.0), y=3.0))
    c, s = math.cos(turn), math.sin(turn)
    to_world = np.array([[c, s], [-s, c]])
    cars = cars_at((true + noise * rng.standard_normal(true.shape)) @ to_world, turn, max(noise, 0.05))
    found = discover_street([cars], [TRACK @ to_world])
    lot, found = street_lot("street", found, driven_lanes([TRACK @ to_world]))
    away = np.hypot(*(true @ to_world - lot.slot_xy[:, None]).transpose(2, 0, 1)).min(axis=0)
    assert (away <= 4.0 * noise + 0.05).mean() >= 0.8
    boxes = found.slots.boxes(shrink=0.11)
    assert not any(boxes[i].intersects(boxes[j]) for i in range(len(boxes)) for j in range(i))


@pytest.mark.parametrize("name", ["campus", "street"])
def test_a_packaged_lot_is_found_from_its_cars(name, tmp_path):
    lot, rng = packaged_lot(name), np.random.default_rng(1)
    track, drives = np.asarray(survey_route(lot).path)[:, :2], []
    for _ in range(3):
        taken = np.flatnonzero(rng.random(lot.n_slots) < 0.6)
        noisy = lot.slot_xy[taken] + 0.2 * rng.standard_normal((len(taken), 2))
        drives.append(cars_at(noisy, lot.slot_yaw[taken] + 0.1 * rng.standard_normal(len(taken)), 0.2))
    made, found = street_lot(name, discover_street(drives, [track]), driven_lanes([track]))
    away = np.hypot(*(lot.slot_xy[:, None] - made.slot_xy[None]).transpose(2, 0, 1))
    assert (away.min(axis=1) <= 0.6).mean() >= 0.9
    assert (away.min(axis=0)[found.source == CAR] <= 1.0).mean() >= 0.97
    write_lot(made, tmp_path / "lot.geojson")
    assert not [str(p) for p in check_lot(tmp_path / "lot.geojson") if p.severity == "error"]


@pytest.mark.skipif(not DRIVES.exists(), reason="the drives of shared/data are not here")
@pytest.mark.parametrize(("name", "gaps"), [("kitti_0039a", 11), ("kitti_0001", 2)])
def test_real_cars_are_found_where_they_park(name, gaps):
    rows = {table: rows_in(DRIVES / name / f"{table}.csv") for table in ("cars", "slots", "poses")}
    xy = {table: np.array([[float(r["x"]), float(r["y"])] for r in its]) for table, its in rows.items()}
    parked = np.array([int(r["n"]) >= 5 for r in rows["cars"]])
    yaw = float(rows["poses"][-1]["yaw"])
    found = discover_street([cars_at(xy["cars"][parked], yaw + 0.1, 0.2)], [xy["poses"]])
    lot, found = street_lot(name, found, driven_lanes([xy["poses"]]))
    is_taken = np.array([r["taken"] == "1" for r in rows["slots"]])
    away = np.hypot(*(xy["slots"][:, None] - lot.slot_xy[None]).transpose(2, 0, 1))
    assert (away[is_taken][:, found.source == CAR].min(axis=1) <= 0.6).mean() >= 0.95
    assert (away[~is_taken].min(axis=1) <= 2.0).sum() >= min(gaps, (~is_taken).sum())
    assert np.median(np.abs((lot.slot_yaw - yaw + math.pi / 2) % math.pi - math.pi / 2)) < 0.08


def test_a_street_that_is_driven_to_and_fro_is_one_lane_between_both():
    there = np.stack([np.arange(0.0, 60.0, 2.0), np.full(30, -1.5)], axis=1)
    (lane,) = driven_lanes([np.concatenate([there, (there * [1.0, -1.0])[::-1]])])
    assert not lane.oneway
    np.testing.assert_allclose(lane.points[1:-1, 1], 0.0, atol=0.5)
    assert len(lane_ends([lane])) == 2


def test_nav2_reads_the_grid(tmp_path):
    grid = OccupancyGrid((-3.0, 2.0), (7.0, 5.0), 0.5)
    for _ in range(3):
        grid.update((-2.75, 2.25), 0.0, math.radians(20.0), np.array([[0.0, 6.0]]))
    write_grid(grid, tmp_path)
    about = read_yaml(tmp_path / "map.yaml")
    assert about["origin"] == [-3.0, 2.0, 0.0]
    assert (about["resolution"], about["negate"], about["mode"]) == (0.5, 0, "trinary")
    cells = cv2.imread(str(tmp_path / about["image"]), cv2.IMREAD_UNCHANGED)
    assert (cells.shape, cells.dtype) == ((6, 20), np.uint8)
    p = (255.0 - cells[::-1]) / 255.0
    state = np.where(p < about["free_thresh"], FREE, UNKNOWN)
    state[p > about["occupied_thresh"]] = OCCUPIED
    assert state[0, 2] == FREE
    assert state[0, 14] == OCCUPIED
    assert (state[~grid.seen] == UNKNOWN).all()


@pytest.mark.slow
def test_a_street_is_mapped_without_a_lot_and_refined_by_later_drives(tmp_path):
    out, n_slots = tmp_path / "out", []
    for seed in (1, 2):
        file = tmp_path / f"{seed}.mcap"
        drive = f"survey --scenario mini --sessions 1 --seed {seed} --every 2 --weather sunny --record"
        ran(drive, file, "--out", tmp_path / f"survey {seed}")
        ran("map-drive --discover", file, "--out", out)
        lot = read_lot(out / "lot.geojson")
        n_slots.append(lot.n_slots)
    assert n_slots[1] >= n_slots[0]
    with MapStore(out / "map.sqlite", lot, create=False) as store:
        assert len(store.sessions()) == 2
    slots = json.loads((out / "slots.geojson").read_text())["features"]
    assert {"p_taken", "last_seen", "from"} <= slots[0]["properties"].keys()
    away = np.hypot(*(lot.slot_xy[:, None] - packaged_lot("mini").slot_xy[None]).transpose(2, 0, 1))
    assert np.median(away.min(axis=1)) < 0.6
    ran("compare --agents mdp -n 1 --lot", out / "lot.geojson", "--out", tmp_path / "compared")
