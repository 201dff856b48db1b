"""`parkenv/SearchPerception-v0`: the search with the real detection and mapping stack in the loop."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.envs.lookout import Lookout, Moment
from parkenv.envs.search import SearchEnv, SearchState
from parkenv.envs.search_step import drive_or_park, renew, settle, take_in, tell_time
from parkenv.envs.sensors import beside_the_lot
from parkenv.mapping.slots import SlotFilter
from parkenv.perception.detector import Detector
from parkenv.perception.stack import Look, PerceptionStack
from parkenv.scenario import Scenario
from parkenv.sighting import SightingModel
from sim_sensors.rig import SensorRig


class Report(NamedTuple):
    """What the stack said of the slots after a step.

    Attributes:
        slots: (k,) int64, those of which it could tell, ascending.
        looks_taken: (k,) bool.
    """

    slots: NDArray[np.int64]
    looks_taken: NDArray[np.bool_]


_NOTHING = Report(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.bool_))


class SearchPerceptionEnv(SearchEnv):
    """`parkenv/Search-v0` whose belief is what the detection and mapping stack makes of simulated sensors.

    ## Description
    World, decisions, rewards and observations are those of `parkenv/Search-v0`; equal seeds give equal worlds. But
    nobody tells the car which slots are taken: on the way of every step its camera and laser take pictures and scans
    (as in `parkenv/SearchSensors-v0`), cars are detected and ranged, beams are followed into the slots, and what that
    says of each slot goes into the belief. So the car errs where its eyes do, and sees slots that no circle holds.

    ## Action space
    `Discrete(5)`: up, down, left, right, park, as in `parkenv/Search-v0`.

    ## Observation space
    As in `parkenv/Search-v0`: `vertex`, `time`, `p_occupied`, `action_mask`.

    ## Rewards
    As in `parkenv/Search-v0`.

    ## Starting state
    As in `parkenv/Search-v0`. The weather is drawn for each search unless it is given.

    ## Episode end
    As in `parkenv/Search-v0`; *proven full* is what the stack takes for full.

    ## Arguments
    - `scenario`, `render_mode`, and fields of the scenario: as in `parkenv/Search-v0`. Its `sighting` is what the
      car takes its eyes to be worth, and how far away slots may be of which it takes note; where that is perfect,
      what was measured of the rig (`SightingModel.named`).
    - `rig`: laser (the thesis's: a camera and a 270° laser), stereo, both_sides, or a `sim_sensors.rig.SensorRig`
      that can see and range.
    - `weather`: sunny, overcast, low_sun, dusk or rain; None draws one.
    - `captures`: how many there are at most on an edge.
    - `every`: m; on short edges captures are at least so far apart.
    - `detector`: a `parkenv.perception.detector.Detector`; the shipped models where None.

    ```python
    >>> import gymnasium as gym
    >>> import parkenv
    >>> env = gym.make("parkenv/SearchPerception-v0", scenario="mini", weather="sunny")
    >>> observation, info = env.reset(seed=0)
    >>> observation, reward, terminated, truncated, info = env.step(3)
    >>> observation["p_occupied"].shape
    (10,)

    ```

    ## Version history
    - v0: first version.
    """

    def __init__(
        self,
        scenario: str | Scenario = "campus",
        render_mode: str | None = None,
        rig: str | SensorRig = "laser",
        weather: str | None = None,
        captures: int = 2,
        every: float = 1.25,
        detector: Detector | None = None,
        **changes: Any,
    ) -> None:
        super().__init__(scenario, render_mode, **changes)
        self._lookout = Lookout(self.scenario, rig, weather, captures, every)
        self._stack = PerceptionStack(self._lookout.rig, detector)
        if self.scenario.sighting.perfect:
            measured = SightingModel.named("laser" if self.rig.lasers else "stereo")
            self.scenario = self.scenario.replace(sighting=measured)
            self._make_search()
        self._view_starts, self._view_slots = self.scenario.slots_in_view
        self._rates = self.scenario.sight_rates
        self._before: tuple[int, float] | None = None
        self._looks: list[tuple[Moment, Look]] = []
        self._report = _NOTHING

    @property
    def rig(self) -> SensorRig:
        """The sensors, where they sit, and how they are built."""
        return self._lookout.rig

    @property
    def report(self) -> Report:
        """What the stack said of the slots after the last step."""
        return self._report

    @property
    def looks(self) -> list[tuple[Moment, Look]]:
        """What was captured on the way of the last step, oldest first, and what the stack made of it."""
        return list(self._looks)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start a search; see the class."""
        self._before, self._looks = None, []
        self._report = _NOTHING
        return super().reset(seed=seed, options=options)

    def step(self, action: np.int64 | int) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Drive along an edge, or try to park; see the class."""
        self._before = (self.state.vertex, self.state.time)
        return super().step(action)

    def _advance(self, action: int) -> None:
        """Act; capture, detect, range, and tell the belief what the slots look like."""
        drive_or_park(self.search, 0, action)
        self._state.come_along()
        if not self._state.parked:
            self._look(self._state)
        settle(self.search, 0)
        renew(self.search, 0)
        tell_time(self.search, 0, self._clock)

    def _look(self, state: SearchState) -> None:
        moments = self._lookout.look(state, self._before)
        self._looks = [(moment, self._stack.look(moment.capture)) for moment in moments]
        slots = SlotFilter(self.scenario.lot)
        for _, look in self._looks:
            for sweep in look.sweeps:
                slots.see_through(sweep)
            for view in look.views:
                slots.see_cars(view.cars)
        states = slots.states()
        rows = slice(self._view_starts[state.vertex], self._view_starts[state.vertex + 1])
        near, rates = self._view_slots[rows], self._rates.of(rows)
        told = states.in_view[near] & (states.p_occupied[near] != 0.5)
        self._report = Report(near[told], states.occupied[near[told]])
        take_in(self.search, 0, *self._report, rates.hit[told], rates.false_alarm[told])

    def _frame(self, state: SearchState) -> NDArray[np.uint8]:
        """The lot from above, and beside it the newest pictures."""
        return beside_the_lot(super()._frame(state), [moment for moment, _ in self._looks], self.rig)
