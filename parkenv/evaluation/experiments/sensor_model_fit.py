"""How well the stack sees, counted in searches through the sensors, for the environment that does without them."""

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
"""m, from the car to a slot's vertex; the first band is the slot that the car stands at."""
DRIVERS = ("greedy-drive", "mdp", "first-free")
"""Agents whose searches are watched: looks are where searches go."""
LEAST_LOOKS = 20
"""Looks in a band from which its own rates are taken, not those of all bands."""
_AT_FIRST = SensorModel(BAND_ENDS[-1], 0.98, 0.02)


@dataclass(frozen=True, eq=False)
class LookCounts:
    """Slots in view after a step, and what the stack said of them.

    Attributes:
        looks: (bands, 2, 2, 3) int64, by distance, by whether the slot lies beside the car, by whether it is taken, and
            by what was said: nothing, free, taken.
    """

    looks: IntArray

    @classmethod
    def none(cls) -> LookCounts:
        """No look yet."""
        return cls(np.zeros((len(BAND_ENDS), 2, 2, 3), dtype=np.int64))

    def __add__(self, other: LookCounts) -> LookCounts:
        return LookCounts(self.looks + other.looks)

    def fitted(self) -> SensorModel:
        """The model with these rates; a band's errors are drawn to half an error each (Jeffreys's prior).

        Raises:
            InputError: too little was seen to tell.
        """
        said = self.looks.sum(axis=(0, 1))[:, 1:]
        if said.sum(axis=1).min() < LEAST_LOOKS:
            raise InputError(
                f"{said.sum(axis=1).tolist()} looks at free and at taken slots, want at least {LEAST_LOOKS} of each"
            )
        false_alarm, hit = _shares(said)
        bands = []
        for i, end in enumerate(BAND_ENDS):
            for beside in (False, True):
                looks = self.looks[i, int(beside)]
                there, told = looks.sum(), looks[:, 1:]
                rates = _shares(told) if told.sum(axis=1).min() >= LEAST_LOOKS else (false_alarm, hit)
                seen = float(told.sum() / there) if there else 0.0
                bands.append(SensorBand(end, beside, round(seen, 4), round(rates[1], 4), round(rates[0], 4)))
        return SensorModel(BAND_ENDS[-1], round(hit, 4), round(false_alarm, 4), tuple(bands))


def _shares(said: IntArray) -> tuple[float, float]:
    """Share of looks that showed a taken slot: of free ones, and of taken ones."""
    free, taken = (float((row[1] + 0.5) / (row.sum() + 1.0)) for row in said)
    return free, taken


def count_looks(
    scenario: Scenario, rig: str, driver: str, seeds: Sequence[int], weather: str | None = None
) -> LookCounts:
    """Search through the sensors, and count what the stack says of slots against what is there.

    Args:
        scenario: the world.
        rig: `laser` or `stereo`.
        driver: name of the agent that searches.
        seeds: one a search.
        weather: drawn for each search where None.

    Raises:
        InputError: an unknown rig.
    """
    scenario = scenario.replace(sensor_model=_AT_FIRST)
    env = gym.make("parkenv/SearchPerception-v1", scenario=scenario, rig=rig, weather=weather)
    agent = make_agent(driver, scenario)
    starts, slots = scenario.slots_in_view
    distance, beside = scenario.sight_lines
    band = np.searchsorted(BAND_ENDS, distance)
    looks = LookCounts.none().looks
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
            state, report = inner.state, inner.report
            rows = slice(starts[state.vertex], starts[state.vertex + 1])
            near = slots[rows]
            said = np.zeros(len(near), dtype=np.int64)
            said[np.searchsorted(near, report.slots)] = 1 + report.looks_taken
            taken = state.world.occupied(near, state.time).astype(np.int64)
            np.add.at(looks, (band[rows], beside[rows].astype(np.int64), taken, said), 1)
    return LookCounts(looks)


def measure_sight(
    scenarios: Sequence[Scenario],
    rig: str,
    searches: int,
    *,
    seed: int = 0,
    weather: str | None = None,
    workers: Workers = HERE,
    on_progress: Callable[[], None] = lambda: None,
) -> LookCounts:
    """`count_looks` of all drivers in all scenarios.

    Args:
        scenarios: worlds.
        rig: `laser` or `stereo`.
        searches: of each driver in each scenario.
        seed: of the first search.
        weather: drawn for each search where None.
        workers: where they run; the result does not depend on it.
        on_progress: called when a search is done.
    """
    tasks = [
        partial(count_looks, scenario, rig, driver, [s], weather)
        for scenario in scenarios
        for s in range(seed, seed + searches)
        for driver in DRIVERS
    ]
    counts = LookCounts.none()
    for _, looks in workers.results(tasks):
        counts += looks
        on_progress()
    return counts
