"""Choose the searches of suite v3: `python -m parkenv.studies.benchmark.choose_searches OUT.json`.

The population of a task of suite v2 is 5,000 worlds. Its strata divide them by the share of slots taken at the
arrival, finer where the lot is full. Some agents search in the last worlds of each population: from their paired
differences follows how many searches each stratum gets (Neyman 1934), so that 3,000 in all tell agents apart best.
"""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.files.limited_reading import read_json
from parkenv.studies.benchmark.suite import SUITE_FOLDER, Suite, controls_of
from parkenv.studies.compare.cases import Case

SOURCE = "v2"
FIRST_SEED, POPULATION, SEARCHES, LEAST = 3_000_000, 5_000, 3_000, 8
EDGES = (0.0, 0.3, 0.55, 0.75, 0.87, 0.95, 1.0)
"""Shares of the population below the strata, in the order of the occupancy at arrival and the clairvoyant bound."""
PILOTS, PILOT_SEARCHES = ("mdp", "mdp-tuned", "first-free"), 400


def strata_of(number: int) -> tuple[list[dict[str, Any]], FloatArray]:
    """Divide the population of a task into strata.

    Returns:
        For each stratum its share, the means of its controls and all of its seeds; and for each pair of pilots the
        standard deviation of their paired difference in each stratum, s, (pairs, strata).
    """
    suite = Suite.named(SOURCE)
    scenario = suite.tasks[number].made(suite.arrival)
    seeds = FIRST_SEED + POPULATION * number + np.arange(POPULATION)
    worlds = controls_of(scenario, seeds.tolist())
    order = np.lexsort((worlds[:, 0], worlds[:, 1]))
    parts = np.split(order, np.round(POPULATION * np.array(EDGES[1:-1])).astype(int))
    strata = [
        {
            "share": round(len(its) / POPULATION, 6),
            "means": np.round(worlds[its].mean(axis=0), 9).tolist(),
            "seeds": seeds[np.sort(its)].tolist(),
        }
        for its in parts
    ]
    last = seeds[-PILOT_SEARCHES:].tolist()
    times = [np.array([row["total_s"] for row in Case(scenario, name).run(last)]) for name in PILOTS]
    stratum = np.empty(POPULATION, int)
    for h, its in enumerate(parts):
        stratum[its] = h
    spreads = [
        [(one - other)[stratum[-PILOT_SEARCHES:] == h].std(ddof=1) for h in range(len(parts))]
        for one, other in itertools.combinations(times, 2)
    ]
    return strata, np.array(spreads)


def choose_searches() -> dict[str, Any]:
    """Return the content of the suite's file."""
    content: dict[str, Any] = read_json(SUITE_FOLDER / f"{SOURCE}.json")
    made = joblib.Parallel(n_jobs=-1)(joblib.delayed(strata_of)(n) for n in range(len(content["tasks"])))
    # (tasks, pairs, strata): what a stratum adds to the error of a pair; all pairs count alike.
    parts = np.array([spreads for _, spreads in made]) * np.diff(EDGES)
    wanted = np.sqrt(((parts / parts.sum(axis=(0, 2), keepdims=True)) ** 2).sum(axis=1))
    counts = np.maximum(LEAST, np.round(SEARCHES * wanted / wanted.sum()).astype(int))
    while excess := counts.sum() - SEARCHES:  # the largest strata pay for the least
        counts[np.unravel_index(counts.argmax(), counts.shape)] -= np.sign(excess)
    for task, (strata, _), its in zip(content["tasks"], made, counts, strict=True):
        task["strata"] = [
            {**part, "seeds": part["seeds"][:count]} for part, count in zip(strata, its, strict=True)
        ]
    del content["first_seed"], content["episodes"]
    return content | {
        "name": "v3",
        "description": "The tasks of v2 in a quarter of its searches: a stratified sample, with more searches where "
        "the times of agents differ most, such as on full days.",
    }


if __name__ == "__main__":
    text = json.dumps(choose_searches(), separators=(",", ":"))
    Path(sys.argv[1]).write_text(text.replace('{"name"', '\n{"name"') + "\n", encoding="utf-8")
