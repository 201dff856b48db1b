"""`parkenv/SearchPerception-v1`: the search with the real detection and mapping stack in the loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.envs.search import SearchEnv
from parkenv.envs.search_control import SearchControl
from parkenv.envs.search_state import SearchState
from parkenv.envs.sensor_sampler import SensorSampler
from parkenv.envs.sensors import with_camera_images
from parkenv.perception.capture import TimedCapture
from parkenv.perception.detector import Detector
from parkenv.perception.pipeline import PerceptionPipeline, PerceptionResult
from parkenv.perception.slot_filter import SlotObservation
from parkenv.scenarios.build import make_scenario
from parkenv.world.scenario import Scenario
from parkenv.world.sensor_model import SensorModel
from sim_sensors.rig import SensorRig


class OnboardPerception:
    """Sensors and perception pipeline of a searching car, and the belief update from what they observe.

    Args:
        scenario: the world. If its sensor model is perfect, the fitted model of the rig replaces it, because the belief
            update needs the error rates of the real observations.
        rig, weather, captures, every: as in `SensorSampler`.
        detector: a detector, or its name as in `make_detector`; None: the packaged HOG detector.

    Attributes:
        scenario: the scenario with the sensor model of the belief update.
        sampler: the simulated sensors.
        pipeline: detection, ranging and slot filter.
        results: what the pipeline made of the captures of the last step, oldest first.
        observation: the slots observed in the last step, and their observed states.

    Raises:
        InputError: an unknown rig, weather or detector, a rig without camera or ranging sensor, or a number outside its
            range.
    """

    def __init__(
        self,
        scenario: Scenario,
        rig: str | SensorRig,
        weather: str | None = None,
        captures: int = 2,
        every: float = 1.25,
        detector: str | Detector | None = None,
    ) -> None:
        self.sampler = SensorSampler(scenario, rig, weather, captures, every)
        self.pipeline = PerceptionPipeline(self.sampler.rig, scenario.lot, detector)
        if scenario.sensor_model.perfect:
            fitted = SensorModel.named("laser" if self.sampler.rig.lasers else "stereo")
            scenario = scenario.replace(sensor_model=fitted)
        self.scenario = scenario
        self._view_starts, self._view_slots = scenario.slots_in_view
        self._rates = scenario.sensor_rates
        self.reset()

    def reset(self) -> None:
        """Clear the results of the last step."""
        self.results: tuple[PerceptionResult, ...] = ()
        self.observation = SlotObservation.none()

    def update_belief(self, control: SearchControl, vertex: int, captures: Sequence[TimedCapture]) -> None:
        """Run the pipeline on the captures of a step, and update the belief with the observed slots.

        Args:
            control: of a search in this scenario.
            vertex: where the car is.
            captures: measured on the way there, oldest first.
        """
        self.results, observed = self.pipeline.observe(captures)
        rows = slice(self._view_starts[vertex], self._view_starts[vertex + 1])
        # The sensor model has rates for the slots within its range only.
        in_range, rates = self._view_slots[rows], self._rates.of(rows)
        rated, used = np.isin(in_range, observed.slots), np.isin(observed.slots, in_range)
        self.observation = SlotObservation(observed.slots[used], observed.taken[used])
        control.apply_observations(*self.observation, rates.hit[rated], rates.false_alarm[rated])


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
        detector: str | Detector | None = None,
        **changes: Any,
    ) -> None:
        world = make_scenario(scenario, **changes)
        self.perception = OnboardPerception(world, rig, weather, captures, every, detector)
        super().__init__(self.perception.scenario, render_mode)
        self._before: tuple[int, float] | None = None

    @property
    def rig(self) -> SensorRig:
        """The sensors, their poses on the car, and their models."""
        return self.perception.sampler.rig

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; see the class."""
        self._before = None
        self.perception.reset()
        return super().reset(seed=seed, options=options)

    def step(self, action: np.int64 | int) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Drive along an edge, or attempt to park; see the class."""
        self._before = (self.state.vertex, self.state.time)
        return super().step(action)

    def _advance(self, action: int) -> tuple[Any, ...]:
        """Act, measure on the way, and update the belief from the measurements."""
        control, state = self._control, self._state
        control.drive_or_park(action)
        state.extend_path()
        if not state.parked:
            captures = self.perception.sampler.sample_step(state, self._before)
            self.perception.update_belief(control, state.vertex, captures)
        return control.finish_step()

    def _frame(self, state: SearchState) -> NDArray[np.uint8]:
        """Return the lot from above, with the newest camera images beside it."""
        newest = self.perception.results[-1].captured if self.perception.results else None
        return with_camera_images(super()._frame(state), newest, self.rig)
