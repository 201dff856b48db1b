"""Lots made from lists of slot centres: rows, aisles, and ambiguous cases."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lot_checks import DRAGON_LAKE, needs_dragon_lake, refused_lot
from scipy.sparse.csgraph import connected_components

from parkenv.errors import InputError
from parkenv.lots import grid_lot, read_lot
from parkenv.lots.draft import ImportOptions
from parkenv.lots.generators import BAY_SIZE, Slots, bay_row, nearest_on_lanes
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.lot_files import check_lot, import_lot
from parkenv.world.lot import Mouth, mouth_points


def listed(tmp_path, xy, *, yaw=None, ids=None, order=None, **options):
    """The draft of a list of slots."""
    ids = ids or [f"s{i}" for i in range(len(xy))]
    lines = ["id,x,y" + ("" if yaw is None else ",yaw")]
    for i in range(len(xy)) if order is None else order:
        cells = [ids[i], *map(repr, map(float, xy[i])), *([] if yaw is None else [repr(float(yaw[i]))])]
        lines.append(",".join(cells))
    path = tmp_path / "slots.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    return import_lot(path, ImportOptions(**options))


def of_lot(tmp_path, lot, *, with_yaw=False, **options):
    yaw = lot.slot_yaw if with_yaw else None
    return listed(tmp_path, lot.slot_xy, yaw=yaw, ids=list(lot.slot_ids), **options)


def row(n, y, *, x=0.0, pitch=2.5):
    return [(x + pitch * k, y) for k in range(n)]


@pytest.mark.parametrize("with_yaw", [False, True])
@pytest.mark.parametrize(("rows", "columns"), [(2, 4), (5, 8)])
def test_a_grid_is_found_again(tmp_path, rows, columns, with_yaw):
    lot = grid_lot(rows, columns)
    ends = {"entries": (tuple(lot.entries[0]),), "goals": (tuple(lot.goals[0]),)}
    found = of_lot(tmp_path, lot, with_yaw=with_yaw, **ends).lot()
    assert found.slot_ids == lot.slot_ids
    np.testing.assert_allclose(found.mouth_xy(), lot.mouth_xy(), atol=1e-6)
    np.testing.assert_allclose(np.cos(found.slot_yaw - lot.slot_yaw), 1.0)
    aisles = {round(float(lane.points[0, 1]), 6) for lane in found.lanes if np.ptp(lane.points[:, 1]) < 1e-6}
    assert aisles == {round(float(lane.points[0, 1]), 6) for lane in lot.lanes[: (rows + 1) // 2]}
    assert connected_components(found.drive_matrix(), connection="strong")[0] == 1


@needs_dragon_lake
def test_dragon_lake_is_found_again_from_its_slots_alone(tmp_path):
    lot = read_lot(DRAGON_LAKE)
    found = of_lot(tmp_path, lot, entries=(tuple(lot.entries[0]),), goals=((80.0, -4.0),)).lot()
    assert found.slot_ids == lot.slot_ids
    assert np.abs(found.mouth_xy() - lot.mouth_xy()).max() < 0.6
    np.testing.assert_allclose(np.cos(found.slot_yaw - lot.slot_yaw), 1.0)
    # Aisles and the roads between them lie where the map's own waypoints are.
    nearest, _, _ = nearest_on_lanes(found.lanes, lot.vertex_xy[: lot.n_slots])
    assert np.hypot(*(nearest - lot.vertex_xy[: lot.n_slots]).T).max() < 3.0


def test_angled_rows_need_a_yaw_and_keep_it(tmp_path):
    angle = np.radians(60.0)
    low, high = bay_row((0, 3), 0.0, 8, angle=angle), bay_row((40, -3), np.pi, 8, angle=angle)
    slots = Slots.joined([low, high])
    draft = listed(tmp_path, slots.xy, yaw=slots.yaw, entries=((-5.0, 0.0),), goals=((20.0, 20.0),))
    lot = draft.lot()
    np.testing.assert_allclose(lot.slot_yaw, slots.yaw)
    np.testing.assert_allclose(lot.slot_width, BAY_SIZE[1], atol=1e-6)
    np.testing.assert_allclose(lot.lanes[0].points[:, 1], 0.0, atol=0.3)


def test_kerbside_rows_stand_as_traffic_runs(tmp_path):
    xy = row(6, 4.0, pitch=6.2) + row(6, -4.0, pitch=6.2)
    lot = listed(tmp_path, np.array(xy), entries=((-6.0, 0.0),), goals=((20.0, 20.0),)).lot()
    np.testing.assert_allclose(np.cos(lot.slot_yaw), [-1.0] * 6 + [1.0] * 6)
    assert set(lot.slot_mouth.tolist()) == {Mouth.LEFT}
    np.testing.assert_allclose(lot.lanes[0].points[:, 1], 0.0, atol=1e-6)


def test_latitudes_and_longitudes_are_metres_after_all(tmp_path):
    lot = grid_lot(4, 8)
    frame = LocalFrame(lon=-122.25, lat=37.87)
    lines = ["LAT,LON"] + [f"{lat:.8f},{lon:.8f}" for lon, lat in frame.to_lonlat(lot.slot_xy)]
    path = tmp_path / "slots.csv"
    path.write_text("\n".join(lines))
    lon, lat = frame.to_lonlat(lot.entries)[0].tolist()
    draft = import_lot(path, ImportOptions(entries=((lat, lon),), goals=((lat, lon + 3e-4),)))
    found = draft.lot()
    assert found.slot_ids[0] == "2"  # the row in the file
    back = frame.to_xy(draft.frame.to_lonlat(found.mouth_xy()))
    np.testing.assert_allclose(back, lot.mouth_xy(), atol=0.02)


def test_bounds_keep_a_part(tmp_path):
    lot = grid_lot(4, 8)
    draft = of_lot(tmp_path, lot, bounds=((-1.0, -20.0), (12.4, 50.0)))
    assert len(draft.slots) == 20
    with pytest.raises(InputError, match="no slot within the bounds"):
        of_lot(tmp_path, lot, bounds=((1000.0, 0.0), (1010.0, 50.0)))


@settings(max_examples=4)
@given(
    turn=st.floats(-3.2, 3.2),
    shift=st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4)),
    rows=st.sampled_from([2, 4, 6]),
    columns=st.integers(4, 12),
    pitch=st.floats(2.2, 3.4),
    aisle=st.floats(4.0, 8.5),
    seed=st.integers(0, 1000),
)
def test_a_moved_list_gives_the_same_lot_moved(tmp_path, turn, shift, rows, columns, pitch, aisle, seed):
    lot = grid_lot(rows, columns, pitch=pitch, aisle=aisle)
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def moved(xy):
        return np.asarray(xy) @ matrix.T + shift

    plain = of_lot(tmp_path, lot)
    order = np.random.default_rng(seed).permutation(lot.n_slots)
    other = listed(tmp_path, moved(lot.slot_xy), ids=list(lot.slot_ids), order=order)
    index = [other.slot_ids.index(name) for name in plain.slot_ids]
    np.testing.assert_allclose(other.slots.xy[index], moved(plain.slots.xy), atol=1e-6)
    np.testing.assert_allclose(np.cos(other.slots.yaw[index] - plain.slots.yaw - turn), 1.0)
    np.testing.assert_allclose(other.slots.width[index], plain.slots.width)
    # Lanes are rounded to a centimetre, and roads between aisles are found on a grid.
    mouths = mouth_points(*(getattr(plain.slots, name) for name in ("xy", "yaw", "length", "width", "mouth")))
    lanes = [nearest_on_lanes(draft.lanes, at)[0] for draft, at in ((plain, mouths), (other, moved(mouths)))]
    np.testing.assert_allclose(lanes[1], moved(lanes[0]), atol=0.3)


@settings(max_examples=5)
@given(seed=st.integers(0, 10_000))
def test_inexact_lists_give_lots_in_which_every_slot_opens_to_a_lane(tmp_path, seed):
    rng = np.random.default_rng(seed)
    lot = grid_lot(4, int(rng.integers(6, 15)))
    kept = np.sort(rng.permutation(lot.n_slots)[: lot.n_slots - 3])
    xy = lot.slot_xy[kept] + rng.uniform(-0.15, 0.15, (len(kept), 2))
    draft = listed(tmp_path, xy, yaw=lot.slot_yaw[kept], entries=((-3.0, 0.0),), goals=((50.0, 20.0),))
    found = draft.lot()
    assert found.n_slots + sum(len(left.ids) for left in draft.left_out) == len(kept)
    mouth = found.mouth_xy()
    to_lane = nearest_on_lanes(found.lanes, mouth)[0] - mouth
    assert np.hypot(*to_lane.T).max() < 5.0
    assert ((mouth - found.slot_xy) * to_lane).sum(axis=1).min() > 0.0


REFUSED = {
    "between spacings": (row(8, 0, pitch=4.2) + row(8, 11, pitch=4.2), "a slot every 4.20 m, too wide"),
    "millimetres": (row(8, 0, pitch=2500.0) + row(8, 11e3, pitch=2500.0), "2500.00 m apart, want 1.8 to 8 m"),
    "three slots": (row(3, 0), "3 slots, want at least 4"),
    "no way in": (row(8, 0) + row(8, 5) + row(8, 10), "8 of 24 spaces have no aisle"),
    "apart": (row(8, 0) + row(8, 11) + row(8, 300) + row(8, 311), "16 of 32 spaces have no aisle"),
    "scattered": (np.random.default_rng(0).uniform(0.0, 60.0, (40, 2)), "18 of 40 slots are in no row"),
    "a ring": ([(12 * np.sin(a), 12 * np.cos(a)) for a in np.arange(0.0, 6.28, 0.2)], "bends by more than"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_list_without_a_plausible_layout_is_refused(tmp_path, name):
    xy, message = REFUSED[name]
    with pytest.raises(InputError, match=message):
        listed(tmp_path, np.array(xy), entries=((0.0, 5.0),), goals=((0.0, 5.0),))
    problems = check_lot(tmp_path / "slots.csv")
    assert [p.severity for p in problems] == ["error"]


OPEN_TO_BOTH_SIDES = {
    "a lone row": row(8, 0),
    "aisles on both sides": row(8, 0) + row(8, 11) + row(8, 22),
    "a bend": [(30 * np.sin(a), 30 * np.cos(a)) for a in np.arange(8) * 0.085],
}


@pytest.mark.parametrize("name", OPEN_TO_BOTH_SIDES)
def test_rows_that_could_open_to_either_side_are_guessed_and_said(tmp_path, name):
    xy = np.array(OPEN_TO_BOTH_SIDES[name])
    draft = listed(tmp_path, xy, guess_entry=True, guess_goal=True)
    assert draft.lot().n_slots == len(xy)
    assert "1 could open to either side" in " ".join(draft.guesses)
    assert draft.issues[0].reason == "rows could open to either side"


def test_a_yaw_settles_what_places_alone_leave_open(tmp_path):
    for name in ("a lone row", "aisles on both sides"):
        xy = np.array(OPEN_TO_BOTH_SIDES[name])
        yaw = np.full(len(xy), np.pi / 2)
        draft = listed(tmp_path, xy, yaw=yaw, entries=((-4.0, -5.5),), goals=((0.0, 5.0),))
        lot = draft.lot()
        assert lot.n_slots == len(xy)
        assert not draft.issues
        np.testing.assert_allclose(lot.mouth_xy(), xy - [0.0, 2.5], atol=1e-9)


def test_parallel_cars_have_the_lane_on_their_left(tmp_path):
    for yaw, side in ((0.0, 1.0), (np.pi, -1.0)):
        xy = np.array(row(6, 0.0, pitch=6.2))
        ends = {"entries": ((-6.0, 4.0 * side),), "goals": ((9.0, 9.0),)}
        lot = listed(tmp_path, xy, yaw=np.full(6, yaw), **ends).lot()
        np.testing.assert_allclose(lot.slot_yaw, yaw)
        assert np.all(side * lot.lanes[0].points[:, 1] > 1.0)
    # Between two rows, cars on the far side have it on their right.
    xy = np.array(row(6, 4.0, pitch=6.2) + row(6, -4.0, pitch=6.2))
    lot = listed(tmp_path, xy, yaw=np.zeros(12), entries=((-6.0, 0.0),), goals=((20.0, 20.0),)).lot()
    assert lot.slot_mouth.tolist() == [Mouth.RIGHT] * 6 + [Mouth.LEFT] * 6


def test_it_says_how_to_give_an_entry_and_a_goal(tmp_path):
    draft = of_lot(tmp_path, grid_lot(2, 8))
    with pytest.raises(InputError, match=r"give one by --entry X,Y, .*; no goal: .*--goal X,Y"):
        draft.lot()
    x, y = map(float, draft.missing[0].split(" auto for ")[1].split(";")[0].split(","))
    given = of_lot(tmp_path, grid_lot(2, 8), entries=((x, y),), goals=((9.0, 9.0),))
    guessed = of_lot(tmp_path, grid_lot(2, 8), guess_entry=True, guess_goal=True)
    assert given.lot().n_slots == guessed.lot().n_slots == 16


def test_parking_costs_and_zones_stay_with_their_slots(tmp_path):
    lot = grid_lot(2, 8)
    cost, zone = np.arange(16) * 10.0, np.where(np.arange(16) < 5, "centre", "")
    order = np.random.default_rng(3).permutation(16)
    lines = [f"{lot.slot_ids[i]},{lot.slot_xy[i, 0]},{lot.slot_xy[i, 1]},{cost[i]},{zone[i]}" for i in order]
    (tmp_path / "slots.csv").write_text("\n".join(["id,x,y,parking_cost_s,zone", *lines]))
    ends = {"entries": (tuple(lot.entries[0]),), "goals": (tuple(lot.goals[0]),)}
    west = ImportOptions(bounds=((-5.0, -20.0), (12.5, 20.0)), **ends)
    for options, n in ((ImportOptions(**ends), 16), (west, 10)):
        drawn = import_lot(tmp_path / "slots.csv", options).lot()
        assert drawn.n_slots == n
        for column, values in (("slot_parking_cost_s", cost), ("slot_zone", zone)):
            listed = dict(zip(lot.slot_ids, values, strict=True))
            assert getattr(drawn, column).tolist() == [listed[name] for name in drawn.slot_ids]


FAULTS = [
    ("", "no slot below the line of columns"),
    ("x,y", "no slot below the line of columns"),
    ("x,y,lat,lon\n1,2,3,4", "columns are 'x,y,lat,lon'"),
    ("x,x,y\n1,1,2", "line 1: has two columns 'x'"),
    ("x,y,z\n1,1,2", "row 2: unknown key 'z'"),
    ("x,y\n1,2\n3", "line 3: has 1 fields, want 2"),
    ("x,y\n1,2\n3,nan", "row 3: y is 'nan', want"),
    ("lat,lon\n91,2", "row 2: lat is '91', want a number of at most 90"),
    ("x,y,yaw\n1,2,", "row 2: yaw is '', want a number"),
    ("x,y,parking_cost_s\n1,2,-3", "row 2: parking_cost_s is '-3', want a number of at least 0"),
    ("id,x,y\na,1,2\na,9,2", "row 3: id 'a' appears already in row 2"),
    ("id,x,y\n,1,2", "row 2: id is '', want"),
    ("x,y\n1,2\n9,9\n1.01,2", "row 4: slot '4' lies where slot '2' is"),
]


@pytest.mark.parametrize(("text", "message"), FAULTS, ids=map(str, range(len(FAULTS))))
def test_faults_are_named_in_one_line(tmp_path, text, message):
    path = tmp_path / "slots.csv"
    path.write_text(text)
    assert re.search(message, refused_lot(import_lot, path))
