"""`parkenv/SearchPerception-v0`: the search with the real detection and mapping stack in the loop."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.envs.lookout import Lookout, Moment
from parkenv.envs.search import SearchEnv, SearchState
from parkenv.envs.sensors import beside_the_lot
from parkenv.mapping.slots import SlotFilter
from parkenv.perception.detector import Detector
from parkenv.perception.stack import PerceptionStack
from parkenv.scenario import Scenario
from sim_sensors.rig import SensorRig

TRUST = 0.98
"""P(a state that the stack reports is right): looks that follow one another err alike, however sure each is."""


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
    - `scenario`, `render_mode`, and fields of the scenario: as in `parkenv/Search-v0`; its `sighting` is not used.
    - `rig`: thesis, stereo, both_sides, or a `sim_sensors.rig.SensorRig` that can see and range.
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
        rig: str | SensorRig = "thesis",
        weather: str | None = None,
        captures: int = 2,
        every: float = 1.25,
        detector: Detector | None = None,
        **changes: Any,
    ) -> None:
        super().__init__(scenario, render_mode, **changes)
        self._lookout = Lookout(self.scenario, rig, weather, captures, every)
        self._stack = PerceptionStack(self._lookout.rig, detector)
        self._before: tuple[int, float] | None = None
        self._moments: list[Moment] = []

    @property
    def rig(self) -> SensorRig:
        """The sensors, where they sit, and how they are built."""
        return self._lookout.rig

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start a search; see the class."""
        self._before, self._moments = None, []
        return super().reset(seed=seed, options=options)

    def step(self, action: np.int64 | int) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Drive along an edge, or try to park; see the class."""
        self._before = (self.state.vertex, self.state.time)
        return super().step(action)

    def _look(self, state: SearchState) -> None:
        """Capture, detect, range, and tell the belief what the slots look like."""
        if state.vertex < self.scenario.lot.n_slots:
            state.passed.add(state.vertex)
        self._moments = self._lookout.look(state, self._before)
        state.belief.relax(state.time)
        slots = SlotFilter(self.scenario.lot)
        for _, capture in self._moments:
            look = self._stack.look(capture)
            for sweep in look.sweeps:
                slots.see_through(sweep)
            for view in look.views:
                slots.see_cars(view.cars)
        states = slots.states()
        seen = np.flatnonzero(states.in_view & (states.p_occupied != 0.5))
        trust = np.full(len(seen), TRUST)
        state.belief.update(seen, states.occupied[seen], trust, 1.0 - trust)

    def _frame(self, state: SearchState) -> NDArray[np.uint8]:
        """The lot from above, and beside it the newest pictures."""
        return beside_the_lot(super()._frame(state), self._moments, self.rig)
