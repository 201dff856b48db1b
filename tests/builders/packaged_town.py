"""The packaged lot `town`: a made town with every kind of supply, for searches and days with many cars.

Nine by nine blocks between ten streets each way. Kerbs cost the more the farther in they are, in three tariffs; every
fifth street outside the centre is for residents alone. Four main streets, without kerbs to park at, bring cars
from outside. Four garages and a station's car park are counted, three car parks are drawn.
"""

from itertools import pairwise

import numpy as np
import shapely

from parkenv.lots.generators import BUILDING_SETBACK, Slots, StreetGrid, bay_row, outlines
from parkenv.world.facility import Facility
from parkenv.world.lot import Lane, ParkingLot
from parkenv.world.tariff import Hours, Price, Zone

N_BLOCKS = 9
MAIN = (2, 7)
"""Streets, of each direction, that lead out of town."""
INNER = (3, 6)
"""Streets between which the centre is."""
KEPT = (0.6, 0.66, 0.95)
"""Share of the room at kerbs where cars may park, from the centre out; driveways and trees have the rest."""
AISLE_HALF_WIDTH = 3.0
OUTSIDE = 60.0
"""Length of a main street beyond the last crossing, m."""

WORKDAYS = Hours.parse("Mo-Sa 08:00-20:00")
ZONES = (
    Zone("centre", Price(1.8, charged=WORKDAYS), max_stay_s=2 * 3600.0),
    Zone("ring", Price(0.9, daily_cap=3.0, charged=WORKDAYS)),
    Zone("outer", Price(0.5, daily_cap=2.0, charged=WORKDAYS)),
    Zone("residents", users=("permit-a",)),
    Zone("garage", Price(0.8, steps=((3600.0, 0.8), (7200.0, 1.6)), daily_cap=3.5)),
    Zone("station", Price(0.3, daily_cap=1.5)),
    Zone("market", Price(1.5, free_s=1800.0), max_stay_s=3 * 3600.0, hours=Hours.parse("Mo-Sa 06:00-22:00")),
    Zone("disabled", users=("disabled",)),
    Zone("charging", Price(per_kwh=0.1), max_stay_s=4 * 3600.0, users=("charging",)),
    Zone("delivery", max_stay_s=1800.0, users=("delivery",)),
    Zone("staff", users=("staff",)),
)
GARAGES = (
    ("Market garage", 340, (3, 5), "live"),
    ("Theatre garage", 260, (5, 3), "live"),
    ("Arcade garage", 220, (4, 4), "sign"),
    ("Hospital garage", 180, (6, 7), "sign"),
)
"""Name, capacity, block and what drivers know."""
CAR_PARKS = (("Market square", (4, 2), "market"), ("Town hall", (5, 6), "ring"), ("Works", (2, 5), "staff"))
"""Name, block and zone of those whose spaces are drawn."""
BAYS = (("disabled", 17, 3), ("charging", 23, 5), ("delivery", 29, 11))
"""Zone of single bays in the centre and the ring: each so-many-th slot, from the so-many-th on."""

PURPOSES = ("residents", "commuters", "shoppers", "visitors", "deliveries")
COMING_FAR = ("commuters", "visitors")
EVEN, FAR = (3.0, 2.0, 2.0, 1.0, 3.0, 2.0, 2.0, 1.0), (5.0, 2.0, 2.0, 1.0, 5.0, 1.0, 2.0, 1.0)
"""Weights of the eight entries: most cars come from the west and the south."""


