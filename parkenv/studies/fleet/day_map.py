"""Maps of the days of a study of many cars, for its pages: blocks and lanes by hour."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.engine.records import STATES
from parkenv.show.report.page import page_data, write_page
from parkenv.show.scene import SQUARE, Lines, building_layers, layer_data, rounded
from parkenv.studies.fleet.blocks import BLOCKS, HOURS, LANES, TABLES, Blocks, by_hour
from parkenv.studies.fleet.day import ALL
from parkenv.studies.fleet.setting import Setting
from parkenv.studies.report import Recording, ReplayJob
from parkenv.studies.results import Row, without_nan
from parkenv.world.lot import ParkingLot, is_building
from parkenv.world.scenario import Scenario
from parkenv.world.tariff import PUBLIC, Zone
from parkenv.world.week import HOUR_S

if TYPE_CHECKING:
    from parkenv.studies.fleet.study import FleetStudy

MAP_PAGE = "fleet.html"
MOST_MAPS = 6
LANE_WIDTH = 5.5
GAP = 1.2
"""m between slots of a block up to which they are drawn as one area."""
COUNTED_AREA, LEAST_SIDE = 6.0, 12.0
"""m2 of the square of a counted facility for each car that fits, and its least side, m."""
MOST_NUMBERS = 1_500_000
"""Numbers of all maps of a page: with more, it would load slowly."""
Rows = Mapping[str, Sequence[Row]]
"""Rows of each of `TABLES`, by its file."""


def map_replay(study: FleetStudy, folder: Path) -> ReplayJob:
    """Return the maps of a run, which are in its tables: nothing runs again."""
    rows = {table.file: table.read(folder) for table in TABLES}
    return ReplayJob([partial(dict, recording) for recording in map_recordings(study, rows)])


def write_map_page(study: FleetStudy, summary: Row, rows: Rows, folder: Path) -> None:
    """Write the page with tables and maps of a run, without days that are played again."""
    told = without_nan(summary)
    page = page_data("fleet", study.page(told, folder), told, map_recordings(study, rows))
    write_page(page, folder / MAP_PAGE)


def map_recordings(study: FleetStudy, rows: Rows) -> list[Recording]:
    """Return `town` and `map` of a page of some settings, those to be shown first."""
    shown = study.shown_settings
    chosen = [*shown, *(setting for setting in study.fleet_settings if setting not in shown)][:MOST_MAPS]
    scenarios = {setting.scenario: study.built[setting.scenario] for setting in chosen}
    towns = {name: town_data(s.lot, [*map(rules_text, s.zone_rules)]) for name, s in scenarios.items()}
    maps: list[Recording] = []
    for setting in chosen:
        of_setting = {file: [row for row in table if setting.holds(row)] for file, table in rows.items()}
        if of_setting[BLOCKS.file]:
            day = _map(scenarios[setting.scenario], setting, of_setting)
            maps.append({"town": towns[setting.scenario], "map": day})
    numbers = np.cumsum([len(each["town"]["blocks"]) * len(each["map"]["hours"]) * 6 for each in maps])
    return [
        each for each, so_far in zip(maps, numbers, strict=True) if so_far <= max(MOST_NUMBERS, numbers[0])
    ]


def town_data(lot: ParkingLot, rules: Sequence[str]) -> dict[str, Any]:
    """Return the `town` of a page, of a lot and the rules of its zones: lengths in m, rounded to decimetres."""
    blocks = Blocks.of(lot)
    first = np.unique(blocks.of_slot, return_index=True)[1]
    columns = (
        blocks.names,
        blocks.types,
        blocks.zones,
        blocks.slots.tolist(),
        lot.zone_of_slot[first].tolist(),
    )
    lanes = [lane.points for lane in lot.lanes]
    ground = [
        *building_layers(
            [wall for wall in lot.walls if is_building(wall)],
            [wall for wall in lot.walls if not is_building(wall)],
        ),
        Lines(lanes, "asphalt", LANE_WIDTH, (1.5, LANE_WIDTH)),
    ]
    return {
        "name": lot.name,
        "bounds": rounded(np.array(lot.bounds()), 1),
        "ground": [layer_data(layer, 1) for layer in ground],
        "lanes": [rounded(points, 1) for points in lanes],
        "goals": [rounded(xy, 1) for xy in lot.goals],
        "blocks": [
            {"name": name, "type": kind, "zone": zone, "slots": slots, "rules": rules[number]}
            | _place(lot, np.flatnonzero(blocks.of_slot == block))
            for block, (name, kind, zone, slots, number) in enumerate(zip(*columns, strict=True))
        ],
    }


def _place(lot: ParkingLot, slots: IntArray) -> dict[str, Any]:
    """Return the areas of slots that are drawn as one block, and a place in it.

    A counted facility is a square as large as its slots would be on a few storeys.
    """
    facility = lot.facilities[lot.facility_of_slot[slots[0]]] if lot.facility_of_slot[slots[0]] >= 0 else None
    if facility is not None and facility.xy is not None and facility.is_counted:
        side = max(math.sqrt(COUNTED_AREA * facility.capacity), LEAST_SIDE)
        square = np.array(facility.xy) + side * SQUARE
        return {"at": rounded(np.array(facility.xy), 1), "areas": [[rounded(square, 1)]]}
    corners = shapely.polygons(lot.slot_corners()[slots])
    joined = shapely.union_all(shapely.buffer(corners, GAP / 2, join_style="mitre"))
    area = shapely.simplify(shapely.buffer(joined, 0.2 - GAP / 2, join_style="mitre"), 0.2)
    xy = lot.slot_xy[slots]
    middle = xy[np.argmin(np.hypot(*(xy - xy.mean(axis=0)).T))]
    return {
        "at": rounded(middle, 1),
        "areas": [
            [rounded(shapely.get_coordinates(ring)[:-1], 1) for ring in (part.exterior, *part.interiors)]
            for part in shapely.get_parts(area)
        ],
    }


def rules_text(zone: Zone) -> str:
    """Return the rules of a zone in words; empty if everyone may park there for nothing.

    Examples:
        >>> from parkenv.world.tariff import Price
        >>> rules_text(Zone("inner", Price(2.0, free_s=900.0), max_stay_s=7200.0))
        '2 an hour, 15 min free; up to 2 h'
    """
    price, parts = zone.price, []
    if price.steps:
        table = ", ".join(f"{amount:g} up to {_time_text(stay_s)}" for stay_s, amount in price.steps)
        parts.append(f"{table}{f', then {price.per_hour:g} an hour' if price.per_hour else ''}")
    elif price.per_hour:
        parts.append(f"{price.per_hour:g} an hour")
    elif price.hourly:
        spans = (f"{amount:g} {hours.removeprefix('Mo-Su ')}" for amount, hours in price.rules)
        parts.append(f"an hour: {', '.join(spans)}")
    if parts:
        parts[0] += f", {_time_text(price.free_s)} free" if price.free_s else ""
        parts[0] += f", at most {price.daily_cap:g} a day" if price.daily_cap is not None else ""
        parts[0] += f", {price.charged}" if price.charged else ""
    if price.per_kwh:
        parts.append(f"{price.per_kwh:g} a kWh")
    if zone.max_stay_s is not None:
        parts.append(f"up to {_time_text(zone.max_stay_s)}")
    if zone.hours is not None:
        parts.append(f"open {zone.hours}")
    if PUBLIC not in zone.users:
        parts.append(f"for {', '.join(zone.users)}")
    return "; ".join(parts)


def _time_text(seconds: float) -> str:
    return f"{seconds / HOUR_S:g} h" if seconds >= HOUR_S else f"{seconds / 60.0:g} min"


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
    """Return lanes in which cars cruise, with the metres in each hour, means over days."""
    metres: dict[int, FloatArray] = {}
    for row in rows:
        for lane, hour, cruised in zip(row["lane"], row["hour"], row["cruised_m"], strict=True):
            if hour in hours and cruised:
                metres.setdefault(lane, np.zeros(len(hours)))[hours.index(hour)] += cruised / len(rows)
    return [[lane, *np.round(its).astype(int).tolist()] for lane, its in sorted(metres.items())]


def _mean_states(rows: Sequence[Row], state: str, hours: Sequence[int]) -> list[float]:
    """Return the mean number of cars in a state at the end of each hour; a day that is over stays as it is."""
    days = []
    for row in rows:
        its = [count for count, purpose in zip(row[state], row["purpose"], strict=True) if purpose == ALL]
        days.append([its[min(hour - row["hour"][0], len(its) - 1)] for hour in hours])
    return [round(float(cars), 1) for cars in np.mean(days, axis=0)]
