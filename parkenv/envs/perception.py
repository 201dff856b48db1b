"""`parkenv/SearchPerception-v1`: the search with the real detection and mapping stack in the loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.envs.lookout import Lookout, Moment
from parkenv.envs.search import SearchEnv
from parkenv.envs.search_state import SearchState
from parkenv.envs.search_step import VERTEX, Search, drive_or_park, renew, settle, take_in, tell_time
from parkenv.envs.sensors import beside_the_lot
from parkenv.mapping.slots import SlotFilter
from parkenv.perception.detector import Detector
from parkenv.perception.stack import Look, PerceptionStack
from parkenv.scenarios.build import make_scenario
from parkenv.world.scenario import Scenario
from parkenv.world.sensor_model import SensorModel
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


class Watcher:
    """A rig, the stack behind it, and what both tell a belief.

    Args:
        scenario: the world; where its sensor_model is perfect, what was measured of the rig takes its place.
        rig, weather, captures, every: as in `Lookout`.
        detector: the shipped models where None.

    Attributes:
        scenario: with what the car takes its eyes to be worth.
        lookout: what measures.
        stack: what sees.
        looks: what was captured last, oldest first, and what the stack made of it.
        report: what that said of the slots.

    Raises:
        InputError: an unknown rig or weather, a rig that cannot see or range, a number out of its range.
    """

    def __init__(
        self,
        scenario: Scenario,
        rig: str | SensorRig,
        weather: str | None = None,
        captures: int = 2,
        every: float = 1.25,
        detector: Detector | None = None,
    ) -> None:
        self.lookout = Lookout(scenario, rig, weather, captures, every)
        self.stack = PerceptionStack(self.lookout.rig, detector)
        if scenario.sensor_model.perfect:
            measured = SensorModel.named("laser" if self.lookout.rig.lasers else "stereo")
            scenario = scenario.replace(sensor_model=measured)
        self.scenario = scenario
        self._view_starts, self._view_slots = scenario.slots_in_view
        self._rates = scenario.sensor_rates
        self.forget()

    def forget(self) -> None:
        """Nothing has been captured."""
        self.looks: list[tuple[Moment, Look]] = []
        self.report = _NOTHING

    def tell(self, search: Search, moments: Sequence[Moment]) -> None:
        """See what was captured on the way to the vertex where the car is, and take it into the belief.

        Args:
            search: of this scenario, under way; its first.
            moments: oldest first.
        """
        self.looks = [(moment, self.stack.look(moment.capture)) for moment in moments]
        slots = SlotFilter(self.scenario.lot)
        for _, look in self.looks:
            for sweep in look.sweeps:
                slots.see_through(sweep)
            for view in look.views:
                slots.see_cars(view.cars)
        states = slots.states()
        vertex = search.counts[0, VERTEX]
        rows = slice(self._view_starts[vertex], self._view_starts[vertex + 1])
        near, rates = self._view_slots[rows], self._rates.of(rows)
        told = states.in_view[near] & (states.p_occupied[near] != 0.5)
        self.report = Report(near[told], states.occupied[near[told]])
        take_in(search, 0, *self.report, rates.hit[told], rates.false_alarm[told])


class SearchPerceptionEnv(SearchEnv):
    """`parkenv/Search-v1` whose belief is what the detection and mapping stack makes of simulated sensors.

    ## Description
    World, decisions, rewards and observations are those of `parkenv/Search-v1`; equal seeds give equal worlds. But
    nobody tells the car which slots are taken: on the way of every step its camera and laser take pictures and scans
    (as in `parkenv/SearchSensors-v1`), cars are detected and ranged, beams are followed into the slots, and what that
    says of each slot goes into the belief. So the car errs where its eyes do, and sees slots that no circle holds.

    ## Action space
    `Discrete(5)`: up, down, left, right, park, as in `parkenv/Search-v1`.

    ## Observation space
    As in `parkenv/Search-v1`.

    ## Rewards
    As in `parkenv/Search-v1`.

    ## Starting state
    As in `parkenv/Search-v1`. The weather is drawn for each search unless it is given.

    ## Episode end
    As in `parkenv/Search-v1`; *proven full* is what the stack takes for full.

    ## Arguments
    - `scenario`, `render_mode`, and fields of the scenario: as in `parkenv/Search-v1`. Its `sighting` is what the
      car takes its eyes to be worth, and how far away slots may be of which it takes note; where that is perfect,
      what was measured of the rig (`SensorModel.named`).
    - `rig`: laser (the thesis's: a camera and a 270° laser), stereo, both_sides, or a `sim_sensors.rig.SensorRig`
      that can see and range.
    - `weather`: sunny, overcast, low_sun, dusk or rain; None draws one.
    - `captures`: how many there are at most on an edge.
    - `every`: m; on short edges captures are at least so far apart.
    - `detector`: a `parkenv.perception.detector.Detector`; the shipped models where None.

    ```python
    >>> import gymnasium as gym
    >>> import parkenv
    >>> env = gym.make("parkenv/SearchPerception-v1", scenario="mini", weather="sunny")
    >>> observation, info = env.reset(seed=0)
    >>> observation, reward, terminated, truncated, info = env.step(3)
    >>> observation["p_occupied"].shape
    (10,)

    ```

    ## Version history
    - v1: observations gain `belief`.
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
        self.watcher = Watcher(make_scenario(scenario, **changes), rig, weather, captures, every, detector)
        super().__init__(self.watcher.scenario, render_mode)
        self._before: tuple[int, float] | None = None

    @property
    def rig(self) -> SensorRig:
        """The sensors, where they sit, and how they are built."""
        return self.watcher.lookout.rig

    @property
    def report(self) -> Report:
        """What the stack said of the slots after the last step."""
        return self.watcher.report

    @property
    def looks(self) -> list[tuple[Moment, Look]]:
        """What was captured on the way of the last step, oldest first, and what the stack made of it."""
        return list(self.watcher.looks)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start a search; see the class."""
        self._before = None
        self.watcher.forget()
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
            self.watcher.tell(self.search, self.watcher.lookout.look(self._state, self._before))
        settle(self.search, 0)
        renew(self.search, 0)
        tell_time(self.search, 0, self._clock)

    def _frame(self, state: SearchState) -> NDArray[np.uint8]:
        """The lot from above, and beside it the newest pictures."""
        return beside_the_lot(super()._frame(state), [moment for moment, _ in self.watcher.looks], self.rig)
