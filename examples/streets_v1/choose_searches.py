"""The searches of the suite `streets-v1`: `python examples/streets_v1/choose_searches.py OUT.json`, twenty minutes.

By the procedure of `parkenv.studies.benchmark.suite`, which made those of `v3`, too.
"""

import itertools
import json
import sys
from pathlib import Path

import numpy as np

from parkenv.studies.benchmark.suite import Stratum, Suite, Task, worlds_of
from parkenv.studies.compare.cases import Case
from parkenv.world.occupancy.arrival_window import ArrivalWindow

FIRST_SEED, POPULATION, SEARCHES, LEAST = 4_000_000, 2_000, 1_200, 8
EDGES = (0.0, 0.3, 0.55, 0.75, 0.87, 0.95, 1.0)
"""Shares of the population below the strata, in the order of the occupancy at arrival and the clairvoyant bound."""
PILOTS, PILOT_SEARCHES = ("mdp", "mdp-tuned", "first-free"), 150
NOON, DAYS = {"arrival": "11:00-14:00"}, {"day_error": (0.5,)}
TASKS = (
    {"name": "morning", **DAYS, "goal": 12, "arrival": "07:00-09:00"},
    {"name": "noon", **DAYS, "goal": 12, **NOON},
    {"name": "evening", **DAYS, "goal": 7, "arrival": "18:00-21:00"},
    {"name": "saturday", **DAYS, "goal": 18, "arrival": "12:00-18:00", "days": "sat"},
    {"name": "busy", **DAYS, "goal": 12, **NOON, "occupancy_level": 0.85},
    {"name": "full", **DAYS, "goal": 12, **NOON, "occupancy_level": 0.92},
    {"name": "full-edge", **DAYS, "goal": 0, **NOON, "occupancy_level": 0.92},
    {"name": "nearly-full", **DAYS, "goal": 7, "arrival": "18:00-21:00", "occupancy_level": 0.96},
    {"name": "other-day", "day_error": (0.8,), "goal": 18, **NOON, "occupancy_level": 0.85},
    {"name": "full-as-forecast", "day_error": (0.0,), "goal": 12, **NOON, "occupancy_level": 0.92},
    {"name": "full-sensed", **DAYS, "goal": 7, **NOON, "occupancy_level": 0.92, "sensor_model": "laser"},
)
SUITE = {
    "format": "parkenv-benchmark-suite",
    "name": "streets-v1",
    "description": "A made district with spaces at kerbs, as full as the kerbs of four cities by hour of weekdays and "
    "Saturday, and fuller; a stratified sample of searches.",
    "arrival": "11:00-14:00",
    "days": "weekdays",
}


def strata_of(number):
    """Divide the population of a task into strata.

    Returns:
        For each stratum its share, the means of its controls and all of its seeds; and for each pair of pilots the
        standard deviation of their paired difference in each stratum, s, (pairs, strata).
    """
    seeds = FIRST_SEED + POPULATION * number + np.arange(POPULATION)
    whole = Stratum(1.0, tuple(seeds.tolist()), (0.0, 0.0))
    task = Task(scenario="kerbs", strata=(whole,), **TASKS[number])
    window = ArrivalWindow.parse(SUITE["arrival"], SUITE["days"])
    suite = Suite(SUITE["name"], SUITE["description"], window, (task,), "")
    worlds = worlds_of(task, suite)
    order = np.lexsort((worlds[:, 0], worlds[:, 1]))
    parts = np.split(order, np.round(POPULATION * np.array(EDGES[1:-1])).astype(int))
    strata = [
        {
            "share": round(len(part) / POPULATION, 6),
            "means": np.round(worlds[part].mean(axis=0), 9).tolist(),
            "seeds": seeds[np.sort(part)].tolist(),
        }
        for part in parts
    ]
    scenario, last = task.made(window), seeds[-PILOT_SEARCHES:].tolist()
    times = [np.array([row["total_s"] for row in Case(scenario, name).run(last)]) for name in PILOTS]
    stratum = np.empty(POPULATION, int)
    for h, part in enumerate(parts):
        stratum[part] = h
    stratum = stratum[-PILOT_SEARCHES:]
    pairs = list(itertools.combinations(times, 2))
    return strata, [[np.std((a - b)[stratum == h], ddof=1) for h in range(len(parts))] for a, b in pairs]


def choose_searches():
    """Return the content of the suite's file."""
    made = [strata_of(number) for number in range(len(TASKS))]
    # (tasks, pairs, strata): what a stratum adds to the error of a pair; all pairs count alike.
    parts = np.array([spreads for _, spreads in made]) * np.diff(EDGES)
    wanted = np.sqrt(((parts / parts.sum(axis=(0, 2), keepdims=True)) ** 2).sum(axis=1))
    counts = np.maximum(LEAST, np.round(SEARCHES * wanted / wanted.sum()).astype(int))
    while excess := counts.sum() - SEARCHES:  # the largest strata pay for the least
        counts[np.unravel_index(counts.argmax(), counts.shape)] -= np.sign(excess)
    tasks = [
        {
            "name": task["name"],
            "scenario": "kerbs",
            **task,
            "strata": [
                {**part, "seeds": part["seeds"][:count]} for part, count in zip(strata, chosen, strict=True)
            ],
        }
        for task, (strata, _), chosen in zip(TASKS, made, counts, strict=True)
    ]
    return SUITE | {"tasks": tasks}


if __name__ == "__main__":
    text = json.dumps(choose_searches(), separators=(",", ":"))
    Path(sys.argv[1]).write_text(text.replace('{"name"', '\n{"name"') + "\n", encoding="utf-8")
