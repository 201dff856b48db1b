"""Run episodes of one agent in one scenario, and record them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from parkenv.engine.state import SearchState
from parkenv.show.search_record import Moment, SearchRecord
from parkenv.studies.simulate import Observer, Step, make_search, simulate
from parkenv.world.scenario import Scenario
from planners.agent import Agent
from planners.bounds.oracle import best_slot
from planners.routes import DriveRoutes


class SearchRecorder(Observer):
    """Records a search, whose true occupancy no agent sees.

    Args:
        agent: the agent, whose plans are recorded if it has `plan_preview`; None to record none.
        keeps: whether each moment is kept, instead of the first plan alone.

    Attributes:
        policy: plan of the first decision, (n_vertices,) int64; None for agents without a policy.
        moments: the arrival and each step, if they are kept.
    """

    def __init__(self, agent: Agent | None = None, *, keeps: bool = True) -> None:
        self._preview_of, self._keeps = getattr(agent, "plan_preview", None), keeps

    def on_reset(self, env: gym.Env[Any, Any], observation: Any) -> None:
        """Record the arrival."""
        del observation
        self._env: Any = env.unwrapped
        self.policy: NDArray[np.int64] | None = None
        self.moments: list[Moment] = []
        self._decided = False
        if self._keeps:
            self._add()

    def on_step(self, step: Step) -> None:
        """Record the decision, the plan that led to it, and the next state."""
        if not self._decided:
            self.policy = getattr(step.memory, "policy", None)
        self._decided = True
        if self._keeps:
            action = int(step.action)
            preview = self._preview_of and self._preview_of(step.observation, action, step.memory)
            self._add(action, tuple(preview.path) if preview else (), step.info)

    def _add(self, *step: Any) -> None:
        state, perception = self._env.state, getattr(self._env, "perception", None)
        captures = () if perception is None else perception.results
        moment = Moment(state.time, state.vertex, state.belief, *step)
        self.moments.append(moment._replace(captures=captures))


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

    def run(self, seed: int, observers: Sequence[Observer] = (), *, moments: bool = False) -> SearchRecord:
        """Run one search in the world of `seed`.

        Args:
            seed: seed of the world.
            observers: further observers.
            moments: whether the record holds each step.
        """
        recorder = SearchRecorder(self.agent, keeps=moments)
        result = simulate(self.env, self.agent, seed, (recorder, *observers))
        metrics = {
            name: value for name, value in result.info.items() if name not in ("reward_terms", "place")
        }
        state, scenario = self._state, self.scenario
        return SearchRecord(
            scenario=scenario,
            agent=self.name,
            seed=seed,
            arrival=state.arrival,
            world=state.world,
            path=list(state.path),
            occupied=state.world.occupied(np.arange(scenario.lot.n_slots), state.arrival.time),
            forecast=scenario.forecast(state.arrival).p_occupied,
            policy=recorder.policy,
            metrics=metrics | {"replans": int(getattr(result.memory, "replans", 0))},
            truncated=result.truncated,
            bound_s=self._bound_s(),
            decision_s=result.decision_s,
            moments=recorder.moments,
        )

    @property
    def _state(self) -> SearchState:
        state: SearchState = self.env.unwrapped.state  # type: ignore[attr-defined]
        return state

    def _bound_s(self) -> float:
        state = self._state
        choice = best_slot(self.scenario, self._routes, state.world, state.path[0], state.arrival.time)
        return float(min(choice.total_s, self.scenario.give_up_s))
