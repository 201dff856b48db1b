"""Fit a sensor model: count the errors of the perception pipeline in searches with simulated sensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.evaluation.experiments.workers import HERE, Workers
from parkenv.world.scenario import Scenario
from parkenv.world.sensor_model import SensorBand, SensorModel
from planners.agent import make_agent

IntArray = NDArray[np.int64]

BAND_ENDS = (0.5, 3.5, 6.5, 9.5, 12.5, 16.0)
"""m, from the car to a slot's vertex: upper ends of the distance bands; the first is the slot beside the car."""
AGENTS = ("greedy-drive", "mdp", "first-free")
"""Agents that search, so that slots are observed from where searches lead."""
LEAST_OBSERVATIONS = 20
"""Observations in a band from which its own rates are used, not those of all bands."""
_INITIAL_MODEL = SensorModel(BAND_ENDS[-1], 0.98, 0.02)


@dataclass(frozen=True, eq=False)
class ObservationCounts:
    """Counts of slots within sensor range after a step, by true and observed state.

    Attributes:
        counts: (bands, 2, 2, 3) int64, by distance band, by whether the slot is beside the car, by whether it is taken,
            and by the observed state: none, free, taken.
    """

    counts: IntArray

    @classmethod
    def zero(cls) -> ObservationCounts:
        """Return counts of zero."""
        return cls(np.zeros((len(BAND_ENDS), 2, 2, 3), dtype=np.int64))

    def __add__(self, other: ObservationCounts) -> ObservationCounts:
        return ObservationCounts(self.counts + other.counts)

    def fit(self) -> SensorModel:
        """Return the sensor model with these rates, each smoothed by half an observation (Jeffreys's prior).

        Raises:
            InputError: too few observations.
        """
        observed = self.counts.sum(axis=(0, 1))[:, 1:]
        if observed.sum(axis=1).min() < LEAST_OBSERVATIONS:
            free, taken = observed.sum(axis=1).tolist()
            raise InputError(
                f"{free} observations of free and {taken} of taken slots, want at least {LEAST_OBSERVATIONS} of each"
            )
        false_alarm, hit = _taken_rates(observed)
        bands = []
        for i, end in enumerate(BAND_ENDS):
            for beside in (False, True):
                in_band = self.counts[i, int(beside)]
                n, observed = in_band.sum(), in_band[:, 1:]
                enough = observed.sum(axis=1).min() >= LEAST_OBSERVATIONS
                rates = _taken_rates(observed) if enough else (false_alarm, hit)
                seen = float(observed.sum() / n) if n else 0.0
                bands.append(SensorBand(end, beside, round(seen, 4), round(rates[1], 4), round(rates[0], 4)))
        return SensorModel(BAND_ENDS[-1], round(hit, 4), round(false_alarm, 4), tuple(bands))


def _taken_rates(observed: IntArray) -> tuple[float, float]:
    """Return the fraction observed as taken of free slots and of taken slots, from (2, 2) counts."""
    free, taken = (float((row[1] + 0.5) / (row.sum() + 1.0)) for row in observed)
    return free, taken


def count_observations(
    scenario: Scenario, rig: str, agent_name: str, seeds: Sequence[int], weather: str | None = None
) -> ObservationCounts:
    """Run searches with simulated sensors, and count observed against true slot states.

    Args:
        scenario: the world.
        rig: `laser` or `stereo`.
        agent_name: the agent that searches.
        seeds: one for each search.
        weather: None: drawn for each search.

    Raises:
        InputError: an unknown rig.
    """
    scenario = scenario.replace(sensor_model=_INITIAL_MODEL)
    env = gym.make("parkenv/SearchPerception-v0", scenario=scenario, rig=rig, weather=weather)
    agent = make_agent(agent_name, scenario)
    starts, slots = scenario.slots_in_view
    distance, beside = scenario.sight_lines
    band = np.searchsorted(BAND_ENDS, distance)
    counts = ObservationCounts.zero().counts
    inner: Any = env.unwrapped
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        memory: Any = None
        over = False
        while not over:
            action, memory = agent.predict(observation, memory)
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
            if info["parked"]:
                break
            state, observation_of_slots = inner.state, inner.perception.observation
            rows = slice(starts[state.vertex], starts[state.vertex + 1])
            near = slots[rows]
            observed = np.zeros(len(near), dtype=np.int64)
            observed[np.searchsorted(near, observation_of_slots.slots)] = 1 + observation_of_slots.taken
            taken = state.world.occupied(near, state.time).astype(np.int64)
            np.add.at(counts, (band[rows], beside[rows].astype(np.int64), taken, observed), 1)
    return ObservationCounts(counts)


def count_all_observations(
    scenarios: Sequence[Scenario],
    rig: str,
    searches: int,
    *,
    seed: int = 0,
    weather: str | None = None,
    workers: Workers = HERE,
    on_progress: Callable[[], None] = lambda: None,
) -> ObservationCounts:
    """Sum `count_observations` over all `AGENTS` in all scenarios.

    Args:
        scenarios: worlds.
        rig: `laser` or `stereo`.
        searches: of each agent in each scenario.
        seed: of the first search.
        weather: None: drawn for each search.
        workers: run the searches; the result does not depend on them.
        on_progress: called after each search.
    """
    tasks = [
        partial(count_observations, scenario, rig, agent_name, [s], weather)
        for scenario in scenarios
        for s in range(seed, seed + searches)
        for agent_name in AGENTS
    ]
    total = ObservationCounts.zero()
    for _, counts in workers.results(tasks):
        total += counts
        on_progress()
    return total
