import pickle
import re
from dataclasses import FrozenInstanceError, fields

import numpy as np
import pytest
import shapely
from lot_checks import refusal
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from scipy.sparse.csgraph import connected_components

from parkenv.lots import city_lot, grid_lot, packaged_lot
from parkenv.lots.generators import CROSSING_CLEARANCE, KERB_SIZE, bay_row
from parkenv.show.figures.lot import draw_lot, save_lot_picture
from parkenv.world.drive_graph import LANE_OFFSET
from parkenv.world.lot import Lane, Mouth, ParkingLot

ONE_SLOT = {
    "name": "one",
    "slot_ids": ("a",),
    "slot_xy": [[10.0, 5.5]],
    "slot_yaw": [np.pi / 2],
    "slot_length": [5.0],
    "slot_width": [2.5],
    "slot_mouth": [Mouth.REAR],
    "lanes": (Lane([[0.0, 0.0], [20.0, 0.0]]),),
    "entries": [[0.0, 0.0]],
    "goals": [[20.0, 10.0]],
}


def overlapping_slots(lot: ParkingLot) -> int:
    boxes = shapely.buffer(shapely.polygons(lot.slot_corners()), -0.01)
    one, other = shapely.STRtree(boxes).query(boxes, predicate="intersects")
    return int((one < other).sum())


def test_a_slot_knows_its_corners_and_its_mouth():
    lot = ParkingLot(**ONE_SLOT)
    np.testing.assert_allclose(lot.mouth_xy(), [[10.0, 3.0]])
    np.testing.assert_allclose(lot.slot_corners(), [[[11.25, 3.0], [11.25, 8.0], [8.75, 8.0], [8.75, 3.0]]])
    np.testing.assert_allclose(lot.walk_m(), [np.hypot(10.0, 4.5)])
    assert lot.bounds() == (0.0, 0.0, 20.0, 10.0)
    assert lot.n_slots == 1
    assert lot.n_vertices == 3


@pytest.mark.parametrize(
    ("make", "change", "message"),
    [
        *(
            (ParkingLot, ONE_SLOT | change, message)
            for change, message in (
                ({"slot_ids": ()}, "has no slot"),
                ({"slot_ids": ("a", "a")}, "slot id 'a' appears twice"),
                ({"slot_xy": [[1.0, 2.0, 3.0]]}, r"slot_xy has shape \(1, 3\), want \(1, 2\)"),
                ({"slot_xy": [["east", 0.0]]}, "slot_xy is .*, want numbers"),
                ({"slot_yaw": [np.nan]}, r"slot_yaw\[0\] is nan, want a finite number"),
                (
                    {"goals": [[1e300, 0.0]]},
                    r"goals\[0, 0\] is 1e\+300, want a finite number",
                ),
                ({"slot_length": [0.0]}, r"slot_length\[0\] is 0.0, want a finite number from 0.1"),
                ({"slot_mouth": [3]}, "slot_mouth must hold 1 values"),
                ({"lanes": ()}, "has no lane"),
                ({"entries": np.empty((0, 2))}, "has no entry"),
                ({"goals": np.empty((0, 2))}, "has no goal"),
                ({"slot_parking_cost_s": [-1.0]}, r"slot_parking_cost_s\[0\] is -1.0"),
                ({"walls": ([[0.0, 0.0]],)}, "walls has shape"),
                ({"slot_xy": [[10.0, 50.0]]}, "slot 0: is on no lane: the nearest is 47.5 m from its mouth"),
                ({"entries": [[10.0, -40.0]]}, "entry 0: is 40.0 m from the nearest lane"),
            )
        ),
        (Lane, {"points": [[0.0, 0.0]]}, "want"),
        (Lane, {"points": [[0.0, 0.0], [0.0, 0.0]]}, "are equal, want different points"),
        (Lane, {"points": [[0.0, 0.0], [np.nan, 0.0]]}, "finite"),
        (grid_lot, {"rows": 0, "columns": 3}, "rows is 0"),
        (
            grid_lot,
            {"rows": 2, "columns": 2, "aisle": 1.0},
            "aisle is 1.0, want a finite number from 3 to 16",
        ),
    ],
)
def test_what_cannot_be_is_refused(make, change, message):
    assert re.search(message, refusal(make, **change))


