"""Training for `parkenv/Drive-v1`: how many parkings succeed counts, by kind of slot."""

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

from parkenv import __version__
from parkenv.evaluation.experiments.workers import Workers
from parkenv.evaluation.training.configs import DRIVE_RECIPES, DriveRecipe, recipe_of
from parkenv.evaluation.training.drive_batch import CONTACT, PARKED, UNDER_WAY, DriveBatch, PreparedTask
from parkenv.evaluation.training.drive_practice import DECISION_S, DrivePractice, Place, places_of
from parkenv.evaluation.training.rl_training import Row, Training
from parkenv.evaluation.trips.parking_runs import ParkingCase, park_all
from parkenv.world.keyed_random import world_key
from parkenv.world.lot import ParkingLot
from planners.driving.driver_view import VIEW
from planners.learned import ModelCard

_MOST_DECISIONS = round(60.0 / DECISION_S)  # a minute, as in the environment


@dataclass(frozen=True, eq=False)
class DriveTraining(Training):
    """Learning to drive into slots.

    Args:
        algorithm: one of `DRIVE_RECIPES`.
        steps: decisions to make.
        examine_every: decisions between examinations.
        lots: where to learn; each kind of slot that they have is driven into as often as the others.
        examined_on: seeds of the examinations' tasks, the same for each kind and lot.

    Raises:
        InputError: an unknown algorithm, a number out of its range, or a lot without a slot that the car fits into.
    """

    lots: tuple[ParkingLot, ...]
    examined_on: range

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.places

    @property
    def recipe(self) -> DriveRecipe:
        """Settings of the algorithm."""
        return recipe_of(self.algorithm, DRIVE_RECIPES, "drive")

    @cached_property
    def places(self) -> tuple[Place, ...]:
        """Where to learn."""
        return places_of(self.lots)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Of slots."""
        return tuple(dict.fromkeys(place.kind for place in self.places))

    @property
    def scores(self) -> tuple[str, ...]:
        """Success and mean time, s, over the kinds; then what there is of each kind, see `examine`."""
        of_kind = ("success", "low", "high", "contacts", "time_s", "level")
        return ("success", "time_s", *(f"{kind}_{name}" for kind in self.kinds for name in of_kind))

    def practice(self, seed: int, curve: Sequence[Row]) -> DrivePractice:
        """Drives at the levels that were reached."""
        levels = {kind: int(curve[-1][f"{kind}_level"]) for kind in self.kinds} if curve else None
        env = DrivePractice(self.recipe.n_envs, self.places, self.recipe, levels)
        env.seed(seed)
        return env

    def examine(self, model: Any, practice: VecEnv) -> Row:
        """Park in tasks that are not trained on.

        Returns:
            Of each kind: the share that parked with its 95 % interval (Wilson), the share that ended with a contact or
            outside the area, the mean time, s, of those that parked (NaN for none), and the level of the curriculum.
            `success` and `time_s` are means over the kinds.
        """
        row: Row = {}
        for kind in self.kinds:
            status, time = parked_by(model, self._tasks[kind])
            parked = status == PARKED
            interval = binomtest(int(parked.sum()), len(parked)).proportion_ci(0.95, "wilson")
            row |= {
                f"{kind}_success": float(parked.mean()),
                f"{kind}_low": float(interval.low),
                f"{kind}_high": float(interval.high),
                f"{kind}_contacts": float((status >= CONTACT).mean()),
                f"{kind}_time_s": float(time[parked].mean()) if parked.any() else np.nan,
                f"{kind}_level": float(practice.get_attr("levels")[0][kind]),
            }
        success, time_s = (
            float(np.mean([row[f"{kind}_{name}"] for kind in self.kinds])) for name in ("success", "time_s")
        )
        return {"success": success, "time_s": time_s, **row}

    def merit(self, row: Row) -> tuple[float, ...]:
        """The more succeed, the better; of equals, the faster."""
        return (row["success"], -row["time_s"] if row["time_s"] == row["time_s"] else -np.inf)

    def settings(self) -> dict[str, Any]:
        """Of the algorithm's constructor, with what a network makes of goals, and hindsight for sparse rewards."""
        # These need torch, which a training that is only described does not.
        import torch

        from parkenv.evaluation.training.drive_hindsight import EndingGoals
        from planners.goal_features import GoalFeatures

        settings = super().settings()
        settings["policy_kwargs"] = settings["policy_kwargs"] | {
            "features_extractor_class": GoalFeatures,
            "activation_fn": torch.nn.ReLU,
        }
        if self.recipe.reward == "sparse":
            settings["replay_buffer_class"] = EndingGoals
            # `copy_info_dict`: what is a contact stays one in hindsight.
            settings["replay_buffer_kwargs"] = settings["replay_buffer_kwargs"] | {"copy_info_dict": True}
        return settings

    def card(self, seed: int, steps: int) -> ModelCard:
        """What the model file is to say."""
        settings = dataclasses.asdict(self.recipe)
        names = tuple(lot.name for lot in self.lots)
        return ModelCard(self.algorithm, names, 0, VIEW, seed, steps, settings, __version__, "drive")

    @cached_property
    def _tasks(self) -> dict[str, list[PreparedTask]]:
        """The examination's, by kind: those that the environment draws with these seeds."""
        tasks: dict[str, list[PreparedTask]] = {kind: [] for kind in self.kinds}
        for place in self.places:
            drawn = place.tasks()
            tasks[place.kind] += [
                PreparedTask(drawn.draw(int(world_key(seed, 0)))) for seed in self.examined_on
            ]
        return tasks


def parked_by(model: Any, tasks: Sequence[PreparedTask]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """How a model's drives end, (n,) see `DriveBatch.status`, and when, (n,) s.

    Args:
        model: of stable-baselines3 or sb3-contrib, over what `DriveBatch` observes.
        tasks: a drive each.
    """
    batch = DriveBatch(len(tasks))
    for i, task in enumerate(tasks):
        batch.start(i, task)
    for _ in range(_MOST_DECISIONS):
        actions, _ = model.predict(batch.observation(), deterministic=True)
        batch.drive(actions)
        if not (batch.status == UNDER_WAY).any():
            break
    return batch.status, batch.time


def parked_on(lots: Sequence[ParkingLot], seeds: Sequence[int], workers: Workers, driver: str) -> list[Row]:
    """Parkings in the environment itself, in every kind of slot on some lots; rows of `park_once`.

    Args:
        lots: where.
        seeds: of the tasks, the same for each kind and lot.
        workers: who runs it.
        driver: a name for `planners.driving.drivers.make_driver`.
    """
    cases = [ParkingCase(place.lot, (place.kind,)) for place in places_of(lots)]
    # Tables are by kind; the way of standing in a slot is part of the task.
    return [p.row | {"way": ""} for some in park_all(cases, seeds, workers, driver) for p in some]
