"""Reports of days with many cars: maps of blocks and lanes by hour, and replays of every car."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.engine.fleet import Fleet
from parkenv.engine.records import LEFT, NO_CAR, PARKED, STATES
from parkenv.show.report.page import page_data, write_page
from parkenv.show.scene import SQUARE, Lines, LotScene, building_layers, layer_data, rounded
from parkenv.studies.fleet.day import ALL
from parkenv.studies.fleet.setting import Setting, rate_text
from parkenv.studies.fleet.tables import BLOCKS, HOURS, LANES, TABLES, Blocks, by_hour
from parkenv.studies.results import Key, Row, without_nan
from parkenv.studies.study import AGREES_S, MOST_SLOTS, Recording, ReplayJob, ReportOptions
from parkenv.world.lot import ParkingLot, is_building
from parkenv.world.scenario import Scenario
from parkenv.world.tariff import PUBLIC, Zone

if TYPE_CHECKING:
    from parkenv.studies.fleet.spec import FleetSpec

MOST_MAPS = 6
LANE_WIDTH = 5.5  # m
GAP = 1.2  # m between slots of a block up to which they are drawn as one area
COUNTED_AREA, LEAST_SIDE = 6.0, 12.0  # m2 of a counted facility for each car that fits, and its least side, m
MOST_NUMBERS = 1_500_000  # numbers of all maps of a page: with more, it would load slowly
Rows = Mapping[str, Sequence[Row]]  # rows of each of `TABLES`, by its file


def map_replay(study: FleetSpec, folder: Path) -> ReplayJob:
    rows = {table.file: table.read(folder) for table in TABLES}
    return ReplayJob([partial(dict, recording) for recording in map_recordings(study, rows)])


def write_map_page(study: FleetSpec, summary: Row, rows: Rows, folder: Path) -> None:
    summary = without_nan(summary)
    page = page_data("fleet", study.page(summary, folder), summary, map_recordings(study, rows))
    write_page(page, folder / "fleet.html")


def map_recordings(study: FleetSpec, rows: Rows) -> list[Recording]:
    shown = study.shown_settings
    settings = [*shown, *(setting for setting in study.fleet_settings if setting not in shown)][:MOST_MAPS]
    scenarios = {setting.scenario: study.built[setting.scenario] for setting in settings}
    towns = {name: town_data(s.lot, [*map(rules_text, s.zone_rules)]) for name, s in scenarios.items()}
    maps: list[Recording] = []
    numbers = 0
    for setting in settings:
        days = {file: [row for row in of_table if setting.holds(row)] for file, of_table in rows.items()}
        if days[BLOCKS.file]:
            town, data = towns[setting.scenario], _map(study.built[setting.scenario], setting, days)
            numbers += 6 * len(town["blocks"]) * len(data["hours"])
            if not maps or numbers <= MOST_NUMBERS:
                maps.append({"town": town, "map": data})
    return maps


def town_data(lot: ParkingLot, rules: Sequence[str]) -> dict[str, Any]:
    # Lengths are in m, rounded to decimetres.
    blocks = Blocks.of(lot)
    first = np.unique(blocks.of_slot, return_index=True)[1]
    rules_of = [rules[zone] for zone in lot.zone_of_slot[first].tolist()]
    columns = blocks.names, blocks.types, blocks.zones, blocks.slots.tolist(), rules_of
    names = ("name", "type", "zone", "slots", "rules")
    lanes = [lane.points for lane in lot.lanes]
    buildings = [wall for wall in lot.walls if is_building(wall)]
    walls = [wall for wall in lot.walls if not is_building(wall)]
    ground = [*building_layers(buildings, walls), Lines(lanes, "asphalt", LANE_WIDTH, (1.5, LANE_WIDTH))]
    return {
        "name": lot.name,
        "bounds": rounded(np.array(lot.bounds()), 1),
        "ground": [layer_data(layer, 1) for layer in ground],
        "lanes": [rounded(points, 1) for points in lanes],
        "goals": [rounded(xy, 1) for xy in lot.goals],
        "blocks": [
            dict(zip(names, block, strict=True)) | _place(lot, np.flatnonzero(blocks.of_slot == number))
            for number, block in enumerate(zip(*columns, strict=True))
        ],
    }


def _place(lot: ParkingLot, slots: IntArray) -> dict[str, Any]:
    # A counted facility is a square as large as its slots would be on a few storeys.
    facility = lot.facilities[lot.facility_of_slot[slots[0]]] if lot.facility_of_slot[slots[0]] >= 0 else None
    if facility is not None and facility.xy is not None and facility.is_counted:
        square = np.array(facility.xy) + max(math.sqrt(COUNTED_AREA * facility.capacity), LEAST_SIDE) * SQUARE
        return {"at": rounded(np.array(facility.xy), 1), "areas": [[rounded(square, 1)]]}
    corners = shapely.polygons(lot.slot_corners()[slots])
    joined = shapely.union_all(shapely.buffer(corners, GAP / 2, join_style="mitre"))
    area = shapely.simplify(shapely.buffer(joined, 0.2 - GAP / 2, join_style="mitre"), 0.2)
    xy = lot.slot_xy[slots]
    return {
        "at": rounded(xy[np.argmin(np.hypot(*(xy - xy.mean(axis=0)).T))], 1),
        "areas": [
            [rounded(shapely.get_coordinates(ring)[:-1], 1) for ring in (part.exterior, *part.interiors)]
            for part in shapely.get_parts(area)
        ],
    }


def rules_text(zone: Zone) -> str:
    """Return the rules of a zone as a lot file names them; empty if everyone may park there for nothing.

    Examples:
        >>> from parkenv.world.tariff import Price
        >>> rules_text(Zone("inner", Price(2.0, free_s=900.0), max_stay_s=7200.0))
        'per_hour 2; free_s 900; max_stay_s 7200'
    """
    rules = zone.price.members() | {"max_stay_s": zone.max_stay_s, "hours": zone.hours}
    rules["users"] = None if PUBLIC in zone.users else ", ".join(zone.users)
    shown = {name: f"{value:g}" if isinstance(value, float) else value for name, value in rules.items()}
    return "; ".join(f"{name} {value}" for name, value in shown.items() if value is not None)


def _map(scenario: Scenario, setting: Setting, rows: Rows) -> dict[str, Any]:
    names, hours, means = by_hour(rows[BLOCKS.file], "block")
    # Cars that arrive late park after the last look at the slots.
    known = np.isfinite(means["occupancy"]).any(axis=0)
    order = [names.index(name) for name in Blocks.of(scenario.lot).names]
    hours = np.array(hours)[known].tolist()
    grid = {name: values[order][:, known] for name, values in means.items()}
    with np.errstate(invalid="ignore", divide="ignore"):
        grid |= {name: grid[name] / grid["parked"] for name in ("search_s", "walk_s")}
    digits = {"occupancy": 3, "arrivals": 2, "refused": 2, "search_s": 0, "walk_s": 0, "paid": 2}
    return {
        **setting.columns,
        "days": len(rows[BLOCKS.file]),
        "hours": hours,
        "blocks": {name: without_nan(np.round(grid[name], digit).tolist()) for name, digit in digits.items()},
        "lanes": _cruised(rows[LANES.file], hours),
        "states": {state: _mean_states(rows[HOURS.file], state, hours) for state in STATES},
    }


def _cruised(rows: Sequence[Row], hours: Sequence[int]) -> list[list[int]]:
    metres: dict[int, FloatArray] = {}
    for row in rows:
        for lane, hour, cruised in zip(row["lane"], row["hour"], row["cruised_m"], strict=True):
            if hour in hours and cruised:
                metres.setdefault(lane, np.zeros(len(hours)))[hours.index(hour)] += cruised / len(rows)
    return [[lane, *np.round(by_hour).astype(int).tolist()] for lane, by_hour in sorted(metres.items())]


def _mean_states(rows: Sequence[Row], state: str, hours: Sequence[int]) -> list[float]:
    # A day that is over stays as it is.
    days = []
    for row in rows:
        cars = [count for count, purpose in zip(row[state], row["purpose"], strict=True) if purpose == ALL]
        days.append([cars[min(hour - row["hour"][0], len(cars) - 1)] for hour in hours])
    return [round(float(mean), 1) for mean in np.mean(days, axis=0)]


MOST_CARS = 5_000  # demands with which more cars come on a day are not replayed: the page would not load
# What a car does on its way to a point of its track: drive; a failed attempt, a queue and a wait leave it there.
DRIVE, FAIL, QUEUE, WAIT = range(4)
DAYS = 8  # default number of replayed days


def day_replay(study: FleetSpec, folder: Path, options: ReportOptions) -> ReplayJob:
    agents = options.chosen_agents([setting.agent.label for setting in study.fleet_settings])
    numbers = options.chosen_numbers(range(study.days))
    lots = [scenario.lot for scenario in study.built.values()]
    if (n := max(lot.n_slots for lot in lots)) > MOST_SLOTS:
        return ReplayJob(
            notes=[f"the lot has {n} slots, more than the {MOST_SLOTS} that are drawn: no replay"]
        )
    if any((lot.capacity > 1).any() for lot in lots):
        return ReplayJob(notes=["counted facilities have no slots to draw: no replay; the map has them"])
    rows = study.table.read(folder)
    crowded = {row["arrivals_per_hour"] for row in rows if row["cars"] > MOST_CARS}
    notes = [
        f"days with {rate_text(rate)} have more than the {MOST_CARS} cars that are drawn: no replay"
        for rate in study.demands
        if rate in crowded
    ]
    settings = [
        setting
        for setting in study.fleet_settings
        if setting.agent.label in agents and setting.arrivals_per_hour not in crowded
    ]
    chosen = choose_days(study, settings, DAYS if options.episodes is None else options.episodes, numbers)
    totals = {study.table.key(row): row["total_s"] for row in rows}
    return ReplayJob([partial(record_day, study, setting, day, totals) for setting, day in chosen], notes)


def record_day(study: FleetSpec, setting: Setting, day: int, counted: Mapping[Key, float]) -> Recording:
    fleet, agents = study.fleet(setting)
    scenario = fleet.scenario
    fleet.keep_steps()
    fleet.reset(study.seed, day)
    fleet.run(agents, until=fleet.begin)
    leaves_at = fleet.slots["leaves_at"].copy()
    fleet.run(agents)
    cars, begin = fleet.cars, fleet.begin
    mean_s = float(cars["total_s"][cars["parked_at"] < 0].mean())
    before = counted.get(study.keys(setting, day)[0])
    agrees = None if before is None else abs(before - mean_s) <= AGREES_S
    difference = (
        f"{setting}, day {day}: run again the mean was {mean_s:.2f} s, days.csv says {before or 0.0:.2f} s"
    )
    stays = np.flatnonzero(leaves_at > begin)
    residents = np.stack([stays, _centiseconds(leaves_at[stays] - begin)], axis=1)
    return {
        "lot": LotScene.of(scenario.lot).data(),
        "fleet": {
            "scenario": scenario.name,
            **setting.columns,
            "day": day,
            "date": fleet.day.date,
            "begin_s": round(begin, 3),
            "goal": scenario.goal,
            "duration": int(_centiseconds(cars["ended_at"].max() - begin)),
            "total_s": mean_s,
            "counted_s": before,
            "agrees": agrees,
            # Slot and departure of each car that is parked when the day begins.
            "residents": residents.astype(int).ravel().tolist(),
            **_cars(cars, begin),
            "tracks": _tracks(fleet),
        },
        "differences": [difference] if agrees is False else [],
    }


def choose_days(
    study: FleetSpec, settings: Sequence[Setting], count: int, days: Sequence[int] | None = None
) -> list[tuple[Setting, int]]:
    """Return all of some `days`, or so many: the first day of each setting, then the next one."""
    numbers = range(study.days) if days is None else days
    pairs = [(number, day) for day in numbers for number in range(len(settings))]
    return [(settings[number], day) for number, day in sorted(pairs if days is not None else pairs[:count])]


def _cars(cars: NDArray[np.void], begin: float) -> dict[str, list[int]]:
    parked = np.isin(cars["state"], (PARKED, LEFT))
    leaves = np.where(parked, cars["ended_at"] + cars["stay_s"], np.inf)
    lists = {
        "arrival": _centiseconds(cars["arrival"] - begin),
        "ended": _centiseconds(cars["ended_at"] - begin),
        "slot": np.where(parked, cars["slot"], NO_CAR),
        "leaves": np.where(np.isfinite(leaves), _centiseconds(leaves - begin), -1),
        "member": cars["kind"] == 0,
    }
    return {name: values.astype(int).tolist() for name, values in lists.items()}


def _tracks(fleet: Fleet) -> list[list[int]]:
    """Return the track of each car: its entry; for each point the centiseconds to it, and 4 x vertex + what it does."""
    cars, steps = fleet.cars, fleet.steps[np.argsort(fleet.steps["car"], kind="stable")]
    first = np.searchsorted(steps["car"], np.arange(len(cars) + 1))
    tracks = []
    for number, (entry, arrival, ended) in enumerate(cars[["entry", "arrival", "ended_at"]].tolist()):
        times, codes, vertex = [arrival], [entry], entry
        for _, started, end, origin, target, failed in steps[first[number] : first[number + 1]].tolist():
            if started > times[-1]:
                times.append(started)
                codes.append(4 * vertex + QUEUE)
            times.append(end)
            codes.append(4 * target + (FAIL if failed else DRIVE if target != origin else WAIT))
            vertex = target
        if ended > times[-1]:
            times.append(ended)
            codes.append(4 * vertex + QUEUE)
        elapsed = np.diff(_centiseconds(np.array(times) - fleet.begin))
        tracks.append([entry, *np.stack([elapsed, codes[1:]], axis=1).astype(int).ravel().tolist()])
    return tracks


def _centiseconds(seconds: Any) -> Any:
    return np.rint(100 * seconds)
