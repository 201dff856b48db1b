"""Small maps and the lots that they become, recorded; and what holds of every lot.

    python tests/test_golden_maps.py    records them again

A change of a lot on purpose is recorded with it; `git diff` shows which slots, lanes, entries or reasons changed.
"""

import json
import tempfile
from pathlib import Path

import numpy as np
import pytest
import shapely
from made_maps import AISLE, SERVICE, SPACE, STREET, Map, car_park, one_street, outline_alone
from scipy.sparse.csgraph import dijkstra

from parkenv.errors import InputError
from parkenv.lots.generators import nearest_on_lanes
from parkenv.world.drive_graph import SLOT_REACH

GOLDENS = Path(__file__).with_name("golden_maps.json")
KERBS = {"highway": "residential", "parking:both": "lane"}


def private_parking():
    place = car_park()
    place.ways[27] = (place.ways[27][0], {"amenity": "parking", "access": "private"})
    return place


def slanted():
    place = Map().way([(-20, -9), (0, -9), (60, -9)], STREET).way([(0, -9), (0, 0)], SERVICE)
    place.way([(0, 0), (50, 0)], AISLE).box(20, 20, 30, 30, {"building": "yes"})
    for k in range(8):
        x = 6 + 2.9 * k
        place.way([(x, 3), (x + 2.9, 3), (x + 5.4, 7.33), (x + 2.5, 7.33), (x, 3)], SPACE)
    return place


def street_nearer():
    place = car_park().way(
        [(-60, 10), (-4, 10), (-4, 60)], {"highway": "residential"}, **{"parking:left": "lane"}
    )
    return place.way([(-4, 10), (55, 10.0)], {"highway": "unclassified"})


def holes():
    place = outline_alone().box(10, 4, 20, 7, {"building": "kiosk"})
    place.box(30, -7, 40, -4, {}).area([4], [7], amenity="parking")
    place.ways[3] = (place.ways[3][0], {})
    return place


def blind_ends():
    place = Map().way([(0, 0), (60, 0)], KERBS).way([(60, 0), (60, 40)], KERBS).way([(60, 0), (90, 0)], KERBS)
    place.node(60, 40, noexit="yes").node(90, 0, highway="turning_circle")
    return place.box(9, 9, 20, 20, {"building": "yes"})


def edge_of_map():
    place = Map().way([(-500, 0), (60, 0)], KERBS | {"parking:both": "no"}).way([(60, 0), (60, 40)], KERBS)
    return place.box(9, 9, 20, 20, {"building": "yes"})


def nearest_building():
    place = car_park().box(100, 30, 120, 50, {"building": "yes"}).box(0, 26, 4, 28, {"building": "garage"})
    for point in ((25, 30), (10, 40)):
        place.nodes[point].clear()
    return place


def space(**tags):
    return car_park().box(42, 3, 44.5, 8, SPACE, **tags)


def crossing(kind):
    place = Map().way([(0, 0), (50, 0), (100, 0)], STREET, **{"parking:both": "lane"})
    return place.way([(50, 0), (50, 60)], {"highway": kind}).box(20, 20, 30, 30, {"building": "yes"})


