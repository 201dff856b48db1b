"""Record days with many cars for the replay of a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.engine.fleet import Fleet
from parkenv.engine.records import LEFT, NO_CAR, PARKED
from parkenv.show.scene import LotScene
from parkenv.studies.fleet.setting import Setting, rate_text
from parkenv.studies.report import AGREES_S, MOST_SLOTS, Recording, ReplayJob
from parkenv.studies.report_options import ReportOptions
from parkenv.studies.results import Key

if TYPE_CHECKING:
    from parkenv.studies.fleet.study import FleetStudy

MOST_CARS = 5_000
"""Demands with which more cars come on a day are not replayed: the page would not load."""
DRIVE, FAIL, QUEUE, WAIT = range(4)
"""What a car does on its way to a point of its track: drive; a failed attempt, a queue and a wait leave it there."""
STRAIGHT_M = 0.1
"""A car that drives on at the same speed needs no point in between if it is that close to a straight line, m."""
DAYS = 8
"""Default number of replayed days."""


def day_replay(study: FleetStudy, folder: Path, options: ReportOptions) -> ReplayJob:
    """Return the days to run again; lots with too many slots or counted ones, and crowded days, are left out.

    Args:
        study: the study.
        folder: folder of the run; means are compared with those in `days.csv`.
        options: which days.
    """
    agents = options.chosen_agents([setting.agent.label for setting in study.fleet_settings])
    numbers = options.chosen_numbers(range(study.days))
    if (n := max(scenario.lot.n_slots for scenario in study.built.values())) > MOST_SLOTS:
        return ReplayJob(
            notes=[f"the lot has {n} slots, more than the {MOST_SLOTS} that are drawn: no replay"]
        )
    if any((scenario.lot.capacity > 1).any() for scenario in study.built.values()):
        return ReplayJob(notes=["counted facilities have no slots to draw: no replay; the map has them"])
    settings = [one for one in study.fleet_settings if one.agent.label in agents]
    rows = study.table.read(folder)
    crowded = {row["arrivals_per_hour"] for row in rows if row["cars"] > MOST_CARS}
    rates = [rate for rate in study.demands if rate in crowded]
    notes = [
        f"days with {rate_text(rate)} have more than the {MOST_CARS} cars that are drawn: no replay"
        for rate in rates
    ]
    settings = [one for one in settings if one.arrivals_per_hour not in rates]
    chosen = choose_days(study, settings, DAYS if options.episodes is None else options.episodes, numbers)
    totals = {study.table.key(row): row["total_s"] for row in rows}
    return ReplayJob([partial(record_day, study, setting, day, totals) for setting, day in chosen], notes)


def record_day(study: FleetStudy, setting: Setting, day: int, counted: Mapping[Key, float]) -> Recording:
    """Repeat a day, and record it: times in centiseconds since the day's arrivals begin."""
    fleet, agents = study.fleet(setting)
    scenario = fleet.scenario
    fleet.keep_steps()
    fleet.reset(study.seed, day)
    fleet.run(agents, until=fleet.begin)
    residents = fleet.slots["leaves_at"].copy()
    fleet.run(agents)
    cars, begin = fleet.cars, fleet.begin
    mean_s = float(cars["total_s"][cars["parked_at"] < 0].mean())
    before = counted.get(study.keys(setting, day)[0])
    agrees = None if before is None else abs(before - mean_s) <= AGREES_S
    ran = f"{setting}, day {day}: run again the mean was {mean_s:.2f} s, days.csv says"
    stay = np.flatnonzero(residents > begin)
    parked = np.isin(cars["state"], (PARKED, LEFT))
    left = _centiseconds(cars["ended_at"] + cars["stay_s"] - begin)
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
            # slot and time of departure of each car that is parked when the day begins
            "residents": np.stack([stay, _centiseconds(residents[stay] - begin)], axis=1).ravel().tolist(),
            "arrival": _centiseconds(cars["arrival"] - begin).tolist(),
            "ended": _centiseconds(cars["ended_at"] - begin).tolist(),
            "slot": np.where(parked, cars["slot"], NO_CAR).tolist(),
            "leaves": np.where(parked & np.isfinite(cars["stay_s"]), left, -1).tolist(),
            "member": (cars["kind"] == 0).astype(int).tolist(),
            "tracks": _tracks(fleet),
        },
        "differences": [f"{ran} {before:.2f} s"] if agrees is False else [],
    }


