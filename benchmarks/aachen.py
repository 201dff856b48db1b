"""The counts of Aachen's car parks as `parkenv occupancy` reads them, and the list of these car parks.

`python benchmarks/aachen.py DATA FOLDER` writes `counts.csv.gz` and `car_parks.csv` from `car_parks.csv` and all
`free_15min*.csv.gz` in DATA. Car parks that the list lacks are left out, and named.
"""

import csv
import gzip
import sys
from datetime import datetime, timedelta
from pathlib import Path

UNSTATED = {"Parkplatz Uniklinik": 2924}
"""Capacities that are not stated: the most free places counted in 2020 and 2021."""
STANDS = timedelta(hours=12)
"""No reading means no change, for so long."""


def car_parks(data):
    """Name, capacity, latitude and longitude of each car park, by its id."""
    with (Path(data) / "car_parks.csv").open(encoding="utf-8") as file:
        return {
            row["place_id"]: (
                row["name"],
                int(row["capacity"] or UNSTATED[row["name"]]),
                row["lat"],
                row["lon"],
            )
            for row in csv.DictReader(file)
        }


def write_list(data, path):
    """Write the car parks as `parkenv lot import --car-parks` reads them."""
    with Path(path).open("w", encoding="utf-8", newline="") as out:
        csv.writer(out).writerows([("name", "capacity", "lat", "lon"), *car_parks(data).values()])


def write_counts(data, path):
    """Write the free places at the end of each hour (UTC); readings stand until the next one."""
    known, unknown = car_parks(data), set()
    with gzip.open(path, "wt", encoding="utf-8", newline="") as out:
        writer = csv.writer(out)
        writer.writerow(["car_park", "capacity", "hour_utc", "free"])
        latest = {}
        for table in sorted(Path(data).glob("free_15min*.csv.gz")):
            with gzip.open(table, "rt", encoding="utf-8") as file:
                rows = csv.reader(file)
                ids = next(rows)[1:]
                unknown |= set(ids) - set(known)
                for time, *cells in rows:
                    moment = datetime.fromisoformat(time)
                    latest |= {
                        its: (moment, free)
                        for its, free in zip(ids, cells, strict=True)
                        if free and its in known
                    }
                    if moment.minute >= 45:
                        hour = moment.replace(minute=0).isoformat(timespec="minutes")
                        writer.writerows(
                            (*known[its][:2], hour, free)
                            for its, (since, free) in latest.items()
                            if moment - since <= STANDS
                        )
    return sorted(unknown)


if __name__ == "__main__":
    source, folder = map(Path, sys.argv[1:])
    folder.mkdir(parents=True, exist_ok=True)
    write_list(source, folder / "car_parks.csv")
    for name in write_counts(source, folder / "counts.csv.gz"):
        sys.stderr.write(f"not in car_parks.csv: {name}\n")