RIGHT = "parking:right"
MAPS = {
    "car park": car_park(),
    "space: private": space(access="private"),
    "space: private, but cars": space(access="private", motorcar="yes"),
    "space: customers": space(access="customers"),
    "space: motorcycle": space(parking_space="motorcycle"),
    "space: disabled": space(**{"capacity:disabled": "1"}),
    "space: underground": space(level="-1"),
    "private parking": private_parking(),
    "several cars": car_park().box(38, 3, 48, 8, SPACE, capacity="4").box(38, -8, 48, -3, SPACE),
    "slanted": slanted(),
    "a street is nearer": street_nearer(),
    "no aisle": car_park().box(8, 60, 10.5, 65, SPACE),
    "no way leads there": car_park().way([(-40, 20), (0, 20)], AISLE, oneway="yes").box(-20, 23, -17.5, 28, SPACE),
    "points": car_park().node(99, 9, amenity="parking").node(98, 9, amenity="parking_space"),
    "outline": outline_alone(),
    "outline: capacity": outline_alone(capacity="12"),
    "outline: less disabled": outline_alone(capacity="12", **{"capacity:disabled": "2"}),
    "outline: odd capacity": outline_alone(capacity="dozens"),
    "outline: too great a capacity": outline_alone(capacity="400"),
    "outline: holes": holes(),
    "outline: underground": outline_alone(parking="underground"),
    "outline: private": outline_alone(access="private"),
    "outline: no aisle": outline_alone().box(100, 100, 120, 120, {"amenity": "parking"}),
    "kerb: left": one_street(**{"parking:left": "lane"}),
    "kerb: both": one_street(**{"parking:both": "lane"}),
    "kerb: across": one_street(**{RIGHT: "street_side", f"{RIGHT}:orientation": "perpendicular"}),
    "kerb: slanted": one_street(**{"parking:both": "lane", "parking:both:orientation": "diagonal"}),
    "kerb: few": one_street(**{RIGHT: "lane", f"{RIGHT}:capacity": "5"}),
    "kerb: tight": one_street(**{RIGHT: "lane", f"{RIGHT}:capacity": "18"}),
    "kerb: too many": one_street(**{RIGHT: "lane", f"{RIGHT}:capacity": "50"}),
    "kerb: forbidden": one_street(**{RIGHT: "lane", f"{RIGHT}:restriction": "no_parking"}),
    "kerb: no stopping": one_street(**{"parking:both": "lane", "parking:both:restriction": "no_stopping"}),
    "kerb: private": one_street(**{RIGHT: "lane", f"{RIGHT}:access": "private"}),
    "kerb: forbidden, old": one_street(**{"parking:lane:right": "parallel", "parking:condition:right": "no_parking"}),
    "kerb: unknown": one_street(**{RIGHT: "lane", f"{RIGHT}:orientation": "upright"}),
    "width: one lane": one_street(**{RIGHT: "lane"}, lanes="1"),
    "width: main street": one_street(**{RIGHT: "lane", "highway": "primary"}),
    "width: living street": one_street(**{RIGHT: "lane", "highway": "living_street"}),
    "width: one-way": one_street(**{RIGHT: "lane"}, oneway="yes"),
    "width: tagged": one_street(**{RIGHT: "lane"}, width="10"),
    "width: on the kerb": one_street(**{RIGHT: "on_kerb"}, width="10 m"),
    "crossing: street": crossing("residential"),
    "crossing: service": crossing("service"),
    "crossing: footway": crossing("footway"),
    "one-way exit": car_park().way([(50, 0), (60, -20)], SERVICE, oneway="yes"),
    "second way in": car_park().way([(60, -20), (50, 0)], SERVICE, oneway="yes"),
    "blind ends": blind_ends(),
    "edge of the map": edge_of_map(),
    "nearest building": nearest_building(),
    "roof over slots": car_park().box(7, 2, 24, 9, {"building": "roof"}),
}  # fmt: skip


def described(name, folder):
    """What a map becomes, in values that a reader can compare, rounded to a centimetre."""
    draft = MAPS[name].draft(folder)
    slots = draft.slots
    heading = np.cos(slots.yaw), np.sin(slots.yaw)
    shape = np.column_stack([slots.xy, *heading, slots.length, slots.width, slots.mouth]).round(2) + 0.0
    return draft, {
        "slots": dict(zip(draft.slot_ids, shape.tolist(), strict=True)),
        "lanes": [[lane.oneway, *(lane.points.round(2) + 0.0).tolist()] for lane in draft.lanes],
        **{part: (getattr(draft, part).round(2) + 0.0).tolist() for part in ("entries", "goals")},
        "walls": len(draft.walls),
        "left_out": {left.reason: list(left.ids) for left in draft.left_out},
        "found": [line for line in draft.found if not line.startswith("frame")],
        "missing": len(draft.missing),
    }


@pytest.mark.parametrize("name", MAPS)
def test_a_map_becomes_its_lot(tmp_path, name):
    golden = json.loads(GOLDENS.read_text(encoding="utf-8"))[name]
    draft, lot = described(name, tmp_path)
    assert list(lot["slots"]) == list(golden["slots"])
    for part, values in lot.items():
        if part in ("slots", "lanes", "entries", "goals"):
            np.testing.assert_allclose(_numbers(values), _numbers(golden[part]), atol=0.03, err_msg=part)
        else:
            assert values == golden[part], part
    if draft.missing:
        with pytest.raises(InputError):
            draft.lot()
    else:
        assert_sound(draft.lot())


def _numbers(values):
    """All numbers of nested lists and tables, in order."""
    if isinstance(values, dict | list):
        parts = values.values() if isinstance(values, dict) else values
        return [n for part in parts for n in _numbers(part)]
    return [values]


def assert_sound(lot):
    """Slots do not overlap, open to a lane within reach, and can be reached from an entry."""
    boxes = shapely.polygons(lot.slot_corners())
    assert shapely.area(shapely.union_all(boxes)) == pytest.approx(shapely.area(boxes).sum(), rel=0.02)
    mouth = lot.mouth_xy()
    to_lane = nearest_on_lanes(lot.lanes, mouth)[0] - mouth
    assert np.hypot(*to_lane.T).max() <= SLOT_REACH
    reach = dijkstra(lot.drive_matrix(), indices=lot.entry_vertices, min_only=True)
    assert np.isfinite(reach[: lot.n_slots]).all()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        lots = {name: described(name, Path(place))[1] for name in MAPS}
    lines = [f"{json.dumps(name)}: {json.dumps(lot, ensure_ascii=False)}" for name, lot in lots.items()]
    GOLDENS.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