def test_a_lot_is_frozen():
    lot = ParkingLot(**ONE_SLOT)
    with pytest.raises(FrozenInstanceError):
        lot.name = "two"
    for field in fields(lot):
        value = getattr(lot, field.name)
        if isinstance(value, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                value[...] = 0


def test_lots_compare_by_what_they_hold_and_pickle():
    lot = ParkingLot(**ONE_SLOT)
    assert lot == ParkingLot(**ONE_SLOT)
    assert lot == pickle.loads(pickle.dumps(lot))
    assert lot != ParkingLot(**{**ONE_SLOT, "goals": [[20.0, 11.0]]})
    assert lot != ParkingLot(**{**ONE_SLOT, "lanes": (Lane([[0.0, 0.0], [20.0, 0.0]], oneway=True),)})
    assert lot != "one"


def test_grid_is_laid_out_as_documented():
    lot = grid_lot(4, 3, pitch=2.5, depth=5.0, aisle=6.0)
    assert lot.slot_ids[:4] == ("0-0", "0-1", "0-2", "1-0")
    by_id = dict(zip(lot.slot_ids, lot.slot_xy, strict=True))
    assert by_id["0-0"][1] < 0.0 < by_id["1-0"][1]  # either side of the south aisle
    np.testing.assert_allclose(by_id["2-0"] - by_id["1-0"], (0.0, 5.0))  # back to back
    np.testing.assert_allclose(by_id["0-1"] - by_id["0-0"], (2.5, 0.0))
    np.testing.assert_allclose(lot.entries, [[-3.0, 0.0]])
    assert lot.goals[0, 0] > lot.slot_corners()[..., 0].max()
    assert overlapping_slots(lot) == 0


def test_angled_row_touches_its_line_and_does_not_overlap():
    slots = bay_row((1.0, 2.0), 0.0, 5, angle=np.radians(60.0))
    lanes = (Lane([[0.0, 0.0], [30.0, 0.0]]),)
    lot = ParkingLot(**ONE_SLOT | {"slot_ids": tuple("abcde"), **slots.columns(), "lanes": lanes})
    assert lot.slot_corners()[..., 1].min() == pytest.approx(2.0)
    assert overlapping_slots(lot) == 0
    np.testing.assert_allclose(lot.slot_yaw, np.radians(60.0))


@pytest.mark.parametrize("n_slots", [1, 37, 600])
def test_city_has_exactly_the_slots_asked_for_and_every_place_leads_to_every_other(n_slots):
    lot = city_lot(n_slots, seed=3)
    assert lot.n_slots == n_slots
    assert len(lot.entries) == len(lot.goals) == 1
    assert connected_components(lot.drive_matrix(), connection="strong")[0] == 1
    assert overlapping_slots(lot) == 0
    assert any(lane.oneway for lane in lot.lanes) or n_slots < 600


def test_city_is_the_same_for_the_same_seed_only():
    assert city_lot(300, seed=1) == city_lot(300, seed=1)
    assert city_lot(300, seed=1) != city_lot(300, seed=2)


def test_city_parks_at_the_kerb_and_clear_of_crossings():
    lot = city_lot(2000, seed=5)
    assert set(zip(lot.slot_length, lot.slot_width, strict=True)) == {KERB_SIZE}
    lanes = shapely.union_all([shapely.LineString(lane.points) for lane in lot.lanes])
    distance = shapely.distance(shapely.points(lot.mouth_xy()), lanes)
    assert distance.min() > LANE_OFFSET
    assert distance.max() < 3.01
    crossings = lot.vertex_xy[lot.n_slots :]
    to_crossing = shapely.distance(shapely.polygons(lot.slot_corners()), shapely.multipoints(crossings))
    assert to_crossing.min() >= CROSSING_CLEARANCE - 0.01
    houses = shapely.union_all(shapely.polygons([wall[:4] for wall in lot.walls]))
    assert not shapely.intersects(shapely.polygons(lot.slot_corners()), houses).any()
    assert not shapely.intersects(houses, lanes)
    assert not shapely.contains_xy(houses, *lot.goals.T).any()


def test_city_numbers_neighbours_near_each_other():
    lot = city_lot(5000, seed=0)
    step = np.hypot(*np.diff(lot.slot_xy, axis=0).T)
    assert np.median(step) < 10.0
    assert np.mean(step) < 60.0


@pytest.mark.parametrize("name", ["street", "mini"])
def test_every_packaged_lot_can_be_drawn(name, tmp_path):
    path = tmp_path / f"{name}.png"
    save_lot_picture(packaged_lot(name), path, show_graph=name == "mini")
    assert path.read_bytes().startswith(b"\x89PNG")


def test_slots_take_one_colour_each():
    lot = packaged_lot("mini")
    colors = np.linspace(0.0, 1.0, 4 * lot.n_slots).reshape(-1, 4)
    ax = Figure().add_subplot()
    draw_lot(lot, ax, slot_color=colors)
    drawn = [c.get_facecolor() for c in ax.collections if isinstance(c, PolyCollection)]
    assert any(np.shape(c) == colors.shape and np.allclose(c, colors) for c in drawn)
