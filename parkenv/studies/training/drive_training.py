"""Training for `parkenv/Drive-v1`: the score is the success rate, by kind of slot."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from parkenv.compiled.keyed_random import world_key
from parkenv.studies.training.configs import DRIVE_CONFIGS, DriveTrainingConfig, config_of
from parkenv.studies.training.curve_file import Row
from parkenv.studies.training.drive_batch import CONTACT, PARKED, RUNNING, DriveBatch, PreparedTask
from parkenv.studies.training.drive_training_env import (
    DECISION_S,
    DriveTrainingEnv,
    SlotGroup,
    slot_groups,
)
from parkenv.studies.training.rl_training import Training
from parkenv.studies.trips.parking_runs import ParkingCase, park_all
from parkenv.studies.workers import Workers
from parkenv.world.lot import ParkingLot

_MOST_DECISIONS = round(60.0 / DECISION_S)  # a minute, as in the environment


@dataclass(frozen=True, eq=False)
class DriveTraining(Training):
    """Training of an agent that drives into slots; its score is the success rate.

    Args:
        algorithm: one of `DRIVE_CONFIGS`.
        steps: decisions in total.
        evaluate_every: decisions between evaluations.
        lots: lots to train on; every kind of slot on them is used equally often.
        evaluation_seeds: seeds of the held-out tasks, the same for each kind and lot.

    Raises:
        InputError: an unknown algorithm, a number out of range, or a lot without a slot that the car fits into.
    """

    lots: tuple[ParkingLot, ...]
    evaluation_seeds: range

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.groups

    @property
    def config(self) -> DriveTrainingConfig:
        """Training config of the algorithm."""
        return config_of(self.algorithm, DRIVE_CONFIGS, "drive")

    @cached_property
    def groups(self) -> tuple[SlotGroup, ...]:
        """The slots to train on, by lot and kind."""
        return slot_groups(self.lots)

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of slots on the lots."""
        return tuple(dict.fromkeys(group.kind for group in self.groups))

    @property
    def metrics(self) -> tuple[str, ...]:
        """Success rate and mean time, s, over the kinds; then the metrics of each kind, see `evaluate`."""
        of_kind = ("success", "low", "high", "contacts", "time_s", "level")
        return ("success", "time_s", *(f"{kind}_{name}" for kind in self.kinds for name in of_kind))

    def make_env(self) -> DriveTrainingEnv:
        """Make a batch of drives, at the first level of the curriculum."""
        return DriveTrainingEnv(self.config.n_envs, self.groups, self.config)

    def evaluate(self, policy: Any, env: VecEnv) -> Row:
        """Evaluate a policy on the held-out tasks.

        Returns:
            Per kind: success rate with 95 % interval (Wilson), fraction of contacts (including leaving the area), mean
            time of successes, s (NaN for none), and curriculum level. `success` and `time_s` are means over
            the kinds.
        """
        row: Row = {}
        for kind in self.kinds:
            status, time = evaluate_parking(policy, self._tasks[kind])
            parked = status == PARKED
            interval = binomtest(int(parked.sum()), len(parked)).proportion_ci(0.95, "wilson")
            row |= {
                f"{kind}_success": float(parked.mean()),
                f"{kind}_low": float(interval.low),
                f"{kind}_high": float(interval.high),
                f"{kind}_contacts": float((status >= CONTACT).mean()),
                f"{kind}_time_s": float(time[parked].mean()) if parked.any() else np.nan,
                f"{kind}_level": float(env.get_attr("levels")[0][kind]),
            }
        success, time_s = (
            float(np.mean([row[f"{kind}_{name}"] for kind in self.kinds])) for name in ("success", "time_s")
        )
        return {"success": success, "time_s": time_s, **row}

    def score(self, row: Row) -> tuple[float, ...]:
        """Return the success rate, then minus the mean time to break ties."""
        return (row["success"], -row["time_s"] if row["time_s"] == row["time_s"] else -np.inf)

    def settings(self) -> dict[str, Any]:
        """Return the constructor's arguments: goal features and, for sparse rewards, hindsight experience replay."""
        # Imported here because they need torch, which is not needed to describe a training.
        import torch

        from parkenv.studies.training.drive_replay_buffer import TerminalGoalReplayBuffer
        from planners.goal_features import GoalFeatures

        settings = super().settings()
        settings["policy_kwargs"] = settings["policy_kwargs"] | {
            "features_extractor_class": GoalFeatures,
            "activation_fn": torch.nn.ReLU,
        }
        if self.config.reward == "sparse":
            settings["replay_buffer_class"] = TerminalGoalReplayBuffer
            # `copy_info_dict` keeps contacts in relabelled transitions.
            settings["replay_buffer_kwargs"] = settings["replay_buffer_kwargs"] | {"copy_info_dict": True}
        return settings

    def description(self) -> dict[str, Any]:
        """Return lots and settings for the model file."""
        return {"scenarios": [lot.name for lot in self.lots], "settings": dataclasses.asdict(self.config)}

    @cached_property
    def _tasks(self) -> dict[str, list[PreparedTask]]:
        """Return the held-out tasks by kind, as the environment draws them with `evaluation_seeds`."""
        tasks: dict[str, list[PreparedTask]] = {kind: [] for kind in self.kinds}
        for group in self.groups:
            drawn = group.tasks()
            tasks[group.kind] += [
                PreparedTask(drawn.draw(int(world_key(seed, 0)))) for seed in self.evaluation_seeds
            ]
        return tasks


def evaluate_parking(
    model: Any, tasks: Sequence[PreparedTask]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Run one drive per task; return its final `DriveBatch.status`, (n,) int64, and duration, (n,) s.

    Args:
        model: a stable-baselines3 or sb3-contrib model of the observation of `DriveBatch`.
        tasks: one drive each.
    """
    batch = DriveBatch(len(tasks))
    for i, task in enumerate(tasks):
        batch.start(i, task)
    for _ in range(_MOST_DECISIONS):
        actions, _ = model.predict(batch.observation(), deterministic=True)
        batch.drive(actions)
        if not (batch.status == RUNNING).any():
            break
    return batch.status, batch.time


def parked_on(lots: Sequence[ParkingLot], seeds: Sequence[int], workers: Workers, agent: str) -> list[Row]:
    """Park in `parkenv/Drive-v1` in every kind of slot on some lots; return rows of `park_once`.

    Args:
        lots: lots to park on.
        seeds: seeds of the tasks, the same for each kind and lot.
        workers: where the tasks run.
        agent: a name for `planners.driving.parking_agents.make_parking_agent`.
    """
    cases = [ParkingCase(group.lot, (group.kind,)) for group in slot_groups(lots)]
    # Tables are by kind only; each task fixes nose-in or back-in.
    return [p.row | {"way": ""} for some in park_all(cases, seeds, workers, agent) for p in some]
