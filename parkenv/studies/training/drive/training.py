"""Training for `parkenv/Drive-v1`: the score is the success rate, by kind of slot."""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import binomtest
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from parkenv.compiled.keyed_random import world_key
from parkenv.envs.sb3 import BatchVecEnv
from parkenv.scenarios.build import build
from parkenv.show.figures.learning_curves import save_success_curves
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.training.configs import DRIVE_CONFIGS, DriveTrainingConfig
from parkenv.studies.training.curve_file import Row, across_seeds
from parkenv.studies.training.drive.batch import CONTACT, PARKED, RUNNING, DriveBatch, PreparedTask
from parkenv.studies.training.drive.env import (
    DECISION_S,
    DriveTrainingEnv,
    SlotGroup,
    TerminalGoalReplayBuffer,
    slot_groups,
)
from parkenv.studies.training.learning import RLTraining
from parkenv.studies.training.spec import DriveTrainingSpec, ScenesTrainingSpec
from parkenv.studies.training.training import Tested
from parkenv.studies.trips.parking_runs import ParkingCase, park_all, parking_table
from parkenv.studies.workers import Workers
from parkenv.world.lot import ParkingLot
from planners.goal_features import GoalFeatures
from planners.names import PARKING_PLANNER

_MOST_DECISIONS = round(60.0 / DECISION_S)  # a minute, as in the environment


class Outcome(NamedTuple):
    """Held-out tasks of one kind: (n,) bool, which succeeded; (n,) a result of each; and `more` of the training."""

    parked: NDArray[np.bool_]
    value: NDArray[np.float64]
    more: tuple[float, ...] = ()


class ParkingTraining(RLTraining):
    """Training whose score is the success rate over kinds of slots."""

    spec: DriveTrainingSpec | ScenesTrainingSpec
    value: ClassVar[str] = "time_s"
    """Result whose mean over successes breaks ties: less is better."""
    more: ClassVar[tuple[str, ...]] = ()
    """Further results for each kind."""

    @property
    @abstractmethod
    def kinds(self) -> tuple[str, ...]:
        """The kinds of slots."""

    @abstractmethod
    def outcomes(self, policy: Any, env: VecEnv) -> dict[str, Outcome]:
        """Run a policy in the held-out tasks of each kind of slot."""

    @property
    def compared(self) -> tuple[AgentSpec, ...]:
        """See `Training`: the planner, or none."""
        return self.spec.agents

    @property
    def measures(self) -> tuple[str, ...]:
        """See `Training`."""
        return tuple(f"{kind}_success" for kind in self.kinds)

    @property
    def metrics(self) -> tuple[str, ...]:
        """Success rate and mean `value` over the kinds; then those of each kind, see `evaluate`."""
        of_kind = ("success", "low", "high", self.value, *self.more)
        return ("success", self.value, *(f"{kind}_{name}" for kind in self.kinds for name in of_kind))

    def evaluate(self, policy: Any, env: VecEnv) -> Row:
        """Evaluate a policy on the held-out tasks.

        Returns:
            Per kind: success rate with 95 % interval (Wilson), mean `value` of successes (NaN for none), and `more`.
            `success` and `value` are also means over the kinds.
        """
        row: Row = {}
        for kind, (parked, value, more) in self.outcomes(policy, env).items():
            interval = binomtest(int(parked.sum()), len(parked)).proportion_ci(0.95, "wilson")
            mean = float(value[parked].mean()) if parked.any() else np.nan
            found = (float(parked.mean()), float(interval.low), float(interval.high), mean, *more)
            names = ("success", "low", "high", self.value, *self.more)
            row |= {f"{kind}_{name}": value for name, value in zip(names, found, strict=True)}
        means = {
            name: float(np.mean([row[f"{kind}_{name}"] for kind in self.kinds]))
            for name in ("success", self.value)
        }
        return means | row

    def score(self, row: Row) -> tuple[float, ...]:
        """Return the success rate, then minus the mean value to break ties."""
        value = row[self.value]
        return (row["success"], -value if value == value else -np.inf)

    def across_seeds(self, curves: list[list[Row]]) -> dict[str, list[dict[str, float]]]:
        """See `Training`."""
        return {kind: across_seeds(curves, f"{kind}_success") for kind in self.kinds}

    def save_curves(self, *drawn: Any) -> None:
        """See `Training`."""
        save_success_curves(*drawn)


