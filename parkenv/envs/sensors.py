"""`parkenv/SearchSensors-v2`: the search with raw sensor data."""

from abc import abstractmethod
from typing import Any

import cv2
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from parkenv.engine.sensor_sampler import SensorSampler, make_rig
from parkenv.engine.spaces import LATEST
from parkenv.engine.state import SearchState
from parkenv.envs.search import SearchEnv
from parkenv.errors import require, require_one_of
from parkenv.scenarios.build import ScenarioSource, make_scenario, require_changes
from sim_sensors.rig import SensorRig, TimedCapture

FARTHEST = 1e7  # bound, m, of the observed positions: Gymnasium requires one, and every lot is smaller

OBSERVATIONS = ("full", "scan")
_NOT_SENSED = ("p_occupied", "belief", "step_observed", "day_error", "cues")


class SensingSearchEnv(SearchEnv):
    """Base class of the searches with simulated sensors; subclasses set `_sampler`."""

    _sampler: SensorSampler
    _before: tuple[int, float] | None = None

    @property
    def rig(self) -> SensorRig:
        return self._sampler.rig

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        self._before = None
        return super().reset(seed=seed, options=options)

    def step(self, action: np.int64 | int) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self._before = (self.state.vertex, self.state.time)
        return super().step(action)

    @abstractmethod
    def _newest(self) -> TimedCapture | None:
        """Return the newest capture, if any."""

    def _frame(self, state: SearchState) -> NDArray[np.uint8]:
        return with_camera_images(super()._frame(state), self._newest(), self.rig)