def town():
    """Create the town."""
    rng = np.random.default_rng(2014)
    streets = _streets(rng)
    blocks, lanes = streets.blocks(), _lanes_of(streets)
    slots, names = _kerbs(streets, rng)
    car_parks = [_car_park(lanes, blocks[at], name, zone) for name, at, zone in CAR_PARKS]
    slots = Slots.joined([slots, *car_parks])
    facilities = [Facility(name, "kerb") for name in names]
    facilities += [Facility(str(part.facility[0]), "lot", str(part.zone[0])) for part in car_parks]
    for name, capacity, block, known in GARAGES:
        facilities.append(_garage(name, capacity, blocks[block], known))
    station = tuple(blocks[1, 1].mean(axis=0))
    facilities.append(Facility("Station car park", "lot", "station", 150, station, 6.0, (20.0, 60.0), "sign"))
    goals, goal_weights = _goals(blocks)
    built = np.ones(blocks.shape[:2], np.bool_)
    for _, at, _ in CAR_PARKS:
        built[at] = False
    return ParkingLot(
        name="town",
        slot_ids=tuple(map(str, range(1, len(slots) + 1))),
        **slots.columns(),
        lanes=tuple(Lane(np.round(points, 3), oneway) for points, oneway in lanes),
        entries=np.round(_outer_ends(streets), 3),
        goals=goals,
        walls=tuple(np.round(outline, 3) for outline in outlines(blocks[built], BUILDING_SETBACK)),
        facilities=tuple(facilities),
        zone_rules={zone.name: zone for zone in ZONES},
        goal_weights=goal_weights,
        entry_weights={name: np.array(FAR if name in COMING_FAR else EVEN) for name in PURPOSES},
    )


def _streets(rng):
    """Draw the crossings; minor streets between the main ones are one-way in turn."""
    n = N_BLOCKS + 1
    at = np.stack(np.meshgrid(np.arange(n) * 92.0, np.arange(n) * 78.0), axis=-1)
    crossings = at + np.round(rng.uniform(-7.0, 7.0, at.shape), 3)
    oneway = np.array([0, 1, 0, -1, 1, -1, 1, 0, -1, 0])
    return StreetGrid(crossings, along=oneway, across=-oneway)


def _lanes_of(streets):
    """Return the streets, the main ones as far as the edge of the town."""
    lanes = [(lane.points, lane.oneway) for lane in streets.lanes()]
    ends = _outer_ends(streets).reshape(-1, 2, 2)
    for (first, last), number in zip(ends, [*MAIN, *(N_BLOCKS + 1 + k for k in MAIN)], strict=True):
        lanes[number] = (np.vstack([first, lanes[number][0], last]), False)
    return lanes


def _outer_ends(streets):
    """Return both ends of each main street, (8, 2) m: those along from west and east, then from south and north."""
    p, ends = streets.crossings, []
    for points in [*p[list(MAIN)], *p[:, list(MAIN)].swapaxes(0, 1)]:
        for end, inner in ((points[0], points[1]), (points[-1], points[-2])):
            ends.append(end + OUTSIDE * (end - inner) / np.hypot(*(end - inner)))
    return np.array(ends)


def _kerbs(streets, rng):
    """Return the slots at kerbs with their zones and facilities, one for each side of a block, and their names."""
    slots = streets.kerb_slots(outer=False)
    segments, names, levels = [], [], []
    n = N_BLOCKS + 1
    for way, lines in (("street", streets.crossings), ("row", streets.crossings.swapaxes(0, 1))):
        for number, points in enumerate(lines):
            for k, pair in enumerate(pairwise(points)):
                segments.append(np.array(pair))
                names.append(f"{_ORDINALS[number]} {way}, {_ORDINALS[k]} block")
                inside = INNER[0] <= number <= INNER[1] and INNER[0] <= k < INNER[1]
                near = INNER[0] - 2 <= number <= INNER[1] + 2 and INNER[0] - 2 <= k < INNER[1] + 2
                levels.append(-1 if number in MAIN else 0 if inside else 1 if near else 2)
    assert len(segments) == 2 * n * N_BLOCKS
    lines = np.asarray(shapely.linestrings(np.array(segments)))
    at = np.asarray(shapely.STRtree(lines).nearest(np.asarray(shapely.points(slots.xy))))
    level = np.array(levels)[at]
    kept = (rng.random(len(slots)) < np.array(KEPT)[level]) & (level >= 0)
    slots, at, level = slots[kept], at[kept], level[kept]
    zone = np.array(["centre", "ring", "outer"], dtype="<U9")[level]
    # Every fifth street of the ring and around it is for residents alone.
    zone[(level > 0) & (at % 5 == 0)] = "residents"
    for name, each, first in BAYS:
        of_all = (level <= 1) & (zone != "residents")
        zone[np.flatnonzero(of_all)[first::each]] = name
    facility, order = np.array(names)[at], np.lexsort((np.arange(len(slots)), at))
    made = Slots(
        np.round(slots.xy, 3), np.round(slots.yaw, 9), slots.length, slots.width, slots.mouth,
        zone=zone, facility=facility,
    )[order]  # fmt: skip
    return made, list(dict.fromkeys(made.facility.tolist()))


