"""`parkenv/SearchPerception-v2`: the search with the real perception pipeline in the loop."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from parkenv.engine.kernel import (
    act_at,
    apply_cues_at,
    apply_observations_at,
    finish_step_at,
    observe_live_at,
)
from parkenv.engine.sensor_sampler import SensorSampler, make_rig
from parkenv.envs.sensors import SensingSearchEnv
from parkenv.perception.departure_cues import DepartureCues, log_likelihood_ratio
from parkenv.perception.detector import Detector
from parkenv.perception.pipeline import PerceptionPipeline, PerceptionResult
from parkenv.perception.slot_filter import SlotObservation
from parkenv.scenarios.build import ScenarioSource, make_scenario, require_changes
from parkenv.world.scenario import Scenario
from parkenv.world.sensor_model import SensorModel
from sim_sensors.rig import SensorRig, TimedCapture


class OnboardPerception:
    """Sensors and perception pipeline of a searching car, and the belief update from its observations.

    Args:
        scenario: the world. If its sensor model is perfect, the fitted model of a rig with a laser, or of
            one with cameras alone, replaces it, because the belief update needs the error rates of the real
            observations.
        rig, weather, captures, every: as in `SensorSampler`.
        detector: a detector, or its name as in `make_detector`; None: the scenario's.

    Attributes:
        results: pipeline results for the captures of the last step, oldest first.
        observation: the slots observed in the last step, and their observed states.
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
        self.pipeline = PerceptionPipeline(self.sampler.rig, scenario.lot, detector or scenario.detector)
        if scenario.sensor_model.perfect:
            fitted = SensorModel.named("laser" if self.sampler.rig.lasers else "stereo")
            scenario = scenario.replace(sensor_model=fitted)
        self.scenario = scenario
        self._view_starts, self._view_slots = scenario.slots_in_view
        self._rates = scenario.sensor_rates
        self._cues = None if scenario.cues is None else DepartureCues(scenario.lot)
        self._kept_s = scenario.cues.lead_s if scenario.cues else 0.0
        self.reset()

    def reset(self) -> None:
        self.results: tuple[PerceptionResult, ...] = ()
        self.observation = SlotObservation.none()
        # By slot: the log-likelihood ratio of what was last seen of its car, and when.
        self._evidence = np.zeros((2, self.scenario.lot.n_slots if self._cues else 0))

    def update_belief(self, address: int, vertex: int, captures: Sequence[TimedCapture]) -> None:
        """Run the pipeline on the captures of a step, oldest first, and update the belief."""
        before = self.results[-1:]
        self.results, observed = self.pipeline.observe(captures)
        rows = slice(self._view_starts[vertex], self._view_starts[vertex + 1])
        # The sensor model has rates only for slots within its range.
        in_range, rates = self._view_slots[rows], self._rates.of(rows)
        rated, used = np.isin(in_range, observed.slots), np.isin(observed.slots, in_range)
        self.observation = SlotObservation(observed.slots[used], observed.taken[used])
        apply_observations_at(address, *self.observation, rates.hit[rated], rates.false_alarm[rated])
        if self.scenario.live_slots.size:
            observe_live_at(address)
        if self._cues is not None and self.results:
            self._update_cues(address, self._cues, (*before, *self.results)[-2:])

    def _update_cues(self, address: int, cues: DepartureCues, newest: Sequence[PerceptionResult]) -> None:
        """Update the belief in cars about to leave by what is new: successive pictures of a car err alike.

        Cars that are no longer in the picture are not taken to have switched off their lamps.
        """
        (slots, taken), time = self.observation, newest[-1].captured.time
        evidence = np.zeros(len(slots))
        features = cues.features(newest, slots[taken])
        known, at = self._evidence[:, slots]
        known = np.where(taken & (time - at < self._kept_s), known, 0.0)
        said = log_likelihood_ratio(features)
        evidence[taken] = np.where(features[:, 0] > 0.0, said, np.maximum(said, known[taken]))
        self._evidence[0, slots], self._evidence[1, slots] = evidence, time
        new = evidence - known
        apply_cues_at(address, slots, np.exp(np.minimum(new, 0.0)), np.exp(np.minimum(-new, 0.0)))


