"""Plans of the thesis's planner, beside the searches that it makes with them (T Fig. 4.9 to 4.12)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from parkenv.engine.search_record import SearchRecord
from parkenv.errors import InputError
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.cases import Case, settings_of
from parkenv.studies.compare.comparison import Grid
from parkenv.studies.results import Row
from parkenv.world.scenario import Scenario
from planners.agent import make_agent
from planners.thesis.replanning import StaticAgent


def plan_searches(
    scenario: Scenario, agent: AgentSpec, grid: Grid, seed: int
) -> tuple[list[Row], Sequence[SearchRecord]]:
    """Plan and run one search in each setting.

    Returns:
        A row for each setting, with expected and total time, s, and the path; and the searches, for pictures.
    """
    if not isinstance(make_agent(agent.name, scenario, **agent.options), StaticAgent):
        raise InputError(f"--agents {agent.label!r} makes no plan; known: mdp, mdp-static")
    rows, traces = [], []
    for setting in settings_of(scenario, grid.failure_s, grid.v_walk_kmh, grid.v_drive_kmh):
        case = Case(setting, agent.name, options=agent.options)
        trace = case.runner().run(seed)
        planner = make_agent(agent.name, setting, **agent.options)
        assert isinstance(planner, StaticAgent)
        expected = float(planner.expected_time(trace.forecast)[trace.path[0]])
        ids, n = setting.lot.slot_ids, setting.lot.n_slots
        path = [ids[v] if v < n else f"junction {v}" for v in trace.path]
        row = {
            **case.columns, "expected_s": expected, "slot": path[-1] if trace.metrics["parked"] else "",
            **trace.metrics, "path": path, "occupancy": float(np.mean(trace.occupied)),
        }  # fmt: skip
        rows.append(row)
        traces.append(trace)
    return rows, traces
