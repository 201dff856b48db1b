"""Build the packaged lots: `python tests/builders/packaged.py [FOLDER]`.

Sizes are in metres. Positions are rounded to a millimetre and angles to a nanoradian, so that the files do not
depend on the math library.
"""

import runpy
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely
from packaged_town import town

from parkenv.lots.formats.geojson import write_lot
from parkenv.lots.generators import BAY_SIZE, BUILDING_SETBACK, Slots, StreetGrid, bay_row
from parkenv.world.lot import Lane, ParkingLot

PACKAGED = Path(__file__).parents[2] / "parkenv" / "lots" / "packaged"
STREETS = Path(__file__).parents[2] / "examples" / "streets_v1" / "kerb_lot.py"
PITCH = BAY_SIZE[1]
AISLE = 6.0
EAST, WEST = 0.0, np.pi


def row(letter, start, heading, *runs, angle=np.pi / 2):
    """Create a row with planted islands: positive `runs` are numbers of slots, negative ones of omitted slots."""
    parts = []
    along = np.array([np.cos(heading), np.sin(heading)]) * PITCH / np.sin(angle)
    at = np.array(start)
    for n in runs:
        if n > 0:
            parts.append(bay_row(at, heading, n, angle=angle))
        at = at + abs(n) * along
    return letter, Slots.joined(parts)


def rectangle(x0, y0, x1, y1):
    """Return the closed outline of a rectangle, m."""
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]


def lot(name, rows, lanes, entries, goals, walls, turned=0.0):
    """Create a lot: number the slots row by row, rotate everything by `turned` rad, and round it."""
    turn = np.array([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]])

    def placed(points):
        return np.round(np.asarray(points, dtype=np.float64) @ turn.T, 3)

    slots = Slots.joined([part for _, part in rows])
    slots = replace(slots, xy=placed(slots.xy), yaw=np.round(slots.yaw + turned, 9))
    return ParkingLot(
        name=name,
        slot_ids=tuple(f"{letter}{i}" for letter, part in rows for i in range(1, len(part) + 1)),
        **slots.columns(),
        lanes=tuple(Lane(placed(points), oneway) for points, oneway in lanes),
        entries=placed(entries),
        goals=placed(goals),
        walls=tuple(map(placed, walls)),
    )


def campus():
    """A wide lot with double rows, modelled on the Freiburg campus (T Fig. 4.5); the northern aisle is one-way."""
    two_way = False
    south, middle, north = 0.0, 16.0, 32.0
    passage, east = 48.5, {south: 104.0, middle: 98.0, north: 92.0}
    half = AISLE / 2
    rows = [
        row("A", (102.0, south - half), WEST, 9, -1, 10, -1, 10, -1, 8),
        row("B", (4.5, south + half), EAST, 16),
        row("B'", (52.5, south + half), EAST, 18),
        row("C", (95.0, middle - half), WEST, 17),
        row("C'", (44.5, middle - half), WEST, 7, -1, 8),
        row("D", (4.5, middle + half), EAST, 8, -1, 7),
        row("D'", (52.5, middle + half), EAST, 15),
        row("E", (87.5, north - half), WEST, 14),
        row("E'", (44.5, north - half), WEST, 16),
        row("F", (7.0, north + half), EAST, 9, -1, 9, -1, 8, angle=np.radians(60.0)),
    ]
    lanes = [
        ([(0.0, south), (passage, south), (east[south], south)], two_way),
        ([(0.0, middle), (passage, middle), (east[middle], middle)], two_way),
        ([(0.0, north), (passage, north), (east[north], north)], True),
        ([(0.0, south), (0.0, middle), (0.0, north)], two_way),
        ([(passage, south), (passage, middle), (passage, north)], two_way),
        ([(x, y) for y, x in east.items()], two_way),
        ([(-24.0, middle), (0.0, middle)], two_way),
    ]
    x, y = (112.0, 130.0, 130.0, 100.0, 103.0, 112.0, 112.0), (-14.0, -14.0, 48.0, 48.0, 36.0, 36.0, -14.0)
    faculty = [*zip(x, y, strict=True)]
    walls = [
        faculty,
        rectangle(-16.0, 24.0, -6.0, 40.0),
        [(-4.0, -11.0), (106.0, -11.0)],
        [(-4.0, 44.0), (92.0, 44.0)],
    ]
    return lot("campus", rows, lanes, [(-24.0, middle)], [(110.5, 14.0)], walls)


