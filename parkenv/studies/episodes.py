"""Run episodes of one agent in one scenario: a table row for each, and traces for pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from parkenv.engine.state import SearchState
from parkenv.show.search_trace import SearchTrace
from parkenv.studies.results import DECISIONS
from parkenv.studies.simulate import Observer, Step, make_search, simulate
from parkenv.world.scenario import Scenario
from planners.agent import Agent
from planners.bounds.oracle import best_slot
from planners.routes import DriveRoutes


@dataclass
class Episode:
    """The outcome of one search."""

    row: dict[str, Any]  # row of `episodes.csv`, without the columns that identify agent and setting
    # wall time of each decision, s; not in the row because it differs from run to run
    decision_s: list[float]
    trace: SearchTrace  # trace for pictures

    @property
    def timed_row(self) -> dict[str, Any]:
        """The row with the wall times of its decisions."""
        return self.row | {DECISIONS: " ".join(str(round(1e6 * s)) for s in self.decision_s)}


class FirstPlan(Observer):
    """Records the plan of the first decision.

    Attributes:
        policy: (n_vertices,) int64; None for agents without a policy.
    """

    def on_reset(self, env: gym.Env[Any, Any], observation: Any) -> None:
        """Reset the recorder."""
        del env, observation
        self.policy: NDArray[np.int64] | None = None
        self._decided = False

    def on_step(self, step: Step) -> None:
        """Record the first plan."""
        if not self._decided:
            self.policy = getattr(step.memory, "policy", None)
            self._decided = True


class EpisodeRunner:
    """Runs episodes of one agent in one scenario.

    Args:
        scenario: the scenario, with the costs and speeds of the setting.
        name: name of the agent, for the trace.
        agent: the agent.
        rig: sensor rig of the car; None for the scenario's sensor model; see `make_search`.
        detector, every: detector and distance between captures, m, for `parkenv/SearchPerception-v2`; None for its own.
    """

    def __init__(
        self,
        scenario: Scenario,
        name: str,
        agent: Agent,
        rig: str | None = None,
        detector: str | None = None,
        every: float | None = None,
    ) -> None:
        self.scenario = scenario
        self.name = name
        self.agent = agent
        options: dict[str, Any] = {}
        if rig is not None and getattr(agent, "scans_k", None) is None:
            options = {"detector": detector} | ({} if every is None else {"every": every})
        self.env = make_search(scenario, agent, rig, **options)
        self._routes = DriveRoutes(scenario)

    def bound_s(self, seed: int) -> float:
        """Return the clairvoyant lower bound of the total time, s, in the world of `seed`."""
        self.env.reset(seed=seed)
        return self._bound_s()

    def run(self, seed: int, observers: Sequence[Observer] = ()) -> Episode:
        """Run one search in the world of `seed`."""
        scenario, first_plan = self.scenario, FirstPlan()
        result = simulate(self.env, self.agent, seed, (first_plan, *observers))
        metrics = {
            name: value for name, value in result.info.items() if name not in ("reward_terms", "place")
        }
        metrics["replans"] = int(getattr(result.memory, "replans", 0))
        state = self._state
        occupied = state.world.occupied(np.arange(scenario.lot.n_slots), state.arrival.time)
        row = {
            "seed": seed,
            "day": state.arrival.day,
            "arrival_s": round(state.arrival.time, 3),
            "occupancy": float(occupied.mean()),
            "slot": scenario.lot.slot_ids[state.vertex] if metrics["parked"] else "",
            **metrics,
            "steps": result.steps,
            "truncated": result.truncated,
            "bound_s": self._bound_s(),
        }
        forecast = scenario.forecast(state.arrival).p_occupied
        trace = SearchTrace(
            scenario, self.name, list(state.path), occupied, forecast, first_plan.policy, metrics
        )
        return Episode(row, result.decision_s, trace)

    @property
    def _state(self) -> SearchState:
        state: SearchState = self.env.unwrapped.state  # type: ignore[attr-defined]
        return state

    def _bound_s(self) -> float:
        state = self._state
        choice = best_slot(self.scenario, self._routes, state.world, state.path[0], state.arrival.time)
        return float(min(choice.total_s, self.scenario.give_up_s))