class SearchSensorsEnv(SensingSearchEnv):
    """`parkenv/Search-v2` with raw sensor data instead of a belief: images, laser scans and poses.

    ## Description
    World, decisions and rewards are those of `parkenv/Search-v2`, and equal seeds give equal worlds. The agent needs
    its own perception. Simulated sensors measure up to `captures` times on every edge, at equal distances, the last
    time at its end. At a vertex the vehicle is headed along the lane, between two vertices along the edge. There is
    one capture at the start, and one after waiting or a failed attempt.

    Observations do not contain the forecast; the first observation of `parkenv/Search-v2` with the same seed has it.

    ## Action space
    `Discrete(5)`, as in `parkenv/Search-v2`: up, down, left, right, park.

    ## Observation space
    A `Dict`. K = `captures`; the newest capture is the last of `count`; rows from `count` on are 0.

    | Key | Space | Meaning |
    |-----|-------|---------|
    | `vertex` | `Discrete(n_vertices)` | position of the car; vertex i < n_slots is in front of slot i |
    | `time` | `Box(0, 1e8, (2,), float32)` | s since Monday 00:00; s since the search began |
    | `action_mask` | `Box(0, 1, (5,), int8)` | the valid actions at this vertex |
    | `count` | `Discrete(K + 1)` | number of captures of the last step; 0 after parking |
    | `pose` | `Box(-1e7, 1e7, (K, 3), float32)` | x, y in m, yaw in rad of the vehicle, lot frame |
    | `captured_at` | `Box(0, 1e8, (K,), float32)` | s since the search began |
    | `image_<camera>` | `Box(0, 255, (K, h, w, 3), uint8)` | RGB, for each camera of the rig |
    | `image_<pair>` | `Box(0, 255, (K, 2, h, w, 3), uint8)` | RGB, left and right, for each stereo camera |
    | `scan_<laser>` | `Box(0, max_range, (K, n_beams), float32)` | m; `max_range` for no return |

    With `observation="scan"` there are no images, and a step takes a fraction of a millisecond instead of dozens.

    Beam n points along -3π/4 + n·0.25° from forward, counter-clockwise, in the laser's frame. `env.unwrapped.rig` has
    the poses and models of the sensors. The thesis's rig has `image_right` and `scan_laser`; a dot in a
    sensor's name becomes an underscore.

    ## Rewards
    Minus the seconds of the step, as in `parkenv/Search-v2`.

    ## Starting state
    As in `parkenv/Search-v2`. The weather is drawn for each episode unless it is given.

    ## Episode end
    As in `parkenv/Search-v2`, whose error-free observations decide whether the lot is full.

    ## Arguments
    | Name | Default | Meaning |
    |------|---------|---------|
    | `scenario`, `render_mode`, `reward_scale`, changes | | as in `parkenv/Search-v2`; `traffic=Traffic(4, 6)` adds \
road users |
    | `rig` | the scenario's | `laser` (the thesis's camera and 270° laser), `stereo`, `both_sides`, or a `SensorRig` |
    | `weather` | `None` | `sunny`, `overcast`, `low_sun`, `dusk`, `rain`; `None`: drawn for each episode |
    | `captures` | 4 | largest number of captures on an edge |
    | `every` | 1.0 | m, least distance between captures on an edge |
    | `picture_width` | 400; a `SensorRig`'s own | px, width of the cameras' pictures; those of a survey have 640 |
    | `observation` | `full` | `scan`: without images; the cameras of the rig are not drawn |

    ```python
    >>> import gymnasium as gym
    >>> import parkenv
    >>> env = gym.make("parkenv/SearchSensors-v2", scenario="mini", captures=2)
    >>> observation, info = env.reset(seed=0)
    >>> observation["image_right"].shape, observation["scan_laser"].shape, int(observation["count"])
    ((2, 300, 400, 3), (2, 1081), 1)

    ```

    ## Version history
    - v2: keys without dots, as networks of PyTorch want (`image.right` became `image_right`, with equal values);
      observations gain `day_error`; packaged scenarios have days that differ from their forecast; pictures are
      400 px wide by default.
    - v1: same version number as `parkenv/Search-v2`.
    - v0: first version.
    """

    def __init__(
        self,
        scenario: ScenarioSource = "campus",
        render_mode: str | None = None,
        rig: str | SensorRig | None = None,
        weather: str | None = None,
        captures: int = 4,
        every: float = 1.0,
        observation: str = "full",
        picture_width: int | None = None,
        reward_scale: float = 1.0,
        **changes: Any,
    ) -> None:
        require_one_of("observation", observation, OBSERVATIONS)
        require_changes((type(self),), changes)
        super().__init__(make_scenario(scenario, **changes), render_mode, reward_scale=reward_scale)
        sensors = make_rig(rig, self.scenario, picture_width)
        if observation == "scan":
            require(sensors.lasers, 'observation is "scan", want a rig with a laser')
            sensors = sensors.only_lasers()
        self._sampler = SensorSampler(self.scenario, sensors, weather, captures, every)
        self._captures: list[TimedCapture] = []
        k = self._sampler.captures
        seen: dict[str, spaces.Space[Any]] = {
            name: space for name, space in self.observation_space.items() if name not in _NOT_SENSED
        }
        seen["count"] = spaces.Discrete(k + 1)
        seen["pose"] = spaces.Box(-FARTHEST, FARTHEST, (k, 3), np.float32)
        seen["captured_at"] = spaces.Box(0.0, LATEST, (k,), np.float32)
        for name, camera, _ in self.rig.cameras:
            seen[sensor_key("image", name)] = spaces.Box(
                0, 255, (k, camera.height, camera.width, 3), np.uint8
            )
        for name, stereo, _ in self.rig.stereo_cameras:
            size = (stereo.camera.height, stereo.camera.width)
            seen[sensor_key("image", name)] = spaces.Box(0, 255, (k, 2, *size, 3), np.uint8)
        for name, laser, _ in self.rig.lasers:
            seen[sensor_key("scan", name)] = spaces.Box(0.0, laser.max_range, (k, laser.n_beams), np.float32)
        self.observation_space = spaces.Dict(seen)

    def _observation(self, vertex: int) -> dict[str, Any]:
        state = self._state
        self._captures = [] if state.parked else self._sampler.sample_step(state, self._before)
        observation: dict[str, Any] = super()._observation(vertex)
        for name in _NOT_SENSED:
            observation.pop(name, None)
        for name, space in self.observation_space.items():
            if name not in observation:
                observation[name] = np.zeros(space.shape, space.dtype)
        observation["count"] = np.int64(len(self._captures))
        for i, (time, capture) in enumerate(self._captures):
            observation["pose"][i] = capture.pose
            observation["captured_at"][i] = time - state.arrival.time
            for name, frame in capture.images.items():
                observation[sensor_key("image", name)][i] = frame.image
            for name, pair in capture.pairs.items():
                observation[sensor_key("image", name)][i] = pair.left.image, pair.right.image
            for name, laser, _ in self.rig.lasers:
                observation[sensor_key("scan", name)][i] = np.minimum(capture.scans[name], laser.max_range)
        return observation

    def _newest(self) -> TimedCapture | None:
        return self._captures[-1] if self._captures else None


def sensor_key(kind: str, name: str) -> str:
    """Return the key of a sensor's data, without dots, which names of PyTorch's modules cannot have."""
    return f"{kind}_{name}".replace(".", "_")


def with_camera_images(
    frame: NDArray[np.uint8], newest: TimedCapture | None, rig: SensorRig
) -> NDArray[np.uint8]:
    """Append the newest image of every camera of the rig to the right of a frame, (h, w, 3).

    Without a capture the images are black, so that all frames of a video have the same width.
    """
    pictures = []
    if newest is not None:
        pictures += [image.image for image in newest.capture.images.values()]
        pictures += [pair.left.image for pair in newest.capture.pairs.values()]
    height = frame.shape[0]
    while len(pictures) < len(rig.cameras) + len(rig.stereo_cameras):
        pictures.append(np.zeros_like(frame))
    resized = [cv2.resize(p, (round(p.shape[1] * height / p.shape[0]), height)) for p in pictures]
    return np.concatenate([frame, *resized], axis=1)
