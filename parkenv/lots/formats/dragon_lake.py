"""The lot of the Dragon Lake Parking data set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import ConfigDict, Field, Strict

from parkenv.errors import naming
from parkenv.files.limited_reading import read_yaml
from parkenv.files.spec_file import Spec
from parkenv.lots.generators import Slots, bay_row
from parkenv.world.lot import Lane, ParkingLot

Metres = Annotated[float, Field(ge=-1e6, le=1e6)]
Point = Annotated[tuple[Metres, Metres], Strict(False)]


class _Part(Spec):
    """A part of the map, which may have further members."""

    model_config = ConfigDict(extra="ignore")


class _Line(_Part):
    bounds: Annotated[tuple[Point, Point], Strict(False)]


class _Waypoints(_Part):
    R1L: _Line
    R1R: _Line
    R2L: _Line
    R2R: _Line
    R3L: _Line
    R3R: _Line
    R4L: _Line
    R4R: _Line
    C1: _Line
    C2: _Line
    EXT: _Line


class _Rows(_Part):
    shape: Annotated[
        tuple[Annotated[int, Field(ge=1, le=2)], Annotated[int, Field(ge=1, le=1000)]], Strict(False)
    ]


class _Area(_Part):
    bounds: Annotated[tuple[Point, Point, Point, Point], Strict(False)]
    areas: Annotated[tuple[_Rows, ...], Strict(False), Field(min_length=1)]


class _Map(_Part):
    PARKING_AREAS: Annotated[dict[str, _Area], Field(min_length=1)]
    WAYPOINTS: _Waypoints


def dragon_lake_lot(path: Path) -> ParkingLot:
    """Read the lot of the Dragon Lake Parking data set from its `parking_map.yml`.

    Slots fill the `bounds` of each parking area in the rows and columns of its `shape`, with ids such
    as "A-0-13": area, row from the north, column from the west. The rows of an area are back to back and open
    to the aisles north and south of it; a single row opens to the nearer aisle. Aisles are the waypoint
    rows R1 to R4 from column C1 to their east ends, which are dead ends; C1 and C2 connect them, and EXT
    leads in from the north. All are two-way. Cars enter at the outer end of EXT. The map has no goal; the goal is
    set to (80, -4), a door at the southern end of the middle column C2.
    """
    document = _Map.parse(read_yaml(path), str(path))
    with naming(path):
        return _lot(document)


def _lot(document: _Map) -> ParkingLot:
    lines = {name: np.array(line.bounds) for name, line in document.WAYPOINTS}
    aisle_y = np.array([lines[f"R{k}L"][0, 1] for k in (1, 2, 3, 4)])
    c1, c2 = lines["C1"][0, 0], lines["C2"][0, 0]
    outside = lines["EXT"][0]
    lanes = [Lane(np.stack([np.full(4, x), aisle_y], axis=1)) for x in (c1, c2)]
    for k, y in enumerate(aisle_y):
        stops = {c1, c2, lines[f"R{k + 1}R"][:, 0].max()} | ({outside[0]} if k == 0 else set())
        lanes.append(Lane(np.array([[x, y] for x in sorted(stops)])))
    lanes.append(Lane(np.array([outside, [outside[0], aisle_y[0]]])))

    parts: list[Slots] = []
    slot_ids: list[str] = []
    for name, area in document.PARKING_AREAS.items():
        west, south = np.min(area.bounds, axis=0)
        east, north = np.max(area.bounds, axis=0)
        n_rows, n_columns = area.areas[0].shape
        size = ((north - south) / n_rows, (east - west) / n_columns)
        opens_north = np.min(np.abs(aisle_y - north)) < np.min(np.abs(aisle_y - south))
        for row in range(n_rows):
            if n_rows == 2:
                opens_north = row == 0
            # Slots are on the left of the line of their mouths, which runs west for the northern rows.
            line = (
                bay_row((east, north), np.pi, n_columns, size=size)
                if opens_north
                else bay_row((west, south), 0.0, n_columns, size=size)
            )
            parts.append(line[::-1] if opens_north else line)
            slot_ids += [f"{name}-{row}-{column}" for column in range(n_columns)]
    return ParkingLot(
        name="dragon-lake",
        slot_ids=tuple(slot_ids),
        **Slots.joined(parts).columns(),
        lanes=tuple(lanes),
        entries=outside[None],
        goals=np.array([[80.0, -4.0]]),
    )
