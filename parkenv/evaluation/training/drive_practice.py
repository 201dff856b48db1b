"""Practice for drivers that learn: drives in a batch for stable-baselines3, whose tasks become harder as they park."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from parkenv.driving.parking_task import KINDS, ParkingTask, ParkingTasks
from parkenv.driving.vehicle import SPEED, VehicleParameters
from parkenv.envs.drive import CONTROL_S, STANDING, goal_errors
from parkenv.envs.shared_vec_env import SharedVecEnv
from parkenv.errors import InputError
from parkenv.evaluation.training.configs import WAY_IN, DriveRecipe
from parkenv.evaluation.training.drive_batch import CONTACT, PARKED, UNDER_WAY, DriveBatch, PreparedTask
from parkenv.world.lot import ParkingLot
from planners.driving.driver_view import HOLD, N_SEEN
from planners.driving.hybrid_astar import plan_path

FloatArray = NDArray[np.float64]
Observations = dict[str, NDArray[np.float32]]

DECISION_S = HOLD * CONTROL_S
"""s, from one decision to the next."""
MOST_DECISIONS = 80
"""In one drive: half a minute, in which whoever knows how parks from anywhere."""
STOOD = 5
"""Decisions, one after another, with which a drive ends after which the car stands: who has learned little as yet
stops where it knows no way on, and would not move again."""
TRIED = 100
"""Drives at a level by which is judged whether it is mastered."""
MASTERED = 0.7
"""Share of them that must have parked."""
SHARES = (0.5, 0.25, 0.25)
"""How often a drive is of the level that is being learned, of any up to it, and of the last one."""
TIMES_DRIVEN = 20
"""How often a task is driven, on the average: to draw one takes as long as to drive it a few times."""
KEPT = 128
"""Tasks of each kind, lot and level that are at hand."""

_STEP_M = 0.1


@dataclass(frozen=True, eq=False)
class Place:
    """The slots of a kind on a lot."""

    lot: ParkingLot
    kind: str

    def tasks(
        self, slack: float = 0.0, distance: tuple[float, float] = (4.0, 14.0), starts: str = "lane"
    ) -> ParkingTasks:
        """Tasks there; by default those of `parkenv/Drive-v1`."""
        return ParkingTasks(self.lot, kinds=(self.kind,), slack=slack, distance=distance, starts=starts)


def places_of(lots: Sequence[ParkingLot]) -> tuple[Place, ...]:
    """All kinds of slots that some lots have and the car fits into, kind by kind.

    Raises:
        InputError: a lot has none.
    """
    vehicle = VehicleParameters()
    places = []
    for lot in lots:
        fits = (lot.slot_length >= vehicle.length) & (lot.slot_width >= vehicle.width)
        kinds = np.array(ParkingTasks(lot).slot_kinds)[fits]
        places += [Place(lot, kind) for kind in KINDS if kind in kinds]
    return tuple(sorted(places, key=lambda place: KINDS.index(place.kind)))


class Exercise(NamedTuple):
    """A task, and where to begin with it.

    Attributes:
        task: as a batch takes it.
        way: (n, 3) x, y in m and yaw in rad of the rear axle, slot frame: along the planner's way into the slot, from
            its end backward, a pose every 0.1 m or less; None to begin at the task's own start.
    """

    task: PreparedTask
    way: FloatArray | None


def way_in(task: ParkingTask) -> FloatArray:
    """The `way` of an exercise; the task's start alone where the planner finds none."""
    around, target = task.obstacles, task.vehicle.at_rear_axle(task.target)
    path = plan_path(task.vehicle, around.corners, around.n_corners, task.start[:3], target)
    way = task.start[None, :3].copy() if path is None else path.sampled(_STEP_M)[0][::-1].copy()
    way[:, :2] = task.in_slot_frame(way[:, :2])
    way[:, 2] -= task.slot[2]
    return way


