"""Run episodes of one agent in one scenario, and record them."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import Observations, SlotBelief
from parkenv.compiled.arrays import BoolArray
from parkenv.engine.search_record import Moment, SearchRecord
from parkenv.engine.state import SearchState
from parkenv.mapping.trips import Trip
from parkenv.studies.results import DECISIONS, Row, timed_row
from parkenv.studies.simulate import Observer, Step, make_search, simulate
from parkenv.world.cost_terms import METRICS, REWARD_TERMS
from parkenv.world.scenario import Scenario
from planners.agent import Agent
from planners.bounds.oracle import best_slot
from planners.bounds.relaxation import SearchBound
from planners.routes import DriveRoutes


class SearchRecorder(Observer):
    """Records a search, whose true occupancy no agent sees: the first plan, and each step if wanted."""

    def __init__(self, agent: Agent, *, steps: bool) -> None:
        self._preview_of, self._steps = getattr(agent, "plan_preview", None), steps

    def on_reset(self, env: gym.Env[Any, Any], observation: Any) -> None:
        self._env: Any = env.unwrapped
        self.policy: NDArray[np.int64] | None = (
            None  # of the first decision; None for agents without a policy
        )
        self.moments: list[Moment] = []
        self._decided = False
        self._record()

    def on_step(self, step: Step) -> None:
        if not self._decided:
            self.policy = getattr(step.memory, "policy", None)
        self._decided = True
        if self._steps:
            action = int(step.action)
            preview = self._preview_of and self._preview_of(step.observation, action, step.memory)
            self._record(action=action, plan=preview or (), info=step.info)

    def _record(self, **decision: Any) -> None:
        if self._steps:
            state, perception = self._env.state, getattr(self._env, "perception", None)
            captures = () if perception is None else perception.results
            self.moments.append(Moment(state.time, state.vertex, state.belief, captures=captures, **decision))


class TripRecorder(Observer):
    """Collects the observations of each step of a search, for a map that learns from it."""

    def on_reset(self, env: gym.Env[Any, Any], observation: Any) -> None:
        self.observations: list[Observations] = []

    def on_step(self, step: Step) -> None:
        self.observations.append(SlotBelief.of_observation(step.next_observation).observations)

    def trip(self, key: str, time: float, date: str) -> Trip:
        return Trip(
            key, time, date, *(np.concatenate(parts) for parts in zip(*self.observations, strict=True))
        )


class EpisodeRunner:
    """Runs episodes of one agent, which has a `name` in records, in one scenario.

    With a `rig`, slots are observed in `parkenv/SearchPerception-v2`, with its `detector` and captures `every` metre.
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
        if rig is not None:
            options = {"detector": detector} | ({} if every is None else {"every": every})
        self.env = make_search(scenario, agent, rig, **options)
        self._routes = DriveRoutes(scenario)

    def bound_s(self, seed: int) -> float:
        self.env.reset(seed=seed)
        return self._bound_s()

    def run(self, seed: int, observers: Sequence[Observer] = (), *, moments: bool = False) -> SearchRecord:
        recorder = SearchRecorder(self.agent, steps=moments)
        result = simulate(self.env, self.agent, seed, (recorder, *observers))
        metrics = {
            name: value
            for name, value in result.info.items()
            if name not in (*REWARD_TERMS, "scenario", "scenario_index")
        }
        state, scenario = self._state, self.scenario
        return SearchRecord(
            scenario=scenario,
            agent=self.name,
            seed=seed,
            arrival=state.arrival,
            world=state.world,
            path=list(state.path),
            occupied=self._occupied(),
            forecast=scenario.forecast(state.arrival).p_occupied,
            policy=recorder.policy,
            metrics=metrics | {"replans": int(getattr(result.memory, "replans", 0))},
            truncated=result.truncated,
            bound_s=self._bound_s(),
            decision_s=result.decision_s,
            moments=recorder.moments,
        )

    def row(self, seed: int) -> Row:
        """Return the row of `episodes.csv` of a search; `bound` drives none, and its row has a total alone."""
        if not isinstance(self.agent, SearchBound):
            return timed_row(self.run(seed))
        self.env.reset(seed=seed)
        state = self._state
        total_s = self.agent.of_world(state.world, int(state.path[0]), state.arrival.time)
        unknown = dict.fromkeys((*METRICS, "replans", "steps"))
        times = {"arrival_s": round(state.arrival.time, 3), "occupancy": self.occupancy}
        outcome = {"total_s": total_s, "truncated": False, "bound_s": self._bound_s(), DECISIONS: ""}
        return {"seed": seed, "day": state.arrival.day, **times, "slot": "", **unknown, **outcome}

    @property
    def occupancy(self) -> float:
        return float(self._occupied().mean())

    def _occupied(self) -> BoolArray:
        state = self._state
        return state.world.occupied(np.arange(self.scenario.lot.n_slots), state.arrival.time)

    @property
    def _state(self) -> SearchState:
        state: SearchState = self.env.unwrapped.state  # type: ignore[attr-defined]
        return state

    def _bound_s(self) -> float:
        state = self._state
        choice = best_slot(self.scenario, self._routes, state.world, state.path[0], state.arrival.time)
        return float(min(choice.total_s, self.scenario.give_up_s))
