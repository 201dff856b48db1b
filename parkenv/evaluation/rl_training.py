"""Training of one agent under one seed: learn, be examined in worlds that were never trained on, leave checkpoints."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule

from parkenv import __version__
from parkenv.envs.search_sb3 import SearchVecEnv
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.errors import InputError
from parkenv.evaluation.cloning import Demonstrations, clone
from parkenv.evaluation.recipes import MAX_STEPS, RECIPES, REWARD_SCALE
from parkenv.evaluation.statistics import mean_interval
from parkenv.scenario import Scenario
from parkenv.whole_files import written_whole
from planners.learned import OBSERVATION, LearnedAgent, ModelCard, algorithm_class

TRAINING_SEEDS = 10_000_000
"""Worlds of seed s begin here, times s + 1: far from those of comparisons, examinations and benchmark suites."""
MODEL, CHECKPOINT, CURVE = "model.zip", "checkpoint.zip", "curve.csv"
CURVE_COLUMNS = ("steps", "total_s", "low_s", "high_s", "parked_fraction", "wall_s")

Row = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Training:
    """What is to be trained, where, and how it is examined.

    Args:
        algorithm: one of `RECIPES`.
        scenarios: worlds to learn in, in turns.
        examined_on: seeds of the worlds of the examinations, of the first scenario.
        steps: decisions to make.
        examine_every: decisions between examinations.
        k: slots that the observation tells of.
        demonstrations: to imitate first; None to begin from nothing.
        tensorboard: whether to keep a log for TensorBoard.

    Raises:
        InputError: an unknown algorithm, or a number out of its range.
    """

    algorithm: str
    scenarios: tuple[Scenario, ...]
    examined_on: range
    steps: int
    examine_every: int
    k: int = 5
    demonstrations: Demonstrations | None = None
    tensorboard: bool = False

    def __post_init__(self) -> None:
        if self.algorithm not in RECIPES:
            raise InputError(f"algorithm is {self.algorithm!r}, want one of {', '.join(RECIPES)}")
        for name in ("steps", "examine_every"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}, want at least 1")
        if self.demonstrations is not None and self.algorithm not in ("ppo", "maskable-ppo"):
            raise InputError(f"{self.algorithm} cannot begin by imitation; take ppo or maskable-ppo")

    def card(self, seed: int, steps: int) -> ModelCard:
        """What the model file is to say."""
        recipe = RECIPES[self.algorithm]
        settings = {"n_envs": recipe.n_envs, "policy": recipe.policy, **recipe.settings}
        settings["imitated"] = None if self.demonstrations is None else self.demonstrations.agent
        names = tuple(s.name for s in self.scenarios)
        return ModelCard(self.algorithm, names, self.k, OBSERVATION, seed, steps, settings, __version__)

    def train(self, seed: int, folder: Path) -> list[Row]:
        """Learn under one seed; go on from the folder's checkpoint where there is one.

        `model.zip` is the checkpoint that did best in the examinations, `curve.csv` has them all.

        Args:
            seed: of the network and of the worlds.
            folder: made where it is not there.

        Returns:
            The rows of `curve.csv`.
        """
        folder.mkdir(parents=True, exist_ok=True)
        recipe = RECIPES[self.algorithm]
        env = SearchVecEnv(recipe.n_envs, self.scenarios, REWARD_SCALE, self.k, max_episode_steps=MAX_STEPS)
        env.seed(TRAINING_SEEDS * (seed + 1))
        curve = read_curve(folder / CURVE)
        checkpoint, kind = folder / CHECKPOINT, algorithm_class(self.algorithm)
        log = str(folder / "tensorboard") if self.tensorboard else None
        if curve and checkpoint.exists():
            done = ModelCard.of_file(checkpoint).steps
            curve = [row for row in curve if row["steps"] <= done]
            model = kind.load(checkpoint, env=env, device="cpu", tensorboard_log=log)
            # Not the worlds of the beginning again.
            env.seed(TRAINING_SEEDS * (seed + 1) + done)
        else:
            curve, settings = [], dict(recipe.settings)
            rate = settings.pop("learning_rate")
            schedule = LinearSchedule(rate, rate * recipe.final_learning_rate, 1.0)
            model = kind(
                recipe.policy,
                env,
                learning_rate=schedule,
                seed=seed,
                device="cpu",
                tensorboard_log=log,
                **settings,
            )
            if self.demonstrations is not None:
                clone(model, self.demonstrations, seed)
        examiner = _Examiner(self, seed, folder, curve)
        left = self.steps - model.num_timesteps
        if left > 0:
            model.learn(left, callback=examiner, reset_num_timesteps=False, tb_log_name="run")
            if examiner.curve[-1]["steps"] < model.num_timesteps:
                examiner.examine(model, model.num_timesteps)
        return examiner.curve


@dataclass(frozen=True, eq=False)
class Trained:
    """What a training left, so that it can come from another machine.

    Attributes:
        curve: rows of `curve.csv`.
        model: content of `model.zip`.
    """

    curve: list[Row]
    model: bytes

    def keep_in(self, folder: Path) -> None:
        """Write both files."""
        folder.mkdir(parents=True, exist_ok=True)
        write_curve(folder / CURVE, self.curve)
        with written_whole(folder / MODEL) as beside:
            beside.write_bytes(self.model)


def train_one(training: Training, seed: int, folder: Path) -> Trained:
    """Train under one seed, on one thread: as many as there are cores may run side by side."""
    import torch

    torch.set_num_threads(1)
    curve = training.train(seed, folder)
    return Trained(curve, (folder / MODEL).read_bytes())


def search_times(algorithm: str, path: Path, scenario: Scenario, seeds: Sequence[int]) -> Row:
    """How long the searches of a model take, in the words of `parkenv compare`."""
    agent = LearnedAgent(scenario, algorithm, path)
    times, parked = examined(agent.model, scenario, seeds, agent.local_k)
    mean, low, high = mean_interval(times)
    return {
        "episodes": len(times),
        "parked_fraction": float(parked.mean()),
        "total_s": mean,
        "total_s_ci95": [low, high],
    }


class _Examiner(BaseCallback):  # type: ignore[misc]
    """Examines the model as it learns, and keeps it."""

    def __init__(self, training: Training, seed: int, folder: Path, curve: list[Row]) -> None:
        super().__init__()
        self.training, self.seed, self.folder, self.curve = training, seed, folder, curve
        self._start = time.monotonic() - (curve[-1]["wall_s"] if curve else 0.0)
        self._due = training.examine_every * (1 + len(curve[1:]))

    def _on_training_start(self) -> None:
        if not self.curve:
            self.examine(self.model, 0)

    def _on_rollout_start(self) -> None:
        # Between rollouts, so that a checkpoint loses nothing that was gathered.
        if self.num_timesteps >= self._due:
            self._due += self.training.examine_every
            self.examine(self.model, self.num_timesteps)

    def _on_step(self) -> bool:
        return True

    def examine(self, model: Any, steps: int) -> None:
        """Search in the examination's worlds; write the curve, a checkpoint, and the model if it is the best yet."""
        training = self.training
        times, parked = examined(model, training.scenarios[0], training.examined_on, training.k)
        mean, low, high = mean_interval(times)
        row = dict(
            zip(
                CURVE_COLUMNS,
                (steps, mean, low, high, float(parked.mean()), time.monotonic() - self._start),
                strict=True,
            )
        )
        self.logger.record("examination/total_s", mean)
        best = min((r["total_s"] for r in self.curve), default=np.inf)
        self.curve.append(row)
        save_model(model, training.card(self.seed, steps), self.folder / CHECKPOINT)
        if mean <= best:
            save_model(model, training.card(self.seed, steps), self.folder / MODEL)
        write_curve(self.folder / CURVE, self.curve)


