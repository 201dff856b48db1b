"""Small maps and the lots that they become, recorded; and what holds of every lot.

    python tests/test_golden_maps.py    records them again

A change of a lot on purpose is recorded with it; `git diff` shows which slots, lanes, entries or reasons changed.
"""

import itertools
import json
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import shapely
from made_maps import AISLE, SERVICE, SPACE, STREET, Map, car_park, grid, one_street, outline_alone
from scipy.sparse.csgraph import dijkstra

from parkenv.errors import InputError
from parkenv.lots.generators import nearest_on_lanes
from parkenv.lots.town.draft import import_town
from parkenv.world.drive_graph import SLOT_REACH

GOLDENS = Path(__file__).with_name("golden_maps.json")
KERBS = {"highway": "residential", "parking:both": "lane"}
NONE, LEFT = {"parking:both": "no"}, {"restriction": "no_left_turn"}


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
    tags = {"highway": "residential", "parking:left": "lane"}
    place = car_park().way([(-60, 10), (-4, 10), (-4, 60)], tags)
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


def restricted(**relation):
    """Two streets that cross, a way for each arm, kerbs beside all, and a restriction from the west to the north."""
    place = Map()
    for x, y in ((-1, 0), (1, 0), (0, 1), (0, -1)):
        place.way([(200 * x, 200 * y), (100 * x, 100 * y), (0, 0)], STREET, **{"parking:both": "lane"})
    corners = [(-200, 200), (200, 200), (200, -200), (-200, -200), (-200, 200)]
    for (x0, y0), (x1, y1) in itertools.pairwise(corners):
        place.way([(x0, y0), ((x0 + x1) // 2, (y0 + y1) // 2), (x1, y1)], STREET)
    if relation:
        place.turn(1, (0, 0), 3, **relation)
    place.way([(200, 0), (400, 0)], STREET)
    return place.node(10, 10, entrance="main")


def speeds():
    place, said = grid(), {-60: "30", -80: "25 mph", -90: "walk"}
    for y in (-40, *said):
        tags = {"maxspeed": said[y]} if y in said else {}
        place.way([(0, -100 if y == -90 else y - 10), (150, y - 10)], {"highway": "primary"}, **tags)
        place.way([(0, 0), (0, y - 10)], STREET)
    return place


def car_parks():
    """By tags, with an open outline, as where the edge of a map cuts it; private; and with levels, by its node."""
    p1 = {"amenity": "parking", "name": "P1", "capacity": "77", "capacity:disabled": "4"}
    place = grid(**NONE).way([(20, 20), (60, 20), (60, 60), (20, 60)], p1)
    place.box(80, 20, 120, 60, {"amenity": "parking", "name": "P2", "access": "private"})
    garage = {"amenity": "parking", "parking": "multi-storey", "fee": "yes", "building:levels": "3"}
    place.box(140, 20, 180, 60, garage, name="P3")
    return place.node(160, 62, amenity="parking_entrance").node(230, 230, amenity="parking", name="P4")


def drawn_in_part():
    place = grid(**NONE).way([(20, 0), (20, 60)], SERVICE).way([(20, 30), (60, 30)], AISLE)
    place.box(15, 20, 65, 45, {"amenity": "parking", "name": "Markt", "capacity": "20", "maxstay": "2 hours"})
    for k in range(8):
        x, tags = 22 + 2.5 * k, {"parking_space": "disabled"} if k == 0 else {}
        place.box(x, 33, x + 2.5, 38, SPACE, **tags)
    return place


def entrances():
    place = grid(**NONE).box(20, 20, 60, 60, {"amenity": "parking", "parking": "underground"})
    place.node(70, 40, amenity="parking_entrance").node(230, 230, amenity="parking_entrance", name="Dom")
    place.node(240, 230, amenity="parking_entrance")
    return place.node(230, 30, amenity="parking_entrance", capacity="80")


UNREAD = {"parking:both": "lane", "parking:left:times": "Mo-Fr", "parking:left:orientation": "diagonal"}
UNREAD |= {"parking:lane:both:conditional": "no @ (We)", f"{RIGHT}:maxstay:conditional": "1 h @ (Mo-Fr)"}
ODD = {"amenity": "parking", "capacity": "9", "access": "yes", "access:times": "Mo", "fee:note": "x"}
ODD |= {"capacity:hgv": "4", "opening_hours:covid19": "off", "charge:rate": "2"}
ODD |= {"maxstay:conditional": "1 h @ (Mo)"}
TOWNS = {
    "streets: apart": grid()
    .way([(2500, 1400), (2550, 1400)], STREET, name="Inselweg")
    .way([(500, 0), (2500, 0)], STREET, oneway="yes", name="Fernweg"),
    "speeds: tagged, else by class": speeds(),
    "kerbs: none": grid(**NONE).box(90, 90, 110, 100, {"amenity": "parking"}),
    "kerbs: none, old": grid(**{"parking:lane:both": "no_parking"}).box(
        90, 90, 110, 100, {"amenity": "parking"}
    ),
    "kerbs: right": grid(**{"parking:left": "no", "parking:right": "lane"}),
    "kerbs: left, old": grid(**{"parking:lane:left": "parallel", "parking:lane:right": "no_stopping"}),
    "kerbs: capacity": grid(**{RIGHT: "lane", f"{RIGHT}:capacity": "31", "parking:left": "no"}),
    "car parks: by tags, area and levels": car_parks(),
    "car parks: drawn in part": drawn_in_part(),
    "car parks: far or closed": grid()
    .box(1000, 1000, 1040, 1040, {"amenity": "parking"})
    .box(90, 90, 95, 95, {"amenity": "parking", "access": "no"}),
    "garages: entrances": entrances(),
    "rules: keys that nobody reads": grid(**UNREAD).box(20, 20, 60, 50, ODD),
    "goals: along streets": Map()
    .way([(0, 0), (300, 0)], STREET, **{"parking:both": "lane"})
    .way([(0, 90), (300, 90)], STREET, **{"parking:both": "lane"})
    .way([(0, 0), (0, 300)], STREET)
    .way([(90, 0), (90, 300)], STREET),
    "turns: none": restricted(),
    "turns: left": restricted(**LEFT),
    "turns: only": restricted(restriction="only_straight_on"),
    "turns: cars": restricted(**{"restriction:motorcar": "no_left_turn", "except": "bicycle; psv"}),
    "turns: except cars": restricted(**LEFT, **{"except": "psv; motorcar"}),
    "turns: hours": restricted(**{"restriction:conditional": "no_left_turn @ (Mo-Fr 07:00-09:00)"}),
    "turns: lorries": restricted(**{"restriction:hgv": "no_left_turn"}),
    "turns: unknown": restricted(restriction="no_flying"),
    "turns: no via": restricted(**LEFT, roles=("from", "to")),
    "turns: two vias": restricted(**LEFT, roles=("from", "via", "via", "to")),
}


MAPS |= {"turns: restricted": restricted(**LEFT), "turns: away": car_park().turn(1, (0, -20), 2, **LEFT)}


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


def described_town(name, folder):
    """What a town of a map is, in values that a reader can compare."""
    town = import_town(TOWNS[name].write(folder / "town.osm"))
    draft, lot = town.draft, town.draft.lot()
    columns = ("name", "kind", "capacity", "capacity_from", "tagged", "slots", "zone")
    return lot, {
        "facilities": [[row[column] for column in columns] for row in town.facilities],
        "known": {f.name: [f.kind, f.zone, f.known, f.capacity] for f in lot.facilities if f.is_counted},
        "zones": {name: [list(zone.users), zone.max_stay_s] for name, zone in lot.zone_rules.items()},
        "slots": Counter(lot.slot_zone.tolist()),
        "speeds": sorted({round(lane.speed, 2) for lane in lot.lanes}),
        "vertices": [len(lot.entries), len(lot.goals), lot.n_vertices],
        "goals": (lot.goals.min(axis=0).round() + 0.0).tolist()
        + (lot.goals.max(axis=0).round() + 0.0).tolist(),
        "turns": [[turn.only, *(turn.points - turn.points[1]).round(1).tolist()] for turn in lot.turns],
        "left_out": {left.reason: list(left.ids) for left in draft.left_out},
        "unread": [[row.tag, row.value, row.count, row.assumed] for row in draft.unread],
        "guesses": list(draft.guesses),
        "found": [line for line in draft.found if not line.startswith("frame")],
    }


@pytest.mark.parametrize("name", TOWNS)
def test_a_map_becomes_its_town(tmp_path, name):
    lot, town = described_town(name, tmp_path)
    assert json.loads(json.dumps(town)) == json.loads(GOLDENS.read_text(encoding="utf-8"))[name]
    assert lot.capacity.sum() == sum(capacity for _, _, capacity, *_ in town["facilities"])
    reached = dijkstra(lot.drive_matrix(), indices=np.arange(0, lot.n_slots, 97))
    assert np.isfinite(reached[:, : lot.n_slots]).all()


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
        lots |= {name: described_town(name, Path(place))[1] for name in TOWNS}
    lines = [f"{json.dumps(name)}: {json.dumps(lot, ensure_ascii=False)}" for name, lot in lots.items()]
    GOLDENS.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
