"""The lot of the Dragon Lake Parking data set."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.lots.generators import Slots, bay_row
from parkenv.world.lot import Lane, ParkingLot

FloatArray = NDArray[np.float64]


def dragon_lake_lot(path: Path) -> ParkingLot:
    """Read the lot of the Dragon Lake Parking data set from its `parking_map.yml`.

    Slots fill the `bounds` of each parking area in the rows and columns of its `shape`, with ids such
    as "A-0-13": area, row from the north, column from the west. The rows of an area are back to back and open
    to the aisles north and south of it; a single row opens to the nearer aisle. Aisles are the waypoint
    rows R1 to R4 from column C1 to their east ends, which are dead ends; C1 and C2 connect them, and EXT
    leads in from the north. All are two-way. Cars enter at the outer end of EXT. The map has no goal; the goal is
    set to (80, -4), a door at the southern end of the middle column C2.

    Raises:
        InputError: the file cannot be read or is not a Dragon Lake map.
    """
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError(f"{path}: not YAML: {' '.join(str(error).split())}") from error

    def bounds(group: str, name: str, points: int) -> FloatArray:
        try:
            values = np.array(document[group][name]["bounds"], dtype=np.float64)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: no {group}.{name}.bounds, want {points} points") from error
        if values.shape != (points, 2) or not np.isfinite(values).all():
            raise InputError(
                f"{path}: {group}.{name}.bounds is {values.tolist()!r:.60}, want {points} points"
            )
        return values

    rows = [(bounds("WAYPOINTS", f"R{k}L", 2), bounds("WAYPOINTS", f"R{k}R", 2)) for k in (1, 2, 3, 4)]
    aisle_y = np.array([left[0, 1] for left, _ in rows])
    c1, c2 = (bounds("WAYPOINTS", name, 2)[0, 0] for name in ("C1", "C2"))
    outside = bounds("WAYPOINTS", "EXT", 2)[0]
    lanes = [Lane(np.stack([np.full(4, x), aisle_y], axis=1)) for x in (c1, c2)]
    for k, (y, (_, right)) in enumerate(zip(aisle_y, rows, strict=True)):
        stops = {c1, c2, right[:, 0].max()} | ({outside[0]} if k == 0 else set())
        lanes.append(Lane(np.array([[x, y] for x in sorted(stops)])))
    lanes.append(Lane(np.array([outside, [outside[0], aisle_y[0]]])))

    parts: list[Slots] = []
    slot_ids: list[str] = []
    for area in document.get("PARKING_AREAS") or ():
        west, south = bounds("PARKING_AREAS", area, 4).min(axis=0)
        east, north = bounds("PARKING_AREAS", area, 4).max(axis=0)
        try:
            n_rows, n_columns = document["PARKING_AREAS"][area]["areas"][0]["shape"]
            size = ((north - south) / n_rows, (east - west) / n_columns)
        except (KeyError, IndexError, TypeError, ValueError, ZeroDivisionError) as error:
            raise InputError(
                f"{path}: no PARKING_AREAS.{area}.areas[0].shape, want [rows, columns]"
            ) from error
        if n_rows not in (1, 2):
            raise InputError(f"{path}: PARKING_AREAS.{area} has {n_rows} rows, want 1 or 2, each on an aisle")
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
            slot_ids += [f"{area}-{row}-{column}" for column in range(n_columns)]
    if not parts:
        raise InputError(f"{path}: no PARKING_AREAS: an empty lot")
    return ParkingLot(
        name="dragon-lake",
        slot_ids=tuple(slot_ids),
        **Slots.joined(parts).columns(),
        lanes=tuple(lanes),
        entries=outside[None],
        goals=np.array([[80.0, -4.0]]),
    )