def jam():
    """A lot on a site that narrows to the north (after T Fig. 4.10), rotated by 11° like its street."""
    half, y = AISLE / 2, [0.0, 16.0, 32.0, 48.0]
    west, east = [0.0, 7.0, 14.0], 76.0
    rows = [
        row("A", (76.5, y[0] - half), WEST, 10, -1, 10, -1, 8),
        row("B", (8.0, y[0] + half), EAST, 12, -1, 12),
        row("C", (71.5, y[1] - half), WEST, 12, -1, 11),
        row("D", (14.0, y[1] + half), EAST, 11, -1, 11),
        row("E", (71.5, y[2] - half), WEST, 11, -1, 9),
        row("F", (24.0, y[2] + half), EAST, 19),
        row("G", (71.5, y[3] - half), WEST, 19),
        row("H", (39.0, y[3] + half), EAST, 13),
    ]
    lanes = [
        *(([(x, y_), (east, y_)], False) for x, y_ in zip([*west, 25.0], y, strict=True)),
        ([*zip(west, y[:3], strict=True)], False),
        ([(east, y_) for y_ in y], False),
        ([(-16.0, y[1]), (west[1], y[1])], False),
    ]
    walls = [
        [(-3.0, -11.0), (82.0, -11.0), (82.0, 12.0)],
        [(82.0, 20.0), (82.0, 60.0), (29.0, 60.0), (2.0, 37.0)],
        rectangle(86.0, 2.0, 104.0, 12.0),
        rectangle(86.0, 30.0, 104.0, 58.0),
    ]
    return lot("jam", rows, lanes, [(-16.0, y[1])], [(90.0, 20.0)], walls, turned=np.radians(11.0))


def street():
    """Kerbside slots around six city blocks with courtyards; three of the seven streets are one-way."""
    rows = (
        [(0.0, 0.0), (64.0, -3.0), (131.0, -4.0), (190.0, 0.0)],
        [(2.0, 55.0), (62.0, 53.0), (133.0, 56.0), (193.0, 58.0)],
        [(-2.0, 104.0), (61.0, 106.0), (130.0, 110.0), (188.0, 108.0)],
    )
    crossings = np.array(rows)
    streets = StreetGrid(crossings, along=np.array([0, -1, 0]), across=np.array([0, 1, -1, 0]))
    west, east = crossings[1, 0] - (28.0, 0.0), crossings[1, -1] + (28.0, 0.0)
    lanes = [(lane.points, lane.oneway) for lane in streets.lanes()]
    lanes += [(np.stack([west, crossings[1, 0]]), False), (np.stack([east, crossings[1, -1]]), False)]

    blocks = streets.blocks().reshape(-1, 4, 2)
    courtyard_side = np.array([0, 0, 1, 3, 2, 2])  # south, east, north or west of each block
    each = np.arange(len(blocks))
    gate = (blocks[each, courtyard_side] + blocks[each, (courtyard_side + 1) % 4]) / 2
    ways = shapely.linestrings(np.stack([gate, blocks.mean(axis=1)], axis=1))
    ways_in = shapely.buffer(ways, 2.5, cap_style="flat")
    block = shapely.polygons(blocks)
    depths = (BUILDING_SETBACK, BUILDING_SETBACK + 11.0)
    front, back = (shapely.buffer(block, -depth, join_style="mitre") for depth in depths)
    houses = shapely.normalize(shapely.difference(front, shapely.union(back, ways_in)))
    walls = [shapely.get_coordinates(house) for house in np.asarray(houses)]

    slots = streets.kerb_slots(outer=False)
    kept = np.asarray(~shapely.intersects(slots.boxes(), shapely.union_all(ways_in)))
    kept[4::12] = False
    goal = blocks[1].mean(axis=0) + np.array([7.0, 5.0])
    return lot("street", [("S", slots[kept])], lanes, [west, east], [goal], walls, turned=np.radians(-6.0))


def mini():
    """Ten slots on one aisle."""
    rows = [row("A", (15.0, -AISLE / 2), WEST, 6), row("B", (2.5, AISLE / 2), EAST, 2, -1, 2)]
    walls = [[(-1.0, -8.6), (16.0, -8.6)], rectangle(21.0, -7.0, 29.0, -2.0)]
    return lot("mini", rows, [([(-9.0, 0.0), (17.0, 0.0)], False)], [(-9.0, 0.0)], [(25.0, 0.0)], walls)


MAKERS = (campus, jam, street, mini, town, runpy.run_path(str(STREETS))["kerbs"])
LOTS = {make.__name__: make for make in MAKERS}


if __name__ == "__main__":
    for name, make in LOTS.items():
        write_lot(make(), Path(sys.argv[1] if len(sys.argv) > 1 else PACKAGED) / f"{name}.geojson")
