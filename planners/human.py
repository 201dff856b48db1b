"""A person's searches in a game of `parkenv play`, repeated by an agent."""

from collections.abc import Iterator
from typing import Annotated

import numpy as np
from pydantic import Field

from parkenv.belief.slot_belief import SlotBelief
from parkenv.errors import InputError, require
from parkenv.files.limited_reading import JsonFormat
from parkenv.files.spec_file import Several, Spec
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation, SearchAgent

_FORMAT = JsonFormat("parkenv-scores", 1, "the scores of a game of parkenv play")
_Seconds = Annotated[float, Field(ge=0.0, strict=False)]
_Whole = Annotated[int, Field(ge=0)]


class PlayedSearch(Spec):
    """A search of a person: seed of the world, how it begins, a digit for each action, and its time on the page."""

    seed: _Whole
    arrival_s: _Seconds
    entry: _Whole
    actions: str = Field(pattern="^[0-4]{1,2000}$")
    total_s: _Seconds


class Scores(Spec):
    scenario: str
    worlds: Several[PlayedSearch] = Field(min_length=1, max_length=10_000)


class HumanAgent(SearchAgent[Iterator[int]]):
    """`human:FILE`: takes the actions of a person in the worlds of a game.

    It recognises a world by what every agent observes at the reset: time and entry.

    Attributes:
        totals: total time, s, by seed, as the page says.
    """

    def __init__(self, problem: SearchProblem, path: str) -> None:
        super().__init__(problem)
        self.name = f"human:{path}"  # type: ignore[misc]
        scores = Scores.parse(_FORMAT.read(path), path)
        name = getattr(problem, "name", scores.scenario)
        require(
            scores.scenario == name,
            f"{path}: scenario is {scores.scenario!r:.60}, want {name!r}, which is searched",
        )
        self.totals = {one.seed: one.total_s for one in scores.worlds}
        self._actions = {(np.float32(one.arrival_s), one.entry): one.actions for one in scores.worlds}
        require(
            len(self._actions) == len(self.totals) == len(scores.worlds),
            f"{path}: worlds has a world twice, want each once",
        )

    def begin(self, observation: Observation, belief: SlotBelief) -> Iterator[int]:
        start = (np.float32(observation["time"][0]), int(observation["vertex"]))
        require(
            start in self._actions,
            f"{self.name} has no search that begins at {start[0]:.2f} s at vertex {start[1]}",
        )
        return map(int, self._actions[start])

    def decide(self, observation: Observation, belief: SlotBelief, memory: Iterator[int]) -> int:
        if (action := next(memory, None)) is None:
            raise InputError(f"{self.name}: actions end before the search does")
        return action
