"""`parkenv/Drive-v1`: drive a car into a parking slot."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.keyed_random import world_key
from parkenv.driving.collision_world import CollisionWorld, ObstacleKind
from parkenv.driving.parking_task import AREA, DriveState, ParkingTasks
from parkenv.driving.road_users import YieldingTraffic
from parkenv.driving.scene_files import vehicle_of
from parkenv.driving.vehicle import PHYSICS_S, VehicleParameters, advance, placed
from parkenv.envs.drive_observation import (
    DriveObserver,
    goal_error,
    goal_errors,
)
from parkenv.errors import InputError, require, require_number, require_one_of, reset_options
from parkenv.lots import load_lot
from parkenv.world.lot import ParkingLot
from parkenv.world.traffic import Traffic
from sim_sensors.laser.scanner import LaserScanner

if TYPE_CHECKING:
    from parkenv.show.frames.drive import DriveRenderer


SUBSTEPS = 2  # physics steps per action
CONTROL_S = SUBSTEPS * PHYSICS_S  # control period, s
CONTACT_COST = 200.0  # default cost of a contact, s: more than any drive within the step limit
REWARD_TERMS = ("reward_time", "reward_approach", "reward_contact")
LEFT_AREA = "left the area"
CONTACTS = ("", *(kind.label for kind in ObstacleKind if kind), LEFT_AREA)  # what `info["contact"]` numbers


class DriveEnv(gym.Env[dict[str, Any], NDArray[np.float32]]):
    """Drive a car into a parking slot and stop there without a collision.

    ## Description
    A car starts on the lane in front of a free slot between slightly misaligned parked cars. Its motion model is a
    kinematic bicycle with limited speeds and rates (`parkenv.driving.vehicle`), integrated in steps of 0.05 s; pymunk
    detects collisions. An action is applied for 0.1 s.

    ## Action Space
    `Box(-1, 1, (2,), float32)`; values outside are clipped.

    | Num | Action | Min (-1) | Max (1) |
    |-----|--------|----------|---------|
    | 0 | acceleration, fraction of the limit | backward | forward |
    | 1 | steering angle of the wheels, fraction of the limit | right | left |

    Acceleration against the direction of motion brakes: the limit is then the braking limit, and the car at most
    comes to rest within a step.

    ## Observation Space
    A `Dict` with the keys of Gymnasium-Robotics' goal environments. Positions are in the slot's frame: the origin is
    its centre and x points along its yaw, so a car parked nose-in has yaw 0.

    | Key | Space | Content |
    |-----|-------|---------|
    | `observation` | `Box((12,), float32)` | state of the car and dimensions of the slot, see below |
    | `achieved_goal` | `Box((7,), float32)` | x, y, cos(yaw), sin(yaw), speed, and half the excess of the slot's \
length and width over the car's |
    | `desired_goal` | `Box((7,), float32)` | the same for the parked car |
    | `scan` | `Box(0, max_range, (n_beams,), float32)` | laser ranges, m; with `laser` |
    | `cars` | `Box(-1000, 1000, (160, 24, 2), float32)` | outlines of parked cars, m; with `obstacle_map` |
    | `lines` | `Box(-1000, 1000, (320, 2, 2), float32)` | kerbs and walls, m; with `obstacle_map` |
    | `vehicle` | `Box(0, 1000, (11,), float32)` | the car, `VehicleParameters.numbers`: constant; with `obstacle_map` |
    | `movers` | `Box(-1000, 1000, (n, 24, 2), float32)` | outlines of moving road users, m; with `obstacle_map` and \
