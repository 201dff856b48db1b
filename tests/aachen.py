"""Counts of Aachen's car parks as `parkenv occupancy` reads them, and a made town that has these car parks.

`python tests/aachen.py DATA FOLDER` writes `counts.csv.gz` and `aachen.geojson`, from `car_parks.csv` and
`free_15min_2020_2021.csv.gz` in DATA.
"""

import csv
import gzip
import math
import sys
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from parkenv.lots.formats.geojson import write_lot
from parkenv.lots.generators import NO_SLOTS, StreetGrid
from parkenv.world.facility import Facility
from parkenv.world.lot import ParkingLot

UNSTATED = {"Parkplatz Uniklinik": 2924}
"""Capacities that are not stated: the most free places ever counted."""
STREETS_M = 240.0
"""Between two streets; a car park is at most 150 m from one."""
STANDS = timedelta(hours=12)
"""No reading means no change, for so long."""


def car_parks(data):
    """Name, capacity, and position in m, of each car park, by its id."""
    rows = list(csv.DictReader((Path(data) / "car_parks.csv").open(encoding="utf-8")))
    lat = np.array([float(row["lat"]) for row in rows])
    lon = np.array([float(row["lon"]) for row in rows])
    middle = math.radians(lat.mean())
    xy = np.column_stack([(lon - lon.mean()) * math.cos(middle), lat - lat.mean()]) * 111_320.0
    return {
        row["place_id"]: (row["name"], int(row["capacity"] or UNSTATED[row["name"]]), tuple(at))
        for row, at in zip(rows, np.round(xy, 1).tolist(), strict=True)
    }


def write_counts(data, path, first, last):
    """Write the free places at the end of each hour (UTC) of some days; readings stand until the next one."""
    known = car_parks(data)
    with (
        gzip.open(Path(data) / "free_15min_2020_2021.csv.gz", "rt", encoding="utf-8") as file,
        gzip.open(path, "wt", encoding="utf-8", newline="") as out,
    ):
        rows, writer = csv.reader(file), csv.writer(out)
        ids = next(rows)[1:]
        writer.writerow(["car_park", "capacity", "hour_utc", "free"])
        latest = {}
        for time, *cells in rows:
            moment = datetime.fromisoformat(time)
            latest |= {its: (moment, free) for its, free in zip(ids, cells, strict=True) if free}
            if moment.minute < 45 or not first <= moment.date() <= last:
                continue
            hour = moment.replace(minute=0).isoformat(timespec="minutes")
            for its, (since, free) in latest.items():
                if moment - since <= STANDS:
                    writer.writerow([*known[its][:2], hour, free])


def town(data, names=None):
    """A made town: a grid of two-way streets with the car parks where they are, each with a goal at its door."""
    chosen = [its for its in car_parks(data).values() if names is None or its[0] in names]
    xy = np.array([at for _, _, at in chosen])
    x, y = (np.arange(low - 300.0, high + 300.0 + STREETS_M, STREETS_M)
            for low, high in zip(xy.min(axis=0), xy.max(axis=0), strict=True))  # fmt: skip
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    streets = StreetGrid(grid, np.zeros(len(y), int), np.zeros(len(x), int))
    middle = len(y) // 2, len(x) // 2
    return ParkingLot(
        name="aachen", slot_ids=(), **NO_SLOTS.columns(), lanes=tuple(streets.lanes()),
        entries=np.array([grid[0, middle[1]], grid[-1, middle[1]], grid[middle[0], 0], grid[middle[0], -1]]),
        goals=xy,
        facilities=tuple(
            Facility(
                name, "garage", capacity=capacity, xy=at, gate_s=min(6.0, 3600.0 / capacity),
                inside_s=(30.0, 120.0), known="sign",
            )
            for name, capacity, at in chosen
        ),
    )  # fmt: skip


if __name__ == "__main__":
    source, folder = map(Path, sys.argv[1:])
    folder.mkdir(parents=True, exist_ok=True)
    write_counts(source, folder / "counts.csv.gz", datetime(2021, 1, 1).date(), datetime(2021, 12, 31).date())
    write_lot(town(source), folder / "aachen.geojson")
