"""One search from arrival to goal: run it, time the decisions, and keep what a picture needs."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from parkenv.envs.search_state import SearchState
from parkenv.world.scenario import Scenario
from planners.agent import Agent
from planners.bounds.oracle import OracleAgent, best_slot
from planners.routes import DriveRoutes


@dataclass
class SearchTrace:
    """What one search looked like.

    Attributes:
        scenario: where it took place.
        agent: who searched, by name.
        path: vertices in the order driven, the entry first.
        occupied: (n_slots,) bool, the truth at the arrival.
        forecast: (n_slots,) float64, the prior that the car came with.
        policy: (n_vertices,) int64, the plan before anything was seen on the way; None for agents without.
        metrics: what the episode's last `info` told.
    """

    scenario: Scenario
    agent: str
    path: list[int]
    occupied: NDArray[np.bool_]
    forecast: NDArray[np.float64]
    policy: NDArray[np.int64] | None
    metrics: dict[str, Any]


@dataclass
class Episode:
    """The outcome of one search.

    Attributes:
        row: the line of `episodes.csv`, without the columns that name agent and setting.
        decision_s: wall time of each decision, s. Not part of the row: it differs from run to run.
        trace: for pictures.
    """

    row: dict[str, Any]
    trace: SearchTrace
    decision_s: list[float] = field(default_factory=list)


class EpisodeRunner:
    """Runs one agent in one scenario, episode after episode.

    Args:
        scenario: the scenario, with the costs and speeds of the setting.
        name: the agent's name, for the trace.
        agent: the agent.
        rig: of `parkenv/SearchPerception-v0`, whose sensors observe the slots; None: `parkenv/Search-v0`.
        detector: of `parkenv/SearchPerception-v0`.
    """

    def __init__(
        self,
        scenario: Scenario,
        name: str,
        agent: Agent,
        rig: str | None = None,
        detector: str | None = None,
    ) -> None:
        self.scenario = scenario
        self.name = name
        self.agent = agent
        self.env = (
            gym.make("parkenv/Search-v0", scenario=scenario)
            if rig is None
            else gym.make("parkenv/SearchPerception-v0", scenario=scenario, rig=rig, detector=detector)
        )
        if (k := getattr(agent, "local_k", None)) is not None:
            from parkenv.envs.local_observation import LocalObservation

            self.env = LocalObservation(self.env, k)
        self._routes = DriveRoutes(scenario)

    def bound_s(self, seed: int) -> float:
        """Total time in the world of `seed` of one who knows it all: nobody is faster."""
        self.env.reset(seed=seed)
        hidden = self.env.unwrapped.state  # type: ignore[attr-defined]
        return self._bound_s(hidden)

    def _bound_s(self, start: SearchState) -> float:
        choice = best_slot(self.scenario, self._routes, start.world, start.vertex, start.time)
        return min(choice.total_s, self.scenario.give_up_s)

    def run(self, seed: int) -> Episode:
        """Search once in the world of `seed`.

        A search that the step limit cuts off is charged `give_up_s`, as one that finds the lot full: not
        to park must never look cheap.
        """
        env, scenario = self.env, self.scenario
        observation, _ = env.reset(seed=seed)
        hidden = env.unwrapped.state  # type: ignore[attr-defined]
        everything = np.arange(scenario.lot.n_slots)
        occupied = hidden.world.occupied(everything, hidden.time)
        forecast = hidden.belief.prior
        bound_s = self._bound_s(hidden)
        if isinstance(self.agent, OracleAgent):
            self.agent.reveal(hidden.world, hidden.time)

        memory: Any = None
        policy = None
        decision_s = []
        over = truncated = False
        info: dict[str, Any] = {}
        while not over:
            start = time.perf_counter()
            action, memory = self.agent.predict(observation, memory)
            decision_s.append(time.perf_counter() - start)
            if len(decision_s) == 1:
                policy = getattr(memory, "policy", None)
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        info = {k: v for k, v in info.items() if k != "reward_terms"}
        if truncated:
            info["gave_up_s"] += scenario.give_up_s
            info["total_s"] += scenario.give_up_s
        info["replans"] = int(getattr(memory, "replans", 0))
        parked = bool(info["parked"])
        row = {
            "seed": seed,
            "day": hidden.arrival.day,
            "arrival_s": round(hidden.arrival.time, 3),
            "occupancy": float(occupied.mean()),
            "slot": scenario.lot.slot_ids[hidden.vertex] if parked else "",
            **info,
            "steps": len(decision_s),
            "truncated": bool(truncated),
            "bound_s": bound_s,
        }
        trace = SearchTrace(scenario, self.name, list(hidden.path), occupied, forecast, policy, info)
        return Episode(row, trace, decision_s)