def choose_days(
    study: FleetStudy, settings: Sequence[Setting], count: int, days: Sequence[int] | None = None
) -> list[tuple[Setting, int]]:
    """Choose days for a replay.

    Args:
        study: the study.
        settings: settings to choose from.
        count: number of days to choose: the first day of each setting, those in which all or none are members first,
            then the next day.
        days: all of these days instead.
    """
    if days is not None or not settings:
        return [(setting, day) for setting in settings for day in days or ()]
    most = max(setting.share for setting in settings)
    order = sorted(range(len(settings)), key=lambda i: settings[i].share not in (0.0, most))
    needed = min(study.days, -(-count // len(settings)))
    chosen = [(i, day) for day in range(needed) for i in order][:count]
    return [(settings[i], day) for i, day in sorted(chosen)]


def _tracks(fleet: Fleet) -> list[list[int]]:
    """Return the track of each car: its entry; for each point the centiseconds to it, and 4 x vertex + what it does.

    The position is linear in between.
    """
    xy, cars, begin = fleet.scenario.lot.vertex_xy, fleet.cars, fleet.begin
    steps = fleet.steps
    steps = steps[np.argsort(steps["car"], kind="stable")]
    first = np.searchsorted(steps["car"], np.arange(len(cars) + 1))
    ways = cars[["entry", "arrival", "ended_at"]].tolist()
    return [_track(steps[first[i] : first[i + 1]], xy, begin, *way) for i, way in enumerate(ways)]


def _track(
    steps: NDArray[np.void], xy: FloatArray, begin: float, entry: int, arrival: float, ended: float
) -> list[int]:
    points: list[tuple[float, int, int]] = []  # time, vertex, what the car does until then
    time, vertex = arrival, entry
    for _, started, end, origin, target, failed in steps.tolist():
        if started > time:
            points.append((started, vertex, QUEUE))
        kind = FAIL if failed else DRIVE if target != origin else WAIT
        points.append((end, target, kind))
        time, vertex = end, target
    if ended > time:
        points.append((ended, vertex, QUEUE))
    points = _without_straight(points, xy, arrival, entry)
    elapsed = np.diff(_centiseconds(np.array([arrival, *(when for when, _, _ in points)]) - begin)).tolist()
    codes = [4 * vertex + kind for _, vertex, kind in points]
    return [entry, *chain.from_iterable(zip(elapsed, codes, strict=True))]


def _without_straight(
    points: Sequence[tuple[float, int, int]], xy: FloatArray, time: float, vertex: int
) -> list[tuple[float, int, int]]:
    """Leave out points at which a car drives straight on at the same speed."""
    bends: list[tuple[float, int, int]] = []
    x0, y0 = xy[vertex]
    speed: tuple[float, float] | None = None  # of the straight line under way, m/s
    start = time
    for i, (when, at, kind) in enumerate(points):
        x, y = xy[at]
        if kind == DRIVE and when > start and speed is None:
            speed = (x - x0) / (when - start), (y - y0) / (when - start)
        follows = points[i + 1] if i + 1 < len(points) else None
        if kind == DRIVE and speed is not None and follows is not None and follows[2] == DRIVE:
            ahead, elapsed = xy[follows[1]], follows[0] - start
            off = max(abs(x0 + speed[0] * elapsed - ahead[0]), abs(y0 + speed[1] * elapsed - ahead[1]))
            if off <= STRAIGHT_M:
                continue
        bends.append((when, at, kind))
        x0, y0, start, speed = x, y, when, None
    return bends


def _centiseconds(seconds: Any) -> NDArray[np.int64]:
    """Return times in whole centiseconds; those of what never happens are 0."""
    rounded: NDArray[np.int64] = np.round(100 * np.where(np.isfinite(seconds), seconds, 0.0)).astype(np.int64)
    return rounded
