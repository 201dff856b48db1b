"""Benchmark of planners by the time that they are given for a decision: ours, and those of pomdp-py."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from benchmarks.rows import Row
from parkenv.lots.lot_files import PLACES
from parkenv.scenarios.spec import lot_scenario, scenario_spec
from parkenv.studies.compare.comparison import Comparison
from parkenv.studies.fields import AgentSpec
from parkenv.studies.results import SPEC_FILE
from parkenv.studies.runner import run

OURS = ("belief(budget_ms=1)", "mdp", "network", "examples.rollout_agent:Rollout")
PEERS = ("examples.peers.pomdp_py_agents:POUCT", "examples.peers.pomdp_py_agents:POMCP")
"""Planners of pomdp-py, by the adapters among the examples."""
SCENARIOS = ("mini", "campus", "street", "jam")
REAL_PLACES = ("place-01", "place-09", "place-17")
KEYS = ("scenario", "planner", "budget_ms", "episodes", "total_s", "total_s_ci95", "decision_ms")


def pomdp_rows(folder: Path, seed: int, episodes: int, budgets_ms: Sequence[float]) -> list[Row]:
    """Return the rows of `python benchmarks/run.py pomdp`; run the comparison in a folder, or go on with it.

    Args:
        folder: folder of the comparison.
        seed: first seed of the worlds.
        episodes: searches of each planner in each scenario.
        budgets_ms: times for a decision, ms, of the planners that have a limit.
    """
    study = planners_in_time(seed, episodes, budgets_ms)
    result = run(study, folder, resume=(folder / SPEC_FILE).exists(), progress=_progress)
    return [{key: row[key] for key in KEYS} for row in result.rows]


def planners_in_time(seed: int, episodes: int, budgets_ms: Sequence[float]) -> Comparison:
    """Return the comparison of ours, and of the peers if pomdp-py is here, in the same worlds."""
    peers = PEERS if find_spec("pomdp_py") else ()
    real = (lot_scenario(PLACES / f"{name}.geojson") for name in REAL_PLACES)
    return Comparison().changed(
        agents=tuple(map(AgentSpec.of, (*OURS, *peers))),
        scenarios=(*map(scenario_spec, SCENARIOS), *real),
        grid={"budget_ms": tuple(budgets_ms)},
        seed=seed,
        episodes=episodes,
    )


def _progress(doing: str, done: int, total: int) -> None:
    print(f"\r{doing} {done}/{total}", end="" if done < total else "\n", file=sys.stderr, flush=True)
