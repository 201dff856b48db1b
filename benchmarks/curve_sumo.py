"""Curves of made networks against SUMO on others: `python benchmarks/curve_sumo.py [SEED ...]` with SUMO installed.

Curves are fitted to days of fleets on ten networks, and predict the search times that SUMO has on three more, hour by
hour, from how full these are there. Cars, arrivals, stays and entries are equal in both; drivers are `greedy-drive`.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # a script's own folder stands there

from benchmarks.sumo_days import run_fleet, run_sumo, sumo_folder
from benchmarks.town import SHIFT, SPEED, blocks_of
from parkenv import make_scenario
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.lots.generators import city_lot
from parkenv.studies.curve.curves import Paths, Town, fit_curve
from parkenv.studies.curve.zones import LONE, OF_CARS, STATE, LoneSearches, Zones
from parkenv.studies.fleet.day import Roads
from parkenv.world.demand import Demand, ExponentialTime, PoissonArrivals
from planners.heuristics import POLICIES

SPACES, HOURS, DAYS = 250, 4, 1
RATES = (0.5, 0.7, 0.85, 0.95)  # cars an hour for each space, which they take for an hour
TRAINED, HELD_OUT = range(10, 20), range(3)


def fleet_on(seed, rate):
    """Cars on a made network, at a rate of arrivals."""
    lot = blocks_of(city_lot(SPACES, seed))
    begin = 8 * 3600.0
    arrivals = PoissonArrivals(rate * float(lot.capacity.sum()), begin, begin + HOURS * 3600.0)
    demand = Demand(arrivals, ExponentialTime(3600.0), entry_weights=(1.0,) * len(lot.entries))
    scenario = make_scenario(lot, v_drive=SPEED)
    scenario = scenario.replace(sensor_model=dataclasses.replace(scenario.sensor_model, view_range=SHIFT))
    driver = DriverKind(policy=POLICIES["greedy-drive"])
    return Fleet(scenario, demand, background="none", drivers=[driver], leave_full_lot=False)


def row_of(fleet, day):
    """Return the row of `ZONES` of a day, in which the whole network is one zone."""
    cars, spaces = fleet.cars.copy(), float(fleet.scenario.lot.capacity.sum())
    cars["slot"] = day.slot
    known = np.isfinite(day.search_s) & (day.slot >= 0)
    beyond_s = np.where(known, day.search_s - Roads(fleet.scenario).direct_s(cars), 0.0)
    hour = np.minimum((cars["arrival"] - fleet.begin) // 3600.0, HOURS - 1).astype(int)
    came = [np.bincount(hour, its, HOURS) for its in (np.ones(len(hour)), known, beyond_s)]
    edges = 3600.0 * np.arange(HOURS + 1)
    inside = np.clip(day.left_s[known, None], 0.0, edges) - np.clip(day.began_s[known, None], 0.0, edges)
    occupancy = np.diff(inside.sum(axis=0)) / 3600.0 / spaces
    looks = np.arange(0.0, HOURS * 3600.0, 300.0)
    there = (day.began_s <= looks[:, None]) & (looks[:, None] < day.left_s) & known
    taken = np.array([np.bincount(day.slot[its], minlength=fleet.scenario.lot.n_slots) for its in there])
    lone = LoneSearches(fleet.scenarios).of_day(
        fleet, taken, (looks // 3600.0).astype(int), np.ones(len(hour), bool), hour
    )
    alone = {name: np.bincount(hour, its, HOURS) for name, its in zip(LONE, lone, strict=True)}
    sums = dict(zip(OF_CARS, (came[0], came[1], 0 * came[0], came[2], 0 * came[0]), strict=True))
    state = dict(zip(STATE, ([occupancy], [came[0] / spaces], occupancy, came[0] / spaces), strict=True))
    return {"zone": [0] * HOURS, "purpose": [0] * HOURS, "hour": range(HOURS), **sums, **alone, **state}


def town_on(seed, run):
    """The days of a network as zones of a town."""
    days = []
    for rate in RATES:
        fleet = fleet_on(seed, rate)
        days.append([row_of(fleet, run(fleet, day)) for day in range(DAYS)])
    return Town(Zones.of(fleet.scenarios, 1e5), ("all",), days)


def in_sumo(fleet, day):
    """The same day in SUMO."""
    fleet.reset(0, day)
    return run_sumo(fleet, sumo_folder(), 0.5, (HOURS + 1) * 3600.0)


def main(held_out):
    """Fit the curves, and print how far off they are in SUMO."""
    towns = {f"ours {seed}": town_on(seed, lambda fleet, day: run_fleet(fleet, 0, day)) for seed in TRAINED}
    for seed in held_out:
        towns[f"ours {seed}"] = town_on(seed, lambda fleet, day: run_fleet(fleet, 0, day))
        towns[f"SUMO {seed}"] = town_on(seed, in_sumo)
    paths = Paths.of(towns, RATES, 8)
    train = (paths.index[:, 0] < len(TRAINED))[:, None]
    predicted, _ = fit_curve(paths, "search_s", train)
    total, cars = (its.mean(axis=0) for its in paths.totals("search_s"))
    for number, name in enumerate(towns):
        its = paths.index[:, 0] == number
        if number >= len(TRAINED):
            whole, off = total[its].sum(), abs(total[its] - cars[its] * predicted[its]).sum()
            bias = (cars[its] * predicted[its]).sum() / whole - 1.0
            by_rate = (cars[its] * predicted[its]).sum(axis=0) / total[its].sum(axis=0) - 1.0
            sys.stdout.write(
                f"{name}: {whole / cars[its].sum():.1f} s, by hours off {off / whole:.1%}, in all {bias:+.1%}, "
                f"by demand {np.round(100 * by_rate).tolist()} %\n"
            )


if __name__ == "__main__":
    main([int(word) for word in sys.argv[1:]] or HELD_OUT)