class SearchPerceptionEnv(SensingSearchEnv):
    """`parkenv/Search-v2` with the real perception pipeline in the loop: the belief comes from simulated sensors.

    ## Description
    World, decisions and rewards are those of `parkenv/Search-v2`, and equal seeds give equal worlds. But a perception
    pipeline replaces the sensor model: at every step the car's camera and laser measure (as in
    `parkenv/SearchSensors-v2`), cars are detected and located, beams are traced into the slots, and the observed states
    of the slots update the belief. So the belief has the errors of a real detector, and occlusion as well as distance
    decides which slots are observed.

    ## Action space
    `Discrete(5)`, as in `parkenv/Search-v2`: up, down, left, right, park.

    ## Observation space
    The `Dict` of `parkenv/Search-v2`; `step_observed` holds what perception observed.

    ## Rewards
    Minus the seconds of the step, as in `parkenv/Search-v2`.

    ## Starting state
    As in `parkenv/Search-v2`. The weather is drawn for each episode unless it is given.

    ## Episode end
    As in `parkenv/Search-v2`. The lot counts as full when the *observed* states of all slots are taken.

    ## Arguments
    | Name | Default | Meaning |
    |------|---------|---------|
    | `scenario`, `render_mode`, `observation`, `k`, `flat`, `reward_scale`, changes | | as in `parkenv/Search-v2` |
    | `rig` | the scenario's | `laser` (the thesis's camera and 270° laser), `stereo`, `both_sides`, or a `SensorRig` |
    | `weather` | `None` | `sunny`, `overcast`, `low_sun`, `dusk`, `rain`; `None`: drawn for each episode |
    | `captures` | 2 | largest number of captures on an edge |
    | `every` | 1.25 | m, least distance between captures on an edge |
    | `detector` | the scenario's | a `Detector`, `hog`, `side`, `front`, `net`, a file (.npz, .onnx), `MODULE:CLASS` |
    | `picture_width` | 400; a `SensorRig`'s own | px, width of the cameras' pictures; those of a survey have 640 |

    The scenario's `sensor_model` gives the error rates that the belief update assumes, and its range: farther slots
    are not updated. If it is perfect, the fitted model of the rig replaces it (`SensorModel.named`). With
    `scenario.cues`, the cues are those in pictures and scans.

    `info` is that of `parkenv/Search-v2`. `env.unwrapped.perception` has the results of the last step: `results`
    (captures, detections, located cars, range scans) and `observation` (the observed slots and their states).

    ```python
    >>> import gymnasium as gym
    >>> import parkenv
    >>> env = gym.make("parkenv/SearchPerception-v2", scenario="mini", weather="sunny")
    >>> observation, info = env.reset(seed=0)
    >>> observation, reward, terminated, truncated, info = env.step(3)
    >>> observation["p_occupied"].shape
    (10,)

    ```

    ## Version history
    - v2: observations gain `day_error` and `step_observed`; packaged scenarios have days that differ from their
      forecast; pictures are 400 px wide by default.
    - v1: observations gain `belief`.
    - v0: first version.
    """

    def __init__(
        self,
        scenario: ScenarioSource = "campus",
        render_mode: str | None = None,
        rig: str | SensorRig | None = None,
        weather: str | None = None,
        captures: int = 2,
        every: float = 1.25,
        detector: str | Detector | None = None,
        picture_width: int | None = None,
        observation: str = "full",
        k: int | None = None,
        flat: bool = False,
        reward_scale: float = 1.0,
        **changes: Any,
    ) -> None:
        require_changes((type(self),), changes)
        world = make_scenario(scenario, **changes)
        sensors = make_rig(rig, world, picture_width)
        self.perception = OnboardPerception(world, sensors, weather, captures, every, detector)
        super().__init__(self.perception.scenario, render_mode, observation, k, flat, reward_scale)
        self._sampler = self.perception.sampler

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        self.perception.reset()
        return super().reset(seed=seed, options=options)

    def _stepper(self) -> Callable[[int, int], tuple[Any, ...]]:
        return self._step_with_sensors

    def _step_with_sensors(self, address: int, action: int) -> tuple[Any, ...]:
        state = self._state
        act_at(address, action)
        state.extend_path()
        if not state.parked:
            captures = self._sampler.sample_step(state, self._before)
            self.perception.update_belief(address, state.vertex, captures)
        return finish_step_at(address)  # type: ignore[no-any-return]

    def _newest(self) -> TimedCapture | None:
        return self.perception.results[-1].captured if self.perception.results else None
