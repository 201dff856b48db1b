"""Benchmark of planners by the time that they are given for a decision: ours, and those of other libraries."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from parkenv.errors import needs_extra
from parkenv.lots.lot_files import PLACES
from parkenv.scenarios.spec import lot_scenario, scenario_spec
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.comparison import Comparison

OURS = ("belief(budget_ms=1)", "mdp", "network", "rollout")
PEERS = ("examples.pomdp_py_agents:POUCT", "examples.pomdp_py_agents:POMCP")
"""Planners of other libraries, the adapters of which are among the examples of the source tree."""
LIBRARY, ADAPTERS = "pomdp_py", Path("examples/pomdp_py_agents.py")
SCENARIOS = ("mini", "campus", "street", "jam")
REAL_PLACES = ("place-01", "place-09", "place-17")


def missing_peers() -> str:
    """Return why `PEERS` cannot be measured here; empty if they can."""
    if find_spec(LIBRARY) is None:
        return needs_extra("POUCT", "pomdp")
    if not ADAPTERS.exists():
        return f"their adapters, {ADAPTERS}, are not in the working directory"
    return ""


def planners_in_time(seed: int, episodes: int, budgets_ms: Sequence[float]) -> Comparison:
    """Return the study of `parkenv bench pomdp`: ours, and the peers that are here, in the same worlds.

    Args:
        seed: first seed of the worlds.
        episodes: searches of each planner in each scenario.
        budgets_ms: times for a decision, ms, of the planners that have a limit.
    """
    agents = (*OURS, *(() if missing_peers() else PEERS))
    scenarios = [
        *map(scenario_spec, SCENARIOS),
        *(lot_scenario(PLACES / f"{name}.geojson") for name in REAL_PLACES),
    ]
    return Comparison().changed(
        agents=tuple(map(AgentSpec.of, agents)),
        scenarios=tuple(scenarios),
        grid={"budget_ms": tuple(budgets_ms)},
        seed=seed,
        episodes=episodes,
    )