_ORDINALS = ("1st", "2nd", "3rd", "4th", "5th", "6th", "7th", "8th", "9th", "10th")


def _car_park(lanes, block, name, zone):
    """Return two rows along an aisle through a block, from street to street, which joins the lanes."""
    south, north = (np.round((block[a] + block[b]) / 2, 3) for a, b in ((0, 1), (3, 2)))
    for end, corners in ((south, block[:2]), (north, block[2:])):
        _join(lanes, end, corners)
    lanes.append((np.stack([south, north]), False))
    reach, heading = np.hypot(*(north - south)), np.arctan2(*(north - south)[::-1])
    ahead = (north - south) / reach
    left = np.array([-ahead[1], ahead[0]])
    n, margin = int((reach - 24.0) / 2.5), 12.0
    rows = [
        bay_row(south + margin * ahead + AISLE_HALF_WIDTH * left, heading, n),
        bay_row(north - margin * ahead - AISLE_HALF_WIDTH * left, heading + np.pi, n),
    ]
    row = Slots.joined(rows)
    return Slots(
        np.round(row.xy, 3), np.round(row.yaw, 9), row.length, row.width, row.mouth,
        zone=np.full(len(row), zone, "<U9"), facility=np.full(len(row), name),
    )  # fmt: skip


def _join(lanes, at, corners):
    """Insert a point into the street between two crossings."""
    for number, (points, oneway) in enumerate(lanes):
        for k, pair in enumerate(pairwise(points)):
            if all(np.any(np.all(np.isclose(corner, pair), axis=1)) for corner in corners):
                lanes[number] = (np.insert(points, k + 1, at, axis=0), oneway)
                return
    raise AssertionError(f"no street between {corners}")


def _garage(name, capacity, block, known):
    """Return a garage that is entered from the south side of its block."""
    xy = tuple(np.round((block[0] + block[1]) / 2 + np.array([0.0, BUILDING_SETBACK]), 3))
    delay_s = 60.0 if known == "live" else 0.0
    return Facility(name, "garage", "garage", capacity, xy, 8.0, (40.0, 150.0), known, delay_s)


def _goals(blocks):
    """Return a goal for each inner block, and one for each two by two of the others, with their weights by purpose."""
    at, weights, middle = [], [], blocks.mean(axis=2)
    for i, j in np.ndindex(N_BLOCKS, N_BLOCKS):
        if 2 <= i <= 6 and 2 <= j <= 6:
            centre = 3 <= i <= 5 and 3 <= j <= 5
            at.append(middle[i, j])
            weights.append((4.0, 6.0, 8.0, 3.0, 4.0) if centre else (6.0, 4.0, 2.0, 3.0, 2.0))
        elif i % 2 == 0 and j % 2 == 0:
            near = middle[i : i + 2, j : j + 2].reshape(-1, 2)
            at.append(near[-1])
            weights.append(tuple(each * len(near) for each in (7.0, 1.5, 0.2, 1.5, 0.6)))
    return np.round(np.array(at), 3), dict(zip(PURPOSES, np.array(weights).T, strict=True))
