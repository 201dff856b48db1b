"""Training environment for parking agents: a batch of drives with a curriculum, and its replay buffer."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import ArrayLike, NDArray
from stable_baselines3.common.buffers import DictReplayBufferSamples
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.parking_task import KINDS, ParkingTask, ParkingTasks
from parkenv.driving.vehicle import SPEED, VehicleParameters
from parkenv.envs.drive import CONTROL_S
from parkenv.envs.drive_goals import STANDING, goal_errors
from parkenv.errors import InputError
from parkenv.studies.training.configs import WAY_IN, DriveTrainingConfig
from parkenv.studies.training.drive.batch import CONTACT, PARKED, RUNNING, DriveBatch, PreparedTask
from parkenv.world.lot import ParkingLot
from planners.driving.hybrid_astar import plan_path
from planners.driving.policy_interface import ACTION_REPEAT, OBSERVATION_SIZE

Observations = dict[str, NDArray[np.float32]]

DECISION_S = ACTION_REPEAT * CONTROL_S  # time between decisions, s
MOST_DECISIONS = 80  # step limit of a drive: half a minute, enough for a trained agent from any start
STANDSTILL_DECISIONS = 5
"""Truncate a drive after this many consecutive decisions at a standstill: an untrained agent would not move again."""
RECENT_DRIVES = 100  # number of recent drives at a level that decide whether it is mastered
MASTERED = 0.7  # fraction of these drives that must end parked
SHARES = (0.5, 0.25, 0.25)
"""Probabilities that a drive uses the current level, a random level up to it, or the last level."""
TIMES_DRIVEN = 20  # mean number of drives per drawn task: drawing a task takes as long as a few drives
CACHED_TASKS = 128  # number of cached tasks per kind, lot and level

_STEP_M = 0.1


@dataclass(frozen=True, eq=False)
class SlotGroup:
    """The slots of one kind on one lot."""

    lot: ParkingLot
    kind: str

    def tasks(self, **ends: Any) -> ParkingTasks:
        """Tasks in these slots; by default those of `parkenv/Drive-v1`."""
        return ParkingTasks(self.lot, kinds=(self.kind,), **ends)


def slot_groups(lots: Sequence[ParkingLot]) -> tuple[SlotGroup, ...]:
    """Group the slots that the car fits into by lot and kind, sorted by kind.

    Raises:
        InputError: a lot has no such slot.
    """
    vehicle = VehicleParameters()
    groups = []
    for lot in lots:
        fits = (lot.slot_length >= vehicle.length) & (lot.slot_width >= vehicle.width)
        kinds = np.array(ParkingTasks(lot).slot_kinds)[fits]
        groups += [SlotGroup(lot, kind) for kind in KINDS if kind in kinds]
    return tuple(sorted(groups, key=lambda group: KINDS.index(group.kind)))


class CurriculumTask(NamedTuple):
    """A task and its possible start poses."""

    task: PreparedTask  # in the slot's frame
    # (n, 3) x, y in m and yaw in rad of the rear axle, slot frame: along the planned path into the slot, from its end
    # backwards, at most 0.1 m apart; None to start at the task's own start
    path: FloatArray | None


def planned_path(task: ParkingTask) -> FloatArray:
    """Return the `path` of a curriculum task; only the start if the planner finds no path."""
    around, target = task.obstacles, task.vehicle.at_rear_axle(task.target)
    path = plan_path(task.vehicle, around.corners, around.n_corners, task.start[:3], target)
    way = task.start[None, :3].copy() if path is None else path.sampled(_STEP_M)[0][::-1].copy()
    way[:, :2] = task.in_slot_frame(way[:, :2])
    way[:, 2] -= task.slot[2]
    return way


class DriveTrainingEnv(VectorEnv[Observations, FloatArray, NDArray[Any]]):
    """A batch of drives with the decisions of `planners.driving.policy_interface` and a curriculum.

    Each kind of slot has its own level, which starts at the first. A level is mastered when a fraction `MASTERED` of
    its last `RECENT_DRIVES` drives ended parked. `SHARES` gives the fractions of drives at the current level, at a
    random level up to it, and at the last level, which is the task of `parkenv/Drive-v1` itself. Kinds with more levels
    left are drawn more often. A drive is truncated after `MOST_DECISIONS`, or after `STANDSTILL_DECISIONS` consecutive
    decisions at a standstill.

    With the `sparse` reward, a decision costs 0.4 s unless it ends in the slot, so `compute_reward` needs only goals
    and contacts. The `dense` reward is that of the environment.

    Args:
        num_envs: number of drives.
        groups: slots to park in.
        config: rewards and curriculum.
        levels: initial level of each kind.

    Raises:
        InputError: no groups, or an unknown level.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012 - Gymnasium declares it so

    def __init__(
        self,
        num_envs: int,
        groups: Sequence[SlotGroup],
        config: DriveTrainingConfig,
        levels: Mapping[str, int] | None = None,
    ) -> None:
        if num_envs < 1:
            raise InputError(f"num_envs is {num_envs}, want at least 1")
        if not groups:
            raise InputError("groups: want at least one kind of slots on one lot")
        self.config, self._last = config, len(config.curriculum) - 1
        self._groups: dict[str, list[SlotGroup]] = {}
        for group in groups:
            self._groups.setdefault(group.kind, []).append(group)
        self.levels = dict.fromkeys(self._groups, 0) | dict(levels or {})
        for kind, level in self.levels.items():
            if not 0 <= level <= self._last:
                raise InputError(f"level of {kind} slots is {level}, want 0 to {self._last}")
        self._recent: dict[str, deque[bool]] = {kind: deque(maxlen=RECENT_DRIVES) for kind in self._groups}
        self._tasks: dict[tuple[SlotGroup, int], ParkingTasks] = {}
        # By group and level: seeds of the tasks drawn so far, and the tasks that they make.
        self._seeds_of = {(group, level): list[int]() for group in groups for level in range(self._last + 1)}
        self._made: dict[tuple[SlotGroup, int], dict[int, CurriculumTask]] = {
            key: {} for key in self._seeds_of
        }
        self.batch = DriveBatch(num_envs)
        goal = spaces.Box(-np.inf, np.inf, (7,), np.float32)
        seen = spaces.Box(-np.inf, np.inf, (OBSERVATION_SIZE,), np.float32)
        shown: dict[str, spaces.Space[Any]] = {
            "observation": seen,
            "achieved_goal": goal,
            "desired_goal": goal,
        }
        self.num_envs, self.single_observation_space = num_envs, spaces.Dict(shown)
        self.single_action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._rng = np.random.default_rng(0)
        self._at = [("", 0)] * num_envs
        self._stood, self._decisions = np.zeros((2, num_envs), dtype=np.int64)

    def get_state(self) -> dict[str, Any]:
        """Return the drives under way, the levels and the drawn tasks as plain values, for `set_state`."""
        return {
            "rng": self._rng.bit_generator.state,
            "levels": self.levels,
            "recent": {kind: list(outcomes) for kind, outcomes in self._recent.items()},
            "seeds": list(self._seeds_of.values()),
            "at": self._at,
            "stood": self._stood,
            "decisions": self._decisions,
            "batch": self.batch.get_state(),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a state that `get_state` returned for the same groups and config."""
        self._rng.bit_generator.state = state["rng"]
        self.levels = dict(state["levels"])
        for kind, outcomes in self._recent.items():
            outcomes.extend(state["recent"][kind])
        self._seeds_of = dict(zip(self._seeds_of, map(list, state["seeds"]), strict=True))
        self._at, self._stood, self._decisions = list(state["at"]), state["stood"], state["decisions"]
        self.batch.set_state(state["batch"])

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start a new episode in every drive; keep the levels. The first seed is that of the drawing of tasks."""
        del options
        if seed is not None:
            self._rng = np.random.default_rng(seed if isinstance(seed, int) else seed[0])
        for i in range(self.num_envs):
            self._start_episode(i)
        return self.batch.observation(), {}

    def step(
        self, actions: FloatArray
    ) -> tuple[Observations, NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Step all drives; `info["final_info"]` has `is_success` and `contact` of those that have ended."""
        batch = self.batch
        batch.drive(np.asarray(actions, dtype=np.float32))
        observations = batch.observation()
        failed = batch.status >= CONTACT
        parked = batch.status == PARKED
        if self.config.reward == "sparse":
            rewards = self._sparse(parked, failed)
        else:
            rewards = self._scaled(batch.took + batch.approach, failed)
        self._decisions += 1
        self._stood = np.where(np.abs(batch.state[:, SPEED]) <= STANDING, self._stood + 1, 0)
        over = batch.status != RUNNING
        truncated = ~over & ((self._decisions >= MOST_DECISIONS) | (self._stood >= STANDSTILL_DECISIONS))
        done = over | truncated
        info: dict[str, Any] = {"final_info": {"is_success": parked, "contact": failed}}
        info["final_info"] |= {"_is_success": done, "_contact": done}
        info["final_obs"] = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(done).tolist():
            info["final_obs"][i] = {name: values[i].copy() for name, values in observations.items()}
            self._record_outcome(*self._at[i], bool(parked[i]))
            self._start_episode(i)
        for name, values in batch.observation(np.flatnonzero(done)).items():
            observations[name][done] = values
        return observations, rewards, over, truncated, info

    def compute_reward(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any
    ) -> NDArray[np.float32]:
        """Compute the sparse rewards, (n,) float32, of decisions.

        Args:
            achieved_goal: (n, 7) float32, goal reached by the decision.
            desired_goal: (n, 7) float32.
            info: `info` of each decision; without `contact` there was none.
        """
        achieved, desired = (np.asarray(g, dtype=np.float32) for g in (achieved_goal, desired_goal))
        _, _, parked = goal_errors(achieved, desired, self.batch.view.half)
        return self._sparse(parked, np.array([bool(i.get("contact")) for i in info]))

    def _sparse(self, parked: NDArray[np.bool_], failed: NDArray[np.bool_]) -> NDArray[np.float32]:
        return self._scaled(np.where(parked & ~failed, 0.0, DECISION_S), failed)

    def _scaled(self, seconds: FloatArray, failed: NDArray[np.bool_]) -> NDArray[np.float32]:
        config = self.config
        rewards = -config.reward_scale * (seconds + config.contact_cost * failed)
        return rewards.astype(np.float32)

    def _record_outcome(self, kind: str, level: int, parked: bool) -> None:
        """Record how a drive ended; advance to the next level when this one is mastered."""
        if level != self.levels[kind] or level == self._last:
            return
        recent = self._recent[kind]
        recent.append(parked)
        if len(recent) == RECENT_DRIVES and sum(recent) >= MASTERED * RECENT_DRIVES:
            self.levels[kind] += 1
            recent.clear()

    def _start_episode(self, i: int) -> None:
        rng = self._rng
        ahead = np.array([1.0 + self._last - self.levels[kind] for kind in self._groups])
        kind = list(self._groups)[rng.choice(len(ahead), p=ahead / ahead.sum())]
        groups = self._groups[kind]
        group = groups[rng.integers(len(groups))]
        now = self.levels[kind]
        level = (now, int(rng.integers(now + 1)), self._last)[rng.choice(3, p=SHARES)]
        task, path = self._draw_task(group, level)
        pose = None
        if path is not None:
            left = rng.uniform(*self.config.curriculum[level].distance)
            pose = path[min(round(left / _STEP_M), len(path) - 1)]
        self.batch.start(i, task, pose)
        self._at[i] = kind, level
        self._stood[i] = self._decisions[i] = 0

    def _draw_task(self, group: SlotGroup, level: int) -> CurriculumTask:
        key, rng = (group, level), self._rng
        seeds, made = self._seeds_of[key], self._made[key]
        if seeds and rng.random() * TIMES_DRIVEN >= 1.0:
            seed = seeds[rng.integers(len(seeds))]
        else:
            seed = int(rng.integers(1 << 62))
            if len(seeds) < CACHED_TASKS:
                seeds.append(seed)
            else:
                i = rng.integers(CACHED_TASKS)
                made.pop(seeds[i], None)
                seeds[i] = seed
        if seed not in made:
            stage = self.config.curriculum[level]
            on_path = stage.starts == WAY_IN
            if key not in self._tasks:
                ends = {} if on_path else {"distance": stage.distance, "starts": stage.starts}
                self._tasks[key] = group.tasks(**ends)
            task = self._tasks[key].draw(seed)
            made[seed] = CurriculumTask(PreparedTask(task), planned_path(task) if on_path else None)
        return made[seed]


class TerminalGoalReplayBuffer(HerReplayBuffer):  # type: ignore[misc]
    """stable-baselines3's hindsight experience replay with terminal goals.

    In the base class, a relabelled episode continues after its goal. A drive ends there because the car has parked.
    Moreover, most relabelled goals cannot be held: the car passes through them at speed.
    """

    @property
    def contacts(self) -> NDArray[np.bool_]:
        """Whether each transition ended in a contact, (size, n_envs): the part of `info` that rewards depend on."""
        return np.array([[bool(info.get("contact")) for info in row] for row in self.infos])

    @contacts.setter
    def contacts(self, values: NDArray[np.bool_]) -> None:
        self.infos = np.array([[{"contact": value} for value in row] for row in values.tolist()])

    def _get_virtual_samples(
        self, batch_indices: NDArray[np.int64], env_indices: NDArray[np.int64], env: Any = None
    ) -> DictReplayBufferSamples:
        samples = super()._get_virtual_samples(batch_indices, env_indices, env)
        # A sparse reward is 0 only where the goal is reached.
        return samples._replace(dones=torch.maximum(samples.dones, (samples.rewards == 0.0).float()))