def examined(
    model: Any, scenario: Scenario, seeds: Sequence[int], k: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Total times of a model's searches, (n,) s, and whether it parked, (n,) bool.

    A search that is not over after `MAX_STEPS` decisions is charged `give_up_s`, as in `parkenv compare`.

    Args:
        model: of stable-baselines3 or sb3-contrib, over the `local` observation.
        scenario: the world.
        seeds: a search for each.
        k: slots that the observation tells of.
    """
    n = len(seeds)
    batch = ParkSearchVectorEnv(
        n,
        scenario,
        observation="local",
        k=k,
        max_episode_steps=MAX_STEPS,
        autoreset_mode=AutoresetMode.NEXT_STEP,
    )
    observation, _ = batch.reset(seed=list(seeds))
    times, parked = np.full(n, np.nan), np.zeros(n, dtype=np.bool_)
    state, start = None, np.ones(n, dtype=np.bool_)
    masked = "action_masks" in model.predict.__code__.co_varnames
    while np.isnan(times).any():
        masks = {"action_masks": observation["action_mask"]} if masked else {}
        actions, state = model.predict(
            observation, state=state, episode_start=start, deterministic=True, **masks
        )
        observation, _, terminated, truncated, info = batch.step(actions)
        start = terminated | truncated
        first = start & np.isnan(times)
        if first.any():
            late = truncated & ~terminated
            times[first] = (info["total_s"] + late * scenario.give_up_s)[first]
            parked[first] = info["parked"][first]
    return times, parked


def save_model(model: Any, card: ModelCard, path: Path) -> None:
    """Write a model file, whole or not at all."""
    with written_whole(path) as beside, beside.open("wb") as file:
        model.save(file, exclude=["env"])
        file.close()
        card.add_to(beside)


def write_curve(path: Path, curve: Sequence[Mapping[str, Any]]) -> None:
    """Write examinations as CSV."""
    text = io.StringIO()
    writer = csv.DictWriter(text, CURVE_COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(curve)
    with written_whole(path) as beside:
        beside.write_text(text.getvalue(), encoding="utf-8")


def read_curve(path: Path) -> list[Row]:
    """Examinations from CSV; none where there is no file."""
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return [
            {name: int(value) if name == "steps" else float(value) for name, value in row.items()}
            for row in csv.DictReader(file)
        ]
