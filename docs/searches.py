"""Searches in imported districts beside measured ones: `python docs/searches.py TOWNS` prints the table of `town.md`.

TOWNS holds extracts of OpenStreetMap in `osm`, and the searches that an app measured in `search_times/trips.csv`. The
demand of a district is that of the packaged scenario `town`, as many cars a space; nothing is fitted to the searches.
"""

import csv
import sys
import tempfile
import tomllib
from importlib.resources import files
from pathlib import Path

import numpy as np

from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.lots import packaged_lot, write_lot
from parkenv.lots.town.draft import import_town
from parkenv.scenarios.build import build
from parkenv.scenarios.spec import scenario_specs
from parkenv.studies.fields import AgentSpec
from parkenv.studies.fleet.drivers import record_days
from parkenv.world.scenario import drive_times
from planners.heuristics import POLICIES

DISTRICTS = {
    "residential, inner (Neukölln)": ("neukoelln_patch_20240328.osm.gz", (1.0, 2.0)),
    "centre of a small town (Hoyerswerda)": ("hoyerswerda_20240812.osm.pbf", (1.0, 2.0)),
    "centre of a city (Helsinki)": ("helsinki_centre_20190421.osm.pbf", (1.0,)),
}
"""Extract of each district, and how many times as many cars a space come as in the packaged town."""
CLASSES = {
    "residents": {"permit": 0.85, "private": 0.5},
    "commuters": {"private": 0.5},
    "shoppers": {"customers": 0.8},
    "visitors": {"customers": 0.3},
    "deliveries": {"delivery": 1.0, "customers": 0.5},
}
"""Who may park by the rules that an import finds, by purpose; as far as the district has such rules."""
DAYS, ROUNDS, SHORTEST_MIN = 2, 2, 0.05


def scenario_file(path, lot, load):
    """Write the scenario of a lot with the demand of the packaged town, scaled by its spaces."""
    town = tomllib.loads(
        files("parkenv.scenarios").joinpath("packaged/town.toml").read_text(encoding="utf-8")
    )
    factor = load * float(lot.capacity.sum() / packaged_lot("town").capacity.sum())
    lines = [
        f'lot = "{lot.name}.geojson"',
        "[costs]",
        "give_up_s = 3600",
        "[arrivals]",
        'hours = "07:00-20:00"',
    ]
    for purpose, values in town["demand"].items():
        values["arrivals_per_hour"] = [round(factor * n, 2) for n in values["arrivals_per_hour"]]
        values["parked"] = round(factor * values["parked"])
        shares = {name: share for name, share in CLASSES[purpose].items() if name in lot.classes}
        values["classes"] = "{ " + ", ".join(f"{name} = {share}" for name, share in shares.items()) + " }"
        lines += [f"[demand.{purpose}]"]
        lines += [f"{key} = {f'{value!r}'.replace(chr(39), chr(34)) if key != 'classes' else value}"
                  for key, value in values.items()]  # fmt: skip
    path.write_text("\n".join(lines).replace("True", "true") + "\n", encoding="utf-8")


def searches(folder, lot, load):
    """Return the minutes that each car of the days searched, NaN if it found no space, and the share taken at noon."""
    write_lot(lot, folder / f"{lot.name}.geojson")
    scenario_file(folder / "scenario.toml", lot, load)
    (spec,) = scenario_specs(folder / "scenario.toml")
    log = folder / "days.csv.gz"
    record_days(spec, log, agent=AgentSpec(name="usual"), days=DAYS, rounds=ROUNDS, seed=0)
    scenario = build(spec.changed(occupancy={"log": str(log), "mapping": "same"}))
    kind = DriverKind(policy=POLICIES["usual"])
    fleet = Fleet(scenario, scenario.demand, background="none", drivers=[kind], leave_full_lot=False)
    direct_s = {int(v): drive_times(scenario, int(v)) for v in np.unique(lot.entry_vertices)}
    found, taken = [], []
    for day in range(DAYS):
        fleet.reset(seed=1, episode=day)
        fleet.run(until=fleet.begin + 5 * 3600.0)
        taken.append(fleet.counts().sum() / lot.capacity.sum())
        fleet.run()
        cars = fleet.cars[fleet.cars["parked_at"] < 0]
        least_s = np.array(
            [direct_s[e][s] for e, s in zip(cars["entry"].tolist(), cars["slot"].tolist(), strict=True)]
        )
        search_s = cars["ended_at"] - cars["arrival"] - least_s - scenario.enter_s[cars["slot"]]
        found.append(np.where(cars["slot"] >= 0, np.maximum(search_s, 0.0) / 60.0, np.nan))
    return np.concatenate(found), float(np.mean(taken))


def row(name, spaces, taken, minutes):
    """Return a line of the table."""
    known = minutes[~np.isnan(minutes)]
    lost = f"{np.isnan(minutes).mean():.0%}" if spaces else ""
    values = [f"{known.mean():.2f}", *(f"{np.quantile(known, q):.2f}" for q in (0.5, 0.75, 0.9))]
    at_once = f"{(known <= SHORTEST_MIN).mean():.0%}"
    return f"| {name} | {spaces} | {taken} | {len(minutes):,} | {' | '.join(values)} | {at_once} | {lost} |"


def say(line):
    """Print a line at once: each takes minutes."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main(towns):
    """Print the table."""
    say("| | spaces | taken at noon | searches | mean | median | 75 % | 90 % | at once | elsewhere |")
    say("|---|---|---|---|---|---|---|---|---|---|")
    with (towns / "search_times" / "trips.csv").open(encoding="utf-8") as file:
        trips = [
            (each["Parking_Location_Type"], float(each["Parking_Search_Duration_min"]))
            for each in csv.DictReader(file)
        ]
    for kind in (None, *sorted({kind for kind, _ in trips})):
        minutes = np.array([value for place, value in trips if kind in (None, place)])
        say(row(f"measured{f', {kind}' if kind else ''}", "", "", minutes))
    for name, (extract, loads) in DISTRICTS.items():
        lot = import_town(towns / "osm" / extract).draft.lot()
        for load in loads:
            with tempfile.TemporaryDirectory() as folder:
                minutes, taken = searches(Path(folder), lot, load)
            title = name if load == 1.0 else f"the same, {load:g} times as many cars"
            say(row(title, f"{lot.capacity.sum():,}", f"{taken:.0%}", minutes))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