class DrivePractice(SharedVecEnv):
    """Drives with decisions as in `planners.driving.driver_view`, at the levels of a recipe's curriculum.

    Each kind of slot is at a level of its own, and begins at the first. A level is mastered when of the last `TRIED`
    drives at it `MASTERED` parked. `SHARES` of the drives are of the level, of easier ones, and of the last one, which
    is the task of `parkenv/Drive-v1` itself. The more levels a kind has before it, the more often it is driven into.
    A drive that is not over after `MOST_DECISIONS`, or in which the car has stood for `STOOD` of them, is cut off.

    With the `sparse` reward, a decision costs its 0.4 s, whole, unless it ends in the slot, so that `compute_reward`
    can tell it from the goals and from whether there was a contact. With the `dense` one it costs what the environment
    says.

    Args:
        num_envs: how many drives at once.
        places: where.
        recipe: rewards and curriculum.
        levels: of each kind to begin with.

    Raises:
        InputError: no places, or a level that there is not.
    """

    def __init__(
        self,
        num_envs: int,
        places: Sequence[Place],
        recipe: DriveRecipe,
        levels: Mapping[str, int] | None = None,
    ) -> None:
        if num_envs < 1:
            raise InputError(f"num_envs is {num_envs}, want at least 1")
        if not places:
            raise InputError("places: want at least one kind of slots on one lot")
        self.recipe, self._last = recipe, len(recipe.curriculum) - 1
        self._places: dict[str, list[Place]] = {}
        for place in places:
            self._places.setdefault(place.kind, []).append(place)
        self.levels = dict.fromkeys(self._places, 0) | dict(levels or {})
        for kind, level in self.levels.items():
            if not 0 <= level <= self._last:
                raise InputError(f"level of {kind} slots is {level}, want 0 to {self._last}")
        self._lately: dict[str, deque[bool]] = {kind: deque(maxlen=TRIED) for kind in self._places}
        self._tasks: dict[tuple[Place, int], ParkingTasks] = {}
        self._at_hand: dict[tuple[Place, int], list[Exercise]] = {}
        self.batch = DriveBatch(num_envs)
        goal = spaces.Box(-np.inf, np.inf, (7,), np.float32)
        seen = spaces.Box(-np.inf, np.inf, (N_SEEN,), np.float32)
        shown: dict[str, spaces.Space[Any]] = {
            "observation": seen,
            "achieved_goal": goal,
            "desired_goal": goal,
        }
        super().__init__(num_envs, spaces.Dict(shown), spaces.Box(-1.0, 1.0, (2,), np.float32))
        self._rng = np.random.default_rng(0)
        self._at = [("", 0)] * num_envs
        self._returns, self._lengths = np.zeros(num_envs), np.zeros(num_envs, dtype=np.int64)
        self._stood = np.zeros(num_envs, dtype=np.int64)

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Fix the tasks that are drawn from now on."""
        self._rng = np.random.default_rng(seed)
        return [seed] * self.num_envs

    def reset(self) -> Observations:
        """Begin anew everywhere; the levels stay."""
        for i in range(self.num_envs):
            self._begin(i)
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        return self.batch.observation()

    def step_wait(
        self,
    ) -> tuple[Observations, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Do it. Where a drive ends, `info` has what `Monitor` tells, `is_success` and `contact`."""
        batch = self.batch
        batch.drive(np.asarray(self.actions, dtype=np.float32))
        observations = batch.observation()
        failed = batch.status >= CONTACT
        if self.recipe.reward == "sparse":
            rewards = self._sparse(batch.status == PARKED, failed)
        else:
            rewards = self._scaled(batch.took + batch.approach, failed)
        self._returns += rewards
        self._lengths += 1
        self._stood = np.where(np.abs(batch.state[:, SPEED]) <= STANDING, self._stood + 1, 0)
        over = batch.status != UNDER_WAY
        done = over | (self._lengths >= MOST_DECISIONS) | (self._stood >= STOOD)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done).tolist():
            parked = bool(batch.status[i] == PARKED)
            infos[i] = {
                "terminal_observation": {name: values[i].copy() for name, values in observations.items()},
                "TimeLimit.truncated": not over[i],
                "episode": {"r": float(self._returns[i]), "l": int(self._lengths[i])},
                "is_success": parked,
                "contact": bool(failed[i]),
            }
            self._note(*self._at[i], parked)
            self._begin(i)
        for name, values in batch.observation(np.flatnonzero(done)).items():
            observations[name][done] = values
        return observations, rewards, done, infos

    def compute_reward(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any
    ) -> NDArray[np.float32]:
        """The sparse rewards of decisions that led to goals, (n,) float32.

        Args:
            achieved_goal: (n, 7) float32, after the decision.
            desired_goal: (n, 7) float32.
            info: of each; one without `contact` counts as without a contact.
        """
        achieved, desired = (np.asarray(g, dtype=np.float32) for g in (achieved_goal, desired_goal))
        _, _, parked = goal_errors(achieved, desired, self.batch.view.half)
        return self._sparse(parked, np.array([bool(i.get("contact")) for i in info]))

    def _sparse(self, parked: NDArray[np.bool_], failed: NDArray[np.bool_]) -> NDArray[np.float32]:
        return self._scaled(np.where(parked & ~failed, 0.0, DECISION_S), failed)

    def _scaled(self, seconds: FloatArray, failed: NDArray[np.bool_]) -> NDArray[np.float32]:
        recipe = self.recipe
        rewards = -recipe.reward_scale * (seconds + recipe.contact_cost * failed)
        return rewards.astype(np.float32)

    def _note(self, kind: str, level: int, parked: bool) -> None:
        """Count how a drive ended; go up a level where this one is mastered."""
        if level != self.levels[kind] or level == self._last:
            return
        lately = self._lately[kind]
        lately.append(parked)
        if len(lately) == TRIED and sum(lately) >= MASTERED * TRIED:
            self.levels[kind] += 1
            lately.clear()

    def _begin(self, i: int) -> None:
        rng = self._rng
        ahead = np.array([1.0 + self._last - self.levels[kind] for kind in self._places])
        kind = list(self._places)[rng.choice(len(ahead), p=ahead / ahead.sum())]
        places = self._places[kind]
        place = places[rng.integers(len(places))]
        now = self.levels[kind]
        level = (now, int(rng.integers(now + 1)), self._last)[rng.choice(3, p=SHARES)]
        task, way = self._exercise(place, level)
        pose = None
        if way is not None:
            left = rng.uniform(*self.recipe.curriculum[level].distance)
            pose = way[min(round(left / _STEP_M), len(way) - 1)]
        self.batch.start(i, task, pose)
        self._at[i] = kind, level
        self._returns[i], self._lengths[i], self._stood[i] = 0.0, 0, 0

    def _exercise(self, place: Place, level: int) -> Exercise:
        key, rng = (place, level), self._rng
        stage = self.recipe.curriculum[level]
        inward = stage.starts == WAY_IN
        if key not in self._tasks:
            self._tasks[key] = (
                place.tasks(stage.slack) if inward else place.tasks(stage.slack, stage.distance, stage.starts)
            )
            self._at_hand[key] = []
        at_hand = self._at_hand[key]
        if at_hand and rng.random() * TIMES_DRIVEN >= 1.0:
            return at_hand[rng.integers(len(at_hand))]
        task = self._tasks[key].draw(int(rng.integers(1 << 62)))
        exercise = Exercise(PreparedTask(task), way_in(task) if inward else None)
        if len(at_hand) < KEPT:
            at_hand.append(exercise)
        else:
            at_hand[rng.integers(KEPT)] = exercise
        return exercise
