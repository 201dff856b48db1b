"""`parkenv/SearchPerception-v1`: the search with the real perception pipeline in the loop."""

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
    """Sensors and perception pipeline of a searching car, and the belief update from its observations.

    Args:
        scenario: the world. If its sensor model is perfect, the fitted model of the rig replaces it, because the belief
            update needs the error rates of the real observations.
        rig, weather, captures, every: as in `SensorSampler`.
        detector: a detector, or its name as in `make_detector`; None: the packaged HOG detector.

    Attributes:
        scenario: the scenario with the sensor model of the belief update.
        sampler: the simulated sensors.
        pipeline: detection, ranging and slot filter.
        results: pipeline results for the captures of the last step, oldest first.
        observation: the slots observed in the last step, and their observed states.

    Raises:
        InputError: an unknown rig, weather or detector, a rig without camera or ranging sensor, or a number outside its
            range.
    """

    def __init__(
        self,
        scenario: Scenario,
        rig: str | SensorRig | None,
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
            control: step control of a search in this scenario.
            vertex: current vertex of the car.
            captures: captures on the way there, oldest first.
        """
        self.results, observed = self.pipeline.observe(captures)
        rows = slice(self._view_starts[vertex], self._view_starts[vertex + 1])
        # The sensor model has rates only for slots within its range.
        in_range, rates = self._view_slots[rows], self._rates.of(rows)
        rated, used = np.isin(in_range, observed.slots), np.isin(observed.slots, in_range)
        self.observation = SlotObservation(observed.slots[used], observed.taken[used])
        control.apply_observations(*self.observation, rates.hit[rated], rates.false_alarm[rated])


class SearchPerceptionEnv(SearchEnv):
    """`parkenv/Search-v1` with the real perception pipeline in the loop: the belief comes from simulated sensors.

    ## Description
    World, decisions and rewards are those of `parkenv/Search-v1`, and equal seeds give equal worlds. But a perception
    pipeline replaces the sensor model: at every step the car's camera and laser measure (as in
    `parkenv/SearchSensors-v1`), cars are detected and located, beams are traced into the slots, and the observed states
    of the slots update the belief. So the belief has the errors of a real detector, and occlusion as well as distance
    decides which slots are observed.

    ## Action space
    `Discrete(5)`, as in `parkenv/Search-v1`:

    | Num | Action | Effect |
    |-----|--------|--------|
    | 0-3 | up, down, left, right | drive along that edge of the graph; wait `wait_s` if there is none |
    | 4 | park | park and walk to the goal if the slot here is free; lose `failure_s` if it is taken |

    ## Observation space
    The `Dict` of `parkenv/Search-v1`:

    | Key | Space | Meaning |
    |-----|-------|---------|
    | `vertex` | `Discrete(n_vertices)` | position of the car; vertex i < n_slots is in front of slot i |
    | `time` | `Box(0, 1e8, (2,), float32)` | s since Monday 00:00; s since the search began |
    | `p_occupied` | `Box(0, 1, (n_slots,), float32)` | current belief that each slot is taken |
    | `belief` | `Box((4 * n_slots,), float32)` | forecast, decay rate, p at the last observation, time of it |
    | `action_mask` | `Box(0, 1, (5,), int8)` | the actions that the graph has here |

    ## Rewards
    Minus the seconds of the step, as in `parkenv/Search-v1`.

    ## Starting state
    As in `parkenv/Search-v1`. The weather is drawn for each episode unless it is given.

    ## Episode end
    As in `parkenv/Search-v1`. The lot counts as full when the *observed* states of all slots are taken.

    ## Arguments
    | Name | Default | Meaning |
    |------|---------|---------|
    | `scenario`, `render_mode`, changes | | as in `parkenv/Search-v1` |
    | `rig` | the scenario's | `laser` (the thesis's camera and 270° laser), `stereo`, `both_sides`, or a `SensorRig` |
    | `weather` | `None` | `sunny`, `overcast`, `low_sun`, `dusk`, `rain`; `None`: drawn for each episode |
    | `captures` | 2 | largest number of captures on an edge |
    | `every` | 1.25 | m, least distance between captures on an edge |
    | `detector` | `None` | a `Detector`, or its name: `hog`, `side`, `front`, a model file, `MODULE:CLASS` |

    The scenario's `sensor_model` gives the error rates that the belief update assumes, and its range: farther slots
    are not updated. If it is perfect, the fitted model of the rig replaces it (`SensorModel.named`).

    `info` is that of `parkenv/Search-v1`. `env.unwrapped.perception` has the results of the last step: `results`
    (captures, detections, located cars, range scans) and `observation` (the observed slots and their states).

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
        rig: str | SensorRig | None = None,
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
        """Apply the action, measure on the way, and update the belief from the measurements."""
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
