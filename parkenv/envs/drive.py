"""`parkenv/Drive-v0`: drive the car into the slot."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from parkenv.driving.collision_world import CollisionWorld, ObstacleKind
from parkenv.driving.parking_task import AREA, KINDS, REACH, ParkingTask, ParkingTasks
from parkenv.driving.vehicle import PHYSICS_S, VehicleParameters, advance, placed
from parkenv.driving.yielding_traffic import YieldingTraffic
from parkenv.envs.drive_state import DriveState
from parkenv.errors import InputError
from parkenv.lots import load_lot
from parkenv.world.keyed_random import world_key
from parkenv.world.lot import ParkingLot
from parkenv.world.traffic import Traffic
from sim_sensors.compilation import compiled
from sim_sensors.laser.footprints import ScanPlane
from sim_sensors.laser.scanner import LaserScanner

if TYPE_CHECKING:
    from parkenv.envs.drive_rendering import DriveRenderer

FloatArray = NDArray[np.float64]

SUBSTEPS = 2
"""Steps of the physics in one of the control."""
CONTROL_S = SUBSTEPS * PHYSICS_S
"""s, from one action to the next."""
POSITION_TOLERANCE = 0.25
"""m."""
ANGLE_TOLERANCE = math.radians(5.0)
STANDING = 0.05
"""m/s, the speed below which a car stands."""
CONTACT_COST = 200.0
"""s, what a contact costs by default: more than any drive that ends in time."""
FAR = 1000.0
"""m, slot frame: where the unused rows of the obstacle map lie."""
MOST_CARS, MOST_LINES = 160, 320
"""Rows of the obstacle map."""
REWARD_TERMS = ("time", "approach", "contact")

_CORNERS = 24
_BOUND = 2.0 * REACH
_GOAL = 7


class DriveEnv(gym.Env[dict[str, Any], NDArray[np.float32]]):
    """Drive a car into a slot and stand there, without touching anything.

    ## Description
    A car stands on the lane before a slot that is free. Beside the slot others have parked, not quite straight.
    The car is a kinematic bicycle with limits and rates (`parkenv.driving.vehicle`), moved in steps of 0.05 s; a
    pymunk space says what it touches. An action holds for 0.1 s.

    ## Action space
    `Box(-1, 1, (2,), float32)`; values beyond are cut.

    | Num | Action | -1 | 1 |
    |-----|--------|----|---|
    | 0 | acceleration, as a share of the limit | backward | forward |
    | 1 | steering angle that the wheels turn to, as a share of the greatest | right | left |

    Against the motion, the limit is that of the brakes. They bring the car to rest, not beyond, within a step.

    ## Observation space
    A `Dict` in the form of goals. The frame is the slot's: origin in its middle, x along its yaw, so that a
    car that stands nose-in has yaw 0.

    | Key | Space | Meaning |
    |-----|-------|---------|
    | `observation` | `Box((12,), float32)` | the car and the slot, see below |
    | `achieved_goal` | `Box((7,), float32)` | x, y, cos, sin, speed, half of what the slot is longer and wider |
    | `desired_goal` | `Box((7,), float32)` | the same of the car as it is to stand |
    | `scan` | `Box(0, max_range, (n_beams,), float32)` | m, with `laser` |
    | `cars` | `Box(-1000, 1000, (160, 24, 2), float32)` | m, with `obstacle_map`: outlines of parked cars |
    | `lines` | `Box(-1000, 1000, (320, 2, 2), float32)` | m, with `obstacle_map`: kerbs and walls |
    | `movers` | `Box(-1000, 1000, (n, 24, 2), float32)` | m, with `obstacle_map` and `traffic`: who moves |

    `observation` holds x, y of the footprint's middle (m), cos and sin of the yaw, speed (m/s), steering angle (rad),
    acceleration (m/s²), half of what the slot is longer and wider than the car (m), and a 1 for its kind:
    perpendicular, oblique, parallel. The laser sits in the footprint's middle and low enough to see kerbs, too. In the
    obstacle map the nearest come first, an outline of fewer corners repeats its last, and unused rows lie at 1000 m.

    ## Rewards
    `sparse`: minus the seconds of a step, 0 for the step that parks. `dense`: besides, minus 0.1 s × (distance to the
    goal / 10 m + angle to it / π). A contact costs `contact_cost`. `info["reward_terms"]` holds the terms `time`,
    `approach`, `contact`; they add up to the reward. `compute_reward` gives the same from batches of goals; the
    contact comes from `info["contact"]`.

    ## Starting state
    Standing on the lane, `distance` before the slot, a little aside and askew. `reset(seed=s)` fixes all of it, and
    later `reset()` calls go through further tasks of the same seed.
    `options` of reset: `start`, x, y (m) and yaw (rad) of the rear axle in the lot's frame.

    ## Episode end
    - Terminated: parked (`info["is_success"]`): the footprint lies inside the slot, its middle at most 0.25 m from the
      slot's, the yaw within 5°, and the car stands (0.05 m/s at most); a contact, of which `info["contact"]` names
      the thing; or the car left the area, 27 m around the slot along the lot's axes (`contact` is "left the area").
    - Truncated: after the step limit of the spec, 600, a minute.

    `info` holds time_s, driven_m, direction_changes, position_error_m, angle_error_rad, contact, is_success and parked.

    ## Keys
    For `gymnasium.utils.play.play(env, noop=np.zeros(2, dtype=np.float32))` (needs the extra `human`): w and s
    accelerate forward and backward, a and d steer left and right, two at once do both.

    ## Arguments
    - `lot`: a `ParkingLot`, the name of a packaged one (campus, jam, street, mini), or a lot file.
    - `kinds`, `ways`, `slot`, `occupancy`, `slack`, `distance`, `starts`, `vehicle`: as in `ParkingTasks`. For a
      curriculum, begin with `starts="way-out"`, a small `distance` and a large `slack`.
    - `reward`: sparse or dense. `contact_cost`: s.
    - `laser`: True for the scanner of the thesis (1081 beams over 270°), or a `LaserScanner`.
    - `obstacle_map`: whether the observation holds `cars` and `lines`.
    - `traffic`: `Traffic(cars=4, pedestrians=6)` lets others drive and walk in the lot. They wait for the car, but not
      for one that runs into them.
    - `render_mode`: `rgb_array` (480, 640, 3), or `human` (needs the extra `human`).

    ```python
    >>> import gymnasium as gym
    >>> import parkenv
    >>> env = gym.make("parkenv/Drive-v0", lot="campus", kinds=("oblique",))
    >>> observation, info = env.reset(seed=0)
    >>> observation["achieved_goal"].shape
    (7,)
    >>> observation, reward, terminated, truncated, info = env.step(np.array([1.0, 0.0], dtype=np.float32))
    >>> bool(np.isclose(reward, sum(info["reward_terms"].values())))
    True

    ```

    ## Version history
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
        vehicle: VehicleParameters | None = None,
        reward: str = "sparse",
        contact_cost: float = CONTACT_COST,
        laser: bool | LaserScanner = False,
        obstacle_map: bool = False,
        traffic: Traffic | None = None,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise InputError(f"render_mode is {render_mode!r}, want one of {self.metadata['render_modes']}")
        if reward not in ("sparse", "dense"):
            raise InputError(f"reward is {reward!r}, want sparse or dense")
        if not (
            isinstance(contact_cost, int | float) and math.isfinite(contact_cost) and contact_cost >= 0.0
        ):
            raise InputError(f"contact_cost is {contact_cost!r}, want seconds of 0 or more")
        if not isinstance(laser, bool | LaserScanner):
            raise InputError(f"laser is {laser!r:.40}, want True, False or a LaserScanner")
        if not isinstance(traffic, Traffic | None):
            raise InputError(f"traffic is a {type(traffic).__name__}, want a Traffic")
        self.render_mode = render_mode
        self.vehicle = vehicle or VehicleParameters()
        self.tasks = ParkingTasks(
            lot if isinstance(lot, ParkingLot) else load_lot(lot),
            self.vehicle,
            None if kinds is None else tuple(kinds),
            tuple(ways),
            slot,
            occupancy,
            slack,
            (float(distance[0]), float(distance[-1])),
            starts,
        )
        self._dense, self._contact_cost = reward == "dense", float(contact_cost)
        self.laser = (LaserScanner() if laser else None) if isinstance(laser, bool) else laser
        self._maps = obstacle_map
        self._traffic = traffic or Traffic()
        self._n_movers = self._traffic.cars + self._traffic.pedestrians
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        fastest = max(self.vehicle.max_speed, self.vehicle.max_reverse_speed)
        goal = np.array([_BOUND, _BOUND, 1.0, 1.0, fastest, _BOUND, _BOUND], dtype=np.float32)
        strongest = max(self.vehicle.max_braking, self.vehicle.max_acceleration)
        own = np.r_[goal[:5], self.vehicle.max_steering, strongest, _BOUND, _BOUND, 1.0, 1.0, 1.0]
        own = (own * (1.0 + 1e-6)).astype(np.float32)
        shown: dict[str, spaces.Space[Any]] = {
            "observation": spaces.Box(-own, own, dtype=np.float32),
            "achieved_goal": spaces.Box(-goal, goal, dtype=np.float32),
            "desired_goal": spaces.Box(-goal, goal, dtype=np.float32),
        }
        if self.laser is not None:
            shown["scan"] = spaces.Box(0.0, self.laser.max_range, (self.laser.n_beams,), np.float32)
        if obstacle_map:
            shown["cars"] = spaces.Box(-FAR, FAR, (MOST_CARS, _CORNERS, 2), np.float32)
            shown["lines"] = spaces.Box(-FAR, FAR, (MOST_LINES, 2, 2), np.float32)
            if self._n_movers:
                shown["movers"] = spaces.Box(-FAR, FAR, (self._n_movers, _CORNERS, 2), np.float32)
        self.observation_space = spaces.Dict(shown)
        self._half = np.array([0.5 * self.vehicle.length, 0.5 * self.vehicle.width])
        self._state: DriveState | None = None
        self._episode = 0
        self._renderer: DriveRenderer | None = None

    @property
    def state(self) -> DriveState:
        """The episode under way.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._state is None:
            raise gym.error.ResetNeeded("the environment has no episode yet: call reset() first")
        return self._state

    @property
    def task(self) -> ParkingTask:
        """What is to be done; everybody may know it."""
        return self.state.task

    def get_state(self) -> tuple[int, DriveState]:
        """A copy of the episode, which `set_state` brings back."""
        return self._episode, copy.deepcopy(self.state)

    def set_state(self, state: tuple[int, DriveState]) -> None:
        """Go on from a state that `get_state` of an environment with the same car returned."""
        episode, episode_state = state
        if episode_state.task.vehicle != self.vehicle:
            raise InputError("state is of another vehicle than this environment's")
        if len(episode_state.clocks) != self._n_movers:
            raise InputError(
                f"state has {len(episode_state.clocks)} who move, this environment {self._n_movers}"
            )
        self._episode, self._state = episode, copy.deepcopy(episode_state)
        self._enter(self._state)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start anew; see the class for what a seed fixes and for the option."""
        super().reset(seed=seed)
        unknown = set(options or ()) - {"start"}
        if unknown:
            raise InputError(f"reset has no option {', '.join(sorted(unknown))}, want start or none")
        self._episode = 0 if seed is not None else self._episode + 1
        _ = self.np_random  # draws a seed where none was ever given
        key = world_key(self.np_random_seed, self._episode)
        task = self.tasks.draw(int(key), (options or {}).get("start"))
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
        self._judge(observation)
        return observation, self._info(self._state)

    def step(self, action: ArrayLike) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Drive for 0.1 s; see the class."""
        state = self.state
        if state.over:
            raise gym.error.ResetNeeded("the drive is over: call reset()")
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
            if way != 0.0:
                state.driven_m += abs(way)
                direction = 1 if way > 0.0 else -1
                state.direction_changes += direction == -state.direction
                state.direction = direction
            state.time += PHYSICS_S
            if touched:
                state.contact = ObstacleKind(touched).label
                break
        state.trail.append(tuple(vehicle[:3].tolist()))
        observation = self._observation()
        success = self._judge(observation)
        if not touched and self._away > AREA:
            state.contact = "left the area"
        state.parked = success and not state.contact
        state.over = state.parked or bool(state.contact)
        terms = self._terms(success, bool(state.contact), self._errors[0], self._errors[1])
        info = self._info(state)
        info["reward_terms"] = dict(zip(REWARD_TERMS, terms, strict=True))
        if self.render_mode == "human":
            self.render()
        return observation, sum(terms), state.over, False, info

    def compute_reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any) -> Any:
        """The rewards of goals; see the class.

        Args:
            achieved_goal: (7,) or (n, 7).
            desired_goal: likewise.
            info: of the step, or n of them; one without `contact` counts as without a contact.

        Returns:
            A float, or (n,) float32.
        """
        achieved, desired = (
            np.atleast_2d(np.asarray(g, dtype=np.float32)) for g in (achieved_goal, desired_goal)
        )
        distance, angle, success = goal_errors(achieved, desired, self._half)
        infos = [info] * len(achieved) if isinstance(info, Mapping) else info
        rewards = np.array(
            [
                sum(self._terms(bool(s), bool(i.get("contact")), float(d), float(a)))
                for d, a, s, i in zip(distance, angle, success, infos, strict=True)
            ]
        )
        return float(rewards[0]) if np.ndim(achieved_goal) == 1 else rewards.astype(np.float32)

    def render(self) -> Any:
        """A frame, or the window brought up to date, as `render_mode` says."""
        if self.render_mode is None:
            gym.logger.warn(
                'render() does nothing without a render_mode, e.g. gym.make(..., render_mode="rgb_array")'
            )
            return None
        if self._renderer is None:
            from parkenv.envs.drive_rendering import DriveRenderer

            self._renderer = DriveRenderer(self.tasks.lot)
        frame = self._renderer.frame(self.state, [outline for _, outline in self._moving()])
        if self.render_mode == "human":
            self._renderer.window.show(frame, self.metadata["render_fps"])
            return None
        return frame

    def get_keys_to_action(self) -> dict[tuple[int, ...], NDArray[np.float32]]:
        """Keys of `gymnasium.utils.play`: w and s accelerate forward and backward, a and d steer left and right."""
        along, aside = {"": 0.0, "w": 1.0, "s": -1.0}, {"": 0.0, "a": 1.0, "d": -1.0}
        return {
            tuple(sorted(map(ord, go + turn))): np.array([force, angle], dtype=np.float32)
            for go, force in along.items()
            for turn, angle in aside.items()
            if go + turn
        }

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.window.close()
            self._renderer = None

    def _enter(self, state: DriveState) -> None:
        """Put the world of an episode in place."""
        task = state.task
        movers: list[tuple[ObstacleKind, FloatArray]] = []
        if self._n_movers:
            self._others = YieldingTraffic(self.tasks.lot, self._traffic, state.key, self.tasks.slot_cars)
            movers = self._others.outlines
        self._space = CollisionWorld(self.vehicle, task.obstacles, movers)
        if len(state.movers):
            self._space.move(state.movers)
        self._slot = np.array([*task.slot.tolist(), *task.room.tolist()])
        self._kind = np.array([k == task.kind for k in KINDS], dtype=np.float32)
        turned = float(task.target[2] - task.slot[2])
        still = [0.0, 0.0, round(math.cos(turned), 9), round(math.sin(turned), 9), 0.0, *task.room.tolist()]
        self._desired = np.array(still, dtype=np.float32)
        if self.laser is not None:
            self._plane = scan_plane(task, self._n_movers)
        if self._maps:
            self._map = obstacle_map(task)

    def _observation(self) -> dict[str, Any]:
        state = self.state
        own, achieved = np.empty(12, np.float32), np.empty(_GOAL, np.float32)
        self._away = _observe(state.vehicle, self._slot, self._kind, self.vehicle.middle, own, achieved)
        observation = {"observation": own, "achieved_goal": achieved, "desired_goal": self._desired.copy()}
        outlines = [placed(own, at) for (_, own), at in zip(self._moving(), state.movers, strict=True)]
        if self.laser is not None:
            for k, outline in enumerate(outlines):
                self._plane.replace(self._plane.n_footprints - 1 - k, outline)
            eye = self.vehicle.at_middle(state.vehicle[:3])
            scan = self.laser.scan(self._plane, eye, state.rng)
            observation["scan"] = np.minimum(scan, np.float32(self.laser.max_range))
        if self._maps:
            observation["cars"], observation["lines"] = self._map[0].copy(), self._map[1].copy()
            if self._n_movers:
                seen = np.array([np.r_[o, np.repeat(o[-1:], _CORNERS - len(o), axis=0)] for o in outlines])
                seen = np.clip(state.task.in_slot_frame(seen), -FAR, FAR)
                observation["movers"] = seen.astype(np.float32)
        return observation

    def _moving(self) -> list[tuple[ObstacleKind, FloatArray]]:
        return self._others.outlines if self._n_movers else []

    def _judge(self, observation: dict[str, Any]) -> bool:
        achieved, desired = observation["achieved_goal"], observation["desired_goal"]
        distance, angle, success = goal_error(achieved, desired, self._half)
        self._errors = distance, angle
        return bool(success)

    def _terms(
        self, success: bool, contact: bool, distance: float, angle: float
    ) -> tuple[float, float, float]:
        if success and not contact:
            return 0.0, 0.0, 0.0
        approach = -CONTROL_S * (distance / 10.0 + angle / math.pi) if self._dense else 0.0
        return -CONTROL_S, approach, -self._contact_cost if contact else 0.0

    def _info(self, state: DriveState) -> dict[str, Any]:
        return {
            "is_success": state.parked,
            "contact": state.contact,
            "time_s": state.time,
            "driven_m": state.driven_m,
            "direction_changes": state.direction_changes,
            "position_error_m": self._errors[0],
            "angle_error_rad": self._errors[1],
            "parked": state.parked,
        }


def goal_errors(
    achieved: NDArray[np.float32], desired: NDArray[np.float32], half: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """How far goals are from being reached.

    Args:
        achieved: (n, 7) float32; see `DriveEnv`.
        desired: (n, 7) float32.
        half: (2,) half the car's length and width, m.

    Returns:
        (n,) distance, m; (n,) angle, rad; (n,) whether it counts as parked.
    """
    errors = np.array([goal_error(a, d, half) for a, d in zip(achieved, desired, strict=True)]).reshape(-1, 3)
    return errors[:, 0], errors[:, 1], errors[:, 2] > 0.5


@compiled(error_model="numpy")
def goal_error(
    achieved: NDArray[np.float32], desired: NDArray[np.float32], half: FloatArray
) -> tuple[float, float, float]:
    """Distance, m, angle, rad, and 1 or 0 for whether the car is parked, of one pair of goals."""
    dx, dy = float(achieved[0]) - float(desired[0]), float(achieved[1]) - float(desired[1])
    c, s = float(desired[2]), float(desired[3])
    cosine = float(achieved[2]) * c + float(achieved[3]) * s
    sine = float(achieved[3]) * c - float(achieved[2]) * s
    ahead, aside = abs(c * dx + s * dy), abs(c * dy - s * dx)
    distance, angle = math.hypot(dx, dy), abs(math.atan2(sine, cosine))
    long = half[0] * math.cos(angle) + half[1] * math.sin(angle)
    wide = half[0] * math.sin(angle) + half[1] * math.cos(angle)
    inside = ahead + long <= half[0] + float(desired[5]) and aside + wide <= half[1] + float(desired[6])
    near = distance <= POSITION_TOLERANCE and angle <= ANGLE_TOLERANCE
    stands = abs(float(achieved[4]) - float(desired[4])) <= STANDING
    return distance, angle, 1.0 if (near and inside and stands) else 0.0


@compiled(error_model="numpy")
def _observe(
    vehicle: FloatArray,
    slot: FloatArray,
    kind: NDArray[np.float32],
    middle: float,
    own: NDArray[np.float32],
    achieved: NDArray[np.float32],
) -> float:
    """Fill `own`, (12,), and `achieved`, (7,); how far the car is from the slot along either axis of the world, m."""
    yaw = vehicle[2]
    dx, dy = vehicle[0] + middle * math.cos(yaw) - slot[0], vehicle[1] + middle * math.sin(yaw) - slot[1]
    c, s = math.cos(slot[2]), math.sin(slot[2])
    own[0], own[1] = c * dx + s * dy, c * dy - s * dx
    own[2], own[3] = math.cos(yaw - slot[2]), math.sin(yaw - slot[2])
    own[4], own[5], own[6] = vehicle[3], vehicle[4], vehicle[5]
    own[7], own[8] = slot[3], slot[4]
    own[9:12] = kind
    achieved[:5] = own[:5]
    achieved[5:] = own[7:9]
    return float(max(abs(dx), abs(dy)))


def scan_plane(task: ParkingTask, movers: int = 0) -> ScanPlane:
    """What a laser low on the car meets: parked cars as footprints; kerbs and walls as walls.

    Args:
        task: what stands there.
        movers: places kept after the cars for outlines that move.
    """
    cars = task.obstacles.only(ObstacleKind.PARKED_CAR)
    lines = task.obstacles.only(ObstacleKind.KERB, ObstacleKind.WALL)
    corners = np.zeros((len(cars) + movers, _CORNERS, 2))
    corners[: len(cars), : cars.corners.shape[1]] = cars.corners
    n_corners = np.r_[cars.n_corners, np.zeros(movers, dtype=np.int64)]
    return ScanPlane(corners, n_corners, np.array(lines.corners[:, :2]))


def _between(before: FloatArray, after: FloatArray, share: float) -> FloatArray:
    """Poses, (n, 3), a share of the way from some to others."""
    poses = before + share * (after - before)
    turn = after[:, 2] - before[:, 2]
    poses[:, 2] = before[:, 2] + share * (turn - 2.0 * np.pi * np.round(turn / (2.0 * np.pi)))
    return poses


def obstacle_map(task: ParkingTask) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """`cars` and `lines` of the observation; see `DriveEnv`. What does not fit is the farthest, and left out."""
    cars = np.full((MOST_CARS, _CORNERS, 2), FAR, dtype=np.float32)
    lines = np.full((MOST_LINES, 2, 2), FAR, dtype=np.float32)
    parked = task.in_slot_frame(task.obstacles.only(ObstacleKind.PARKED_CAR).corners[:MOST_CARS])
    cars[: len(parked), : parked.shape[1]] = parked
    cars[: len(parked), parked.shape[1] :] = parked[:, -1:]
    drawn = task.in_slot_frame(task.obstacles.only(ObstacleKind.KERB, ObstacleKind.WALL).corners[:, :2])
    drawn = drawn[np.argsort(np.hypot(*drawn.mean(axis=1).T), kind="stable")][:MOST_LINES]
    lines[: len(drawn)] = drawn
    return cars, lines


def _command(action: ArrayLike) -> tuple[float, float]:
    try:
        acceleration, steering = map(float, np.asarray(action, dtype=np.float64).tolist())
    except (TypeError, ValueError) as error:
        raise InputError(f"action is {action!r:.60}, want two numbers: acceleration and steering") from error
    if not (math.isfinite(acceleration) and math.isfinite(steering)):
        raise InputError(f"action is {[acceleration, steering]}, want two finite numbers from -1 to 1")
    return min(max(acceleration, -1.0), 1.0), min(max(steering, -1.0), 1.0)