`traffic` |

    `observation`:

    | Num | Content | Unit | Bounds |
    |-----|---------|------|--------|
    | 0, 1 | x, y of the footprint's centre | m | ±60 |
    | 2, 3 | cosine and sine of the yaw | | ±1 |
    | 4 | speed, negative backward | m/s | ± the car's limit |
    | 5 | steering angle, positive to the left | rad | ± the car's limit |
    | 6 | acceleration | m/s² | ± the car's limit |
    | 7, 8 | half the excess of the slot's length and width over the car's | m | ±60 |
    | 9-11 | kind of the slot, one-hot: perpendicular, oblique, parallel | | ±1 |

    The laser is at the centre of the footprint, low enough to detect kerbs. Rows of the obstacle map are sorted by
    distance. Outlines with fewer corners are padded with their last corner, unused rows with 1000 m.

    ## Rewards
    - `sparse`: -0.1 per step, its duration in seconds; 0 for the step that parks.
    - `dense`: in addition -0.1 s × (distance to the goal / 10 m + angle to it / π).

    A contact costs `contact_cost`, s. `info` holds the parts of the reward, `reward_time`, `reward_approach` and
    `reward_contact`. `compute_reward(achieved_goal, desired_goal, info)` returns the same for batches of goals,
    with the contact from `info["contact"]`.

    ## Starting State
    The car is on the lane, `distance` before the slot, up to 0.2 m off the driving line and up to 4° off its
    direction, with straight wheels. `reset(seed=s)` determines all of it; later `reset()` calls draw further tasks of
    the seed. Option of `reset`: `start`, x, y (m) and yaw (rad) of the rear axle in the lot's frame.

    ## Episode End
    Terminated:

    1. parked (`info["is_success"]`): the footprint is inside the slot, its centre at most 0.25 m from the slot's, the
       yaw within 5°, and the speed at most 0.05 m/s;
    2. a contact; `info["contact"]` is the obstacle's number: 1 parked car, 2 kerb, 3 wall, 4 moving car, 5 pedestrian;
    3. the car left the area of 27 m around the slot along the lot's axes (`contact` is 6).

    Truncated after 600 steps, one minute.

    ## Info
    Numbers under the same keys after reset and step: `time_s`, `driven_m`, `direction_changes`, `position_error_m`,
    `angle_error_rad`, `contact` (0 without one), `is_success`, `parked` and the parts of the reward.
    Hindsight relabelling needs the contact: `HerReplayBuffer(..., copy_info_dict=True)` in stable-baselines3.

    ## Arguments
    - `lot`: a `ParkingLot`, the name of a packaged lot (campus, jam, street, mini), or a lot file.
    - `kinds`, `ways`, `slot`, `occupancy`, `slack`, `distance`, `starts`: see `ParkingTasks`. A curriculum
      starts with `starts="way-out"`, a small `distance` and a large `slack`.
    - `vehicle`: `VehicleParameters`, the name of a car (golf, tpcap, parkbench), or a file (.toml, .json).
    - `reward`: `sparse` or `dense`. `contact_cost`: s.
    - `laser`: True for the thesis's scanner (1081 beams over 270°), or a `LaserScanner`.
    - `obstacle_map`: whether the observation has `cars`, `lines` and `vehicle`.
    - `traffic`: e.g. `Traffic(cars=4, pedestrians=6)` adds moving cars and pedestrians. They wait for the car, but do
      not swerve if it drives into them.
    - `render_mode`: `rgb_array` (480, 640, 3), or `human` (needs the extra `human`).

    ```python
    >>> import gymnasium as gym
    >>> import numpy as np
    >>> import parkenv
    >>> env = gym.make("parkenv/Drive-v1", lot="campus", kinds=("oblique",))
    >>> observation, info = env.reset(seed=0)
    >>> observation["achieved_goal"].shape
    (7,)
    >>> observation, reward, terminated, truncated, info = env.step(np.array([1.0, 0.0], dtype=np.float32))
    >>> bool(np.isclose(reward, sum(info[name] for name in info if name.startswith("reward_"))))
    True

    ```

    ## Keys
    For `gymnasium.utils.play.play(env, noop=np.zeros(2, dtype=np.float32))` (needs the extra `human`): w and s
    accelerate forward and backward, a and d steer left and right; combinations are possible.

    ## Version History
    - v1: same version number as the other environments.
    - v0: first version.
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": ["human", "rgb_array"],
        "render_fps": 10,
    }
    observation_space: spaces.Dict

    def __init__(
        self,
        lot: ParkingLot | str | Path = "campus",
        render_mode: str | None = None,
        kinds: Sequence[str] | None = None,
        ways: Sequence[str] = ("nose-in", "back-in"),
        slot: str | None = None,
        occupancy: float = 0.85,
        slack: float = 0.0,
        distance: tuple[float, float] = (4.0, 14.0),
        starts: str = "lane",
        vehicle: VehicleParameters | str | None = None,
        reward: str = "sparse",
        contact_cost: float = CONTACT_COST,
        laser: bool | LaserScanner = False,
        obstacle_map: bool = False,
        traffic: Traffic | None = None,
    ) -> None:
        require_one_of("render_mode", render_mode, (None, *self.metadata["render_modes"]))
        require_one_of("reward", reward, ("sparse", "dense"))
        require_number("contact_cost", contact_cost, least=0.0)
        if not isinstance(laser, bool | LaserScanner):
            raise InputError(f"laser is {laser!r:.40}, want True, False or a LaserScanner")
        require(isinstance(traffic, Traffic | None), f"traffic is a {type(traffic).__name__}, want a Traffic")
        self.render_mode = render_mode
        self.vehicle = VehicleParameters() if vehicle is None else vehicle_of(vehicle)
        lot = lot if isinstance(lot, ParkingLot) else load_lot(lot)
        near_far = float(distance[0]), float(distance[-1])
        of_kinds = None if kinds is None else tuple(kinds)
        self.tasks = ParkingTasks(
            lot, self.vehicle, of_kinds, tuple(ways), slot, occupancy, slack, near_far, starts
        )
        self._reward = _Reward(reward == "dense", float(contact_cost))
        self.laser = (LaserScanner() if laser else None) if isinstance(laser, bool) else laser
        self._traffic = traffic or Traffic()
        self._n_movers = self._traffic.cars + self._traffic.pedestrians
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._observer = DriveObserver(self.vehicle, self.laser, self._n_movers, obstacle_map)
        self.observation_space = self._observer.space
        self._half = np.array([0.5 * self.vehicle.length, 0.5 * self.vehicle.width])
        self._state: DriveState | None = None
        self._episode, self._closed = 0, False
        self._renderer: DriveRenderer | None = None

    @property
    def state(self) -> DriveState:
        if self._state is None:
            raise gym.error.ResetNeeded("the environment has no episode yet: call reset() first")
        return self._state

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        given = reset_options(options, ("start",))
        super().reset(seed=seed)
        self._episode = 0 if seed is not None else self._episode + 1
        _ = self.np_random  # draws a seed if none was given
        key = world_key(self.np_random_seed, self._episode)
        task = self.tasks.draw(int(key), given.get("start"))
        self._state = DriveState(key, task, task.start.copy(), np.random.default_rng([int(key), 1]))
        self._state.trail.append(tuple(task.start[:3].tolist()))
        self._enter(self._state)
        if self._n_movers:
            self._state.clocks = self._others.initial_clocks(self.vehicle.corners(task.start[:3]))
            self._state.movers = self._others.poses(self._state.clocks)
            self._space.move(self._state.movers)
        if self.render_mode == "human":
            self.render()
        observation = self._observation()
        self._update_errors(observation)
        return observation, _info(self._state, (0.0,) * len(REWARD_TERMS), self._errors)

    def step(self, action: ArrayLike) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        state = self.state
        if state.over or self._closed:
            raise gym.error.ResetNeeded("the episode has ended, or was closed: call reset()")
        acceleration, steering = _command(action)
        vehicle, limits, space = state.vehicle, self.vehicle.limits, self._space
        touched = 0
        if self._n_movers:
            before = state.movers
            state.clocks = self._others.advance_clocks(
                state.clocks, CONTROL_S, self.vehicle.corners(vehicle[:3])
            )
            state.movers = self._others.poses(state.clocks)
        for k in range(SUBSTEPS):
            if self._n_movers:
                space.move(_between(before, state.movers, (k + 1) / SUBSTEPS))
            way = advance(vehicle, acceleration, steering, limits)
            touched = space.touched(*vehicle[:3].tolist())
            state.count(way, PHYSICS_S)
            if touched:
                state.contact = ObstacleKind(touched).label
                break
        state.trail.append(tuple(vehicle[:3].tolist()))
        observation = self._observation()
        success = self._update_errors(observation)
        if not touched and self._away > AREA:
            state.contact = LEFT_AREA
        state.parked = success and not state.contact
        state.over = state.parked or bool(state.contact)
        terms = self._reward.terms(success, bool(state.contact), self._errors[0], self._errors[1])
        info = _info(state, terms, self._errors)
        if self.render_mode == "human":
            self.render()
        return observation, sum(terms), state.over, False, info

    def compute_reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any) -> Any:
        """Return the reward of goals of shape (7,), a float, or of n goals and infos, (n,) float32; see the class."""
        achieved, desired = (
            np.atleast_2d(np.asarray(g, dtype=np.float32)) for g in (achieved_goal, desired_goal)
        )
        distance, angle, success = goal_errors(achieved, desired, self._half)
        infos = [info] * len(achieved) if isinstance(info, Mapping) else info
        rewards = np.array(
            [
                sum(self._reward.terms(bool(s), bool(i.get("contact")), float(d), float(a)))
                for d, a, s, i in zip(distance, angle, success, infos, strict=True)
            ]
        )
        return float(rewards[0]) if np.ndim(achieved_goal) == 1 else rewards.astype(np.float32)

    def render(self) -> Any:
        if self.render_mode is None:
            gym.logger.warn(
                'render() does nothing without a render_mode, e.g. gym.make(..., render_mode="rgb_array")'
            )
            return None
        if self._renderer is None:
            from parkenv.show.frames.drive import DriveRenderer

            self._renderer = DriveRenderer(self.tasks.lot)
        frame = self._renderer.frame(self.state, [outline for _, outline in self._moving()])
        if self.render_mode == "human":
            self._renderer.window.show(frame, self.metadata["render_fps"])
            return None
        return frame

    def get_keys_to_action(self) -> dict[tuple[int, ...], NDArray[np.float32]]:
        along, aside = {"": 0.0, "w": 1.0, "s": -1.0}, {"": 0.0, "a": 1.0, "d": -1.0}
        return {
            tuple(sorted(map(ord, go + turn))): np.array([force, angle], dtype=np.float32)
            for go, force in along.items()
            for turn, angle in aside.items()
            if go + turn
        }

    def close(self) -> None:
        self._closed = True
        if self._renderer is not None:
            self._renderer.window.close()
            self._renderer = None

    def _enter(self, state: DriveState) -> None:
        self._closed, task = False, state.task
        movers: list[tuple[ObstacleKind, FloatArray]] = []
        if self._n_movers:
            self._others = YieldingTraffic(self.tasks.lot, self._traffic, state.key, self.tasks.slot_cars)
            movers = self._others.outlines
        self._space = CollisionWorld(self.vehicle, task.obstacles, movers)
        if len(state.movers):
            self._space.move(state.movers)
        self._observer.enter(task)

    def _observation(self) -> dict[str, Any]:
        state = self.state
        outlines = [placed(own, at) for (_, own), at in zip(self._moving(), state.movers, strict=True)]
        observation, self._away = self._observer.observe(state, outlines)
        return observation

    def _moving(self) -> list[tuple[ObstacleKind, FloatArray]]:
        return self._others.outlines if self._n_movers else []

    def _update_errors(self, observation: dict[str, Any]) -> bool:
        achieved, desired = observation["achieved_goal"], observation["desired_goal"]
        distance, angle, success = goal_error(achieved, desired, self._half)
        self._errors = distance, angle
        return bool(success)