class DriveTraining(ParkingTraining):
    """Training of an agent that drives into slots, of every kind on the lots equally often."""

    spec: DriveTrainingSpec
    evaluated_by = ("env", "lot", "evaluation_episodes")
    evaluations = 20
    more = ("contacts", "level")

    @property
    def config(self) -> DriveTrainingConfig:
        """See `RLTraining`."""
        return DRIVE_CONFIGS[self.algorithm].for_steps(self.steps)

    @cached_property
    def lots(self) -> tuple[ParkingLot, ...]:
        """Lots to train on."""
        return tuple(build(scenario).lot for scenario in self.scenarios)

    @cached_property
    def tests(self) -> dict[str, ParkingLot]:
        """See `Training`: one on each lot."""
        lots = [build(scenario).lot for scenario in self.spec.test_on or self.scenarios]
        return {lot.name: lot for lot in lots}

    def check(self) -> None:
        """See `Training`."""
        super().check()
        for lots in (self.lots, self.tests.values()):
            slot_groups(tuple(lots))

    def settings(self) -> Row:
        """See `Training`."""
        lots = [lot.name for lot in self.lots]
        return super().settings() | {"lot": lots}

    @cached_property
    def groups(self) -> tuple[SlotGroup, ...]:
        """The slots to train on, by lot and kind."""
        return slot_groups(self.lots)

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of slots on the lots."""
        return tuple(dict.fromkeys(group.kind for group in self.groups))

    def make_env(self) -> BatchVecEnv:
        """Make a batch of drives, at the first level of the curriculum."""
        return BatchVecEnv(DriveTrainingEnv(self.config.n_envs, self.groups, self.config))

    def outcomes(self, policy: Any, env: VecEnv) -> dict[str, Outcome]:
        """See `ParkingTraining`; contacts include leaving the area, the level is that of the curriculum."""
        levels, found = env.get_attr("levels")[0], dict[str, Outcome]()
        for kind in self.kinds:
            status, time = evaluate_parking(policy, self._tasks[kind])
            more = float((status >= CONTACT).mean()), float(levels[kind])
            found[kind] = Outcome(status == PARKED, time, more)
        return found

    def arguments(self) -> dict[str, Any]:
        """Return the constructor's arguments: goal features and, for sparse rewards, hindsight experience replay."""
        settings = super().arguments()
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

    def evaluate_planners(self, workers: Workers) -> dict[str, float]:
        """See `Training`: the success rate in each kind of slot."""
        parkings = parked_on(self.lots, self.evaluation_seeds, workers, PARKING_PLANNER)
        return {row["kind"]: row["success"] for row in parking_table(parkings)}

    def test_planners(self, name: str, workers: Workers) -> list[Row]:
        """See `Training`."""
        parkings = parked_on([self.tests[name]], self.test_seeds, workers, PARKING_PLANNER)
        return [{"agent": PARKING_PLANNER, "scenario": name, **row} for row in parking_table(parkings)]

    def test(self, model: Path, workers: Workers) -> Tested:
        """See `Training`."""
        parkings, transfer = list[Row](), list[Row]()
        for name, lot in self.tests.items():
            some = parked_on([lot], self.test_seeds, workers, f"{self.algorithm}:{model}")
            parkings += some
            transfer += [{"test_scenario": name, **row} for row in parking_table(some)]
        total = parking_table(parkings)[-1]
        own = {c: total[c] for c in ("success", "success_ci95", "contacts", "time_s")}
        return Tested(",".join(self.tests), own, transfer)

    @property
    def title(self) -> str:
        """See `Training`."""
        lots = " and ".join(lot.name for lot in self.lots)
        return f"{lots}: {self.evaluation_episodes} parkings of each kind in held-out tasks"


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
