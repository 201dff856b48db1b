"""The packaged lot `kerbs`: a made district of streets with cars at their kerbs.

Five by five blocks of different sizes, some streets one-way, seven that lead out of the district.
`python tests/builders/packaged.py` writes the file.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import shapely

from parkenv.lots.generators import BUILDING_SETBACK, StreetGrid, outlines
from parkenv.world.facility import Facility
from parkenv.world.lot import Lane, ParkingLot

N = 5
BLOCKS = (58, 84, 100, 124, 172), (56, 70, 82, 96, 124)  # widths and depths, m
ALONG, ACROSS = (0, 1, 0, -1, 0, 0), (0, -1, 0, 1, -1, 0)  # directions of the streets; 0 for both
LEADS_OUT = (0, 2, 4, 5)  # streets along, to the west or the east, and across, to the south or the north
LEAST_BAYS, OUTSIDE = 4, 60.0


def kerbs():
    """Create the district."""
    rng = np.random.default_rng(51)
    x, y = (np.cumsum([0, *rng.permutation(sizes)]) for sizes in BLOCKS)
    crossings = np.stack(np.meshgrid(x, y), axis=-1) + rng.uniform(-5.0, 5.0, (N + 1, N + 1, 2))
    streets = StreetGrid(np.round(crossings, 3), np.array(ALONG), np.array(ACROSS))
    lanes, ends = streets.lanes(), []
    for number, lane in enumerate(lanes):
        if number % (N + 1) in LEADS_OUT and not lane.oneway:
            points = lane.points
            outer = [a + OUTSIDE * (a - b) / np.hypot(*(a - b)) for a, b in (points[:2], points[:-3:-1])]
            lanes[number] = Lane(np.round(np.vstack([outer[0], points, outer[1]]), 3))
            ends += outer
    slots, face, names = _bays(streets, rng)
    blocks = streets.blocks()
    side = rng.integers(0, 4, (N, N))
    doors = [
        middle + (front - middle) * (1.0 - BUILDING_SETBACK / np.hypot(*(front - middle)))
        for corners, k in zip(blocks.reshape(-1, 4, 2), side.ravel(), strict=True)
        for middle, front in [(corners.mean(axis=0), (corners[k] + corners[(k + 1) % 4]) / 2)]
    ]
    return ParkingLot(
        name="kerbs",
        slot_ids=tuple(map(str, range(1, len(slots) + 1))),
        **replace(slots, facility=np.array(names)[face]).columns(),
        lanes=tuple(lanes),
        entries=np.round(ends, 3),
        goals=np.round(doors, 3),
        walls=tuple(np.round(outline, 3) for outline in outlines(blocks.reshape(-1, 4, 2), BUILDING_SETBACK)),
        facilities=tuple(Facility(name, "kerb") for name in dict.fromkeys(np.array(names)[face].tolist())),
    )


def _bays(streets, rng):
    """Return the bays, the block face of each, and the names of the faces: street, block, side."""
    slots = streets.kerb_slots(outer=False)
    lines, names = [], []
    for way, points in (("street", streets.crossings), ("avenue", streets.crossings.swapaxes(0, 1))):
        for number, street in enumerate(points, 1):
            for block, ends in enumerate(pairwise(street), 1):
                lines.append(ends)
                names += [f"{way} {number}, block {block}, {side}" for side in ("left", "right")]
    lines = np.array(lines)
    at = np.asarray(shapely.STRtree(shapely.linestrings(lines)).nearest(shapely.points(slots.xy)))
    along, across = lines[at, 1] - lines[at, 0], slots.xy - lines[at, 0]
    face = 2 * at + (along[:, 0] * across[:, 1] < along[:, 1] * across[:, 0])
    # Driveways, trees, bus stops: a face keeps 30 to 100 % of its room, and none if that is for less than four.
    kept = rng.random(len(slots)) < rng.uniform(0.3, 1.0, len(names))[face]
    kept &= np.bincount(face[kept], minlength=len(names))[face] >= LEAST_BAYS
    order = np.flatnonzero(kept)[np.argsort(face[kept], kind="stable")]
    slots = replace(slots[order], xy=np.round(slots.xy[order], 3), yaw=np.round(slots.yaw[order], 9))
    return slots, face[order], names