class _Reward(NamedTuple):
    dense: bool
    contact_cost: float  # s

    def terms(
        self, success: bool, contact: bool, distance: float, angle: float
    ) -> tuple[float, float, float]:
        """Return `REWARD_TERMS` of a step that ends at a distance, m, and an angle, rad, from the goal."""
        if success and not contact:
            return 0.0, 0.0, 0.0
        approach = -CONTROL_S * (distance / 10.0 + angle / math.pi) if self.dense else 0.0
        return -CONTROL_S, approach, -self.contact_cost if contact else 0.0


def _info(state: DriveState, terms: Sequence[float], errors: tuple[float, float]) -> dict[str, Any]:
    return {
        **dict(zip(REWARD_TERMS, terms, strict=True)),
        "is_success": state.parked,
        "contact": CONTACTS.index(state.contact),
        "time_s": state.time,
        "driven_m": state.driven_m,
        "direction_changes": state.direction_changes,
        "position_error_m": errors[0],
        "angle_error_rad": errors[1],
        "parked": state.parked,
    }


def _between(before: FloatArray, after: FloatArray, share: float) -> FloatArray:
    poses = before + share * (after - before)
    turn = after[:, 2] - before[:, 2]
    poses[:, 2] = before[:, 2] + share * (turn - 2.0 * np.pi * np.round(turn / (2.0 * np.pi)))
    return poses


def _command(action: ArrayLike) -> tuple[float, float]:
    try:
        acceleration, steering = map(float, np.asarray(action, dtype=np.float64).tolist())
    except (TypeError, ValueError) as error:
        raise InputError(f"action is {action!r:.60}, want two numbers: acceleration and steering") from error
    if not (math.isfinite(acceleration) and math.isfinite(steering)):
        raise InputError(f"action is {[acceleration, steering]}, want two finite numbers from -1 to 1")
    return min(max(acceleration, -1.0), 1.0), min(max(steering, -1.0), 1.0)
