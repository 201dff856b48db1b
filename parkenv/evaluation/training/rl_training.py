"""Train one agent with one seed: learn, evaluate in held-out worlds, write checkpoints.

Subclasses of `Training` define the task and its score: `parkenv.evaluation.training.search_training` and
`parkenv.evaluation.training.drive_training`.
"""

from __future__ import annotations

import csv
import io
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from parkenv.errors import InputError
from parkenv.evaluation.training.configs import TrainingConfig
from parkenv.files.atomic_write import atomic_write
from parkenv.files.limited_reading import csv_records
from planners.learned import ModelCard, algorithm_class

TRAINING_SEEDS = 10_000_000
"""World seeds of training seed s start at (s + 1) times this, far from those of evaluations and benchmark suites."""
MODEL, CHECKPOINT, REPLAY, CURVE = "model.zip", "checkpoint.zip", "replay.pkl", "curve.csv"

Row = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Training(ABC):
    """Base class of trainings: what is trained, for how long, and how it is evaluated.

    Args:
        algorithm: name of an algorithm with a training config.
        steps: decisions in total.
        evaluate_every: decisions between evaluations.

    Raises:
        InputError: an unknown algorithm, or a number out of range.
    """

    algorithm: str
    steps: int
    evaluate_every: int

    def __post_init__(self) -> None:
        _ = self.config
        for name in ("steps", "evaluate_every"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}, want at least 1")

    @property
    @abstractmethod
    def config(self) -> TrainingConfig:
        """Training config of the algorithm.

        Raises:
            InputError: the algorithm has no config for this task.
        """

    @property
    @abstractmethod
    def metrics(self) -> tuple[str, ...]:
        """Names of the results of an evaluation; columns of `curve.csv`."""

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns of `curve.csv`."""
        return ("steps", *self.metrics, "wall_s")

    @abstractmethod
    def make_env(self, seed: int, curve: Sequence[Row]) -> VecEnv:
        """Make the training environment.

        Args:
            seed: seed of the worlds.
            curve: evaluations so far; empty at the start.
        """

    @abstractmethod
    def evaluate(self, model: Any, env: VecEnv) -> Row:
        """Evaluate a model in the held-out worlds, which never change; return the `metrics`."""

    @abstractmethod
    def score(self, row: Row) -> tuple[float, ...]:
        """Return the score of an evaluation, for comparing checkpoints; higher is better."""

    @abstractmethod
    def model_card(self, seed: int, steps: int) -> ModelCard:
        """Return the metadata of the model file."""

    def settings(self) -> dict[str, Any]:
        """Return the arguments of the algorithm's constructor, without the learning rate."""
        return {name: value for name, value in self.config.settings.items() if name != "learning_rate"}

    def prepare(self, model: Any, seed: int) -> None:
        """Prepare a new model before training; subclasses may pretrain it."""
        del model, seed

    def train(self, seed: int, folder: Path, *, tensorboard: bool = False) -> list[Row]:
        """Train with one seed; resume from the folder's checkpoint if there is one.

        `model.zip` is the checkpoint with the best evaluation, `curve.csv` lists all evaluations.

        Args:
            seed: seed of the network and of the worlds.
            folder: output folder, created if missing.
            tensorboard: whether to write a log for TensorBoard.

        Returns:
            The rows of `curve.csv`.
        """
        folder.mkdir(parents=True, exist_ok=True)
        curve = read_curve(folder / CURVE)
        checkpoint, kind = folder / CHECKPOINT, algorithm_class(self.algorithm)
        log = str(folder / "tensorboard") if tensorboard else None
        first = TRAINING_SEEDS * (seed + 1)
        if curve and checkpoint.exists():
            done = ModelCard.of_file(checkpoint).steps
            curve = [row for row in curve if row["steps"] <= done]
            # Do not repeat the worlds from the start of the training.
            env = self.make_env(first + done, curve)
            model = kind.load(checkpoint, env=env, device="cpu", tensorboard_log=log)
            if (folder / REPLAY).exists():
                with warnings.catch_warnings():
                    # Unfinished drives end at the interruption, and hindsight replay warns about it.
                    warnings.filterwarnings("ignore", message="The last trajectory", category=UserWarning)
                    model.load_replay_buffer(folder / REPLAY)
            elif hasattr(model, "learning_starts"):
                model.learning_starts += done
        else:
            curve, env = [], self.make_env(first, ())
            rate = self.config.settings["learning_rate"]
            schedule = LinearSchedule(rate, rate * self.config.final_learning_rate, 1.0)
            model = kind(
                self.config.policy,
                env,
                learning_rate=schedule,
                seed=seed,
                device="cpu",
                tensorboard_log=log,
                **self.settings(),
            )
            self.prepare(model, seed)
        evaluator = _Evaluator(self, seed, folder, env, curve)
        left = self.steps - model.num_timesteps
        if left > 0:
            model.learn(left, callback=evaluator, reset_num_timesteps=False, tb_log_name="run")
        if evaluator.curve[-1]["steps"] < model.num_timesteps:
            evaluator.evaluate(model, model.num_timesteps)
        (folder / REPLAY).unlink(missing_ok=True)
        return evaluator.curve


@dataclass(frozen=True, eq=False)
class Trained:
    """Result of a training, as bytes, so that a worker on another machine can return it.

    Attributes:
        curve: rows of `curve.csv`.
        model: content of `model.zip`.
    """

    curve: list[Row]
    model: bytes

    def save(self, folder: Path) -> None:
        """Write both files to a folder."""
        folder.mkdir(parents=True, exist_ok=True)
        write_curve(folder / CURVE, self.curve)
        with atomic_write(folder / MODEL) as beside:
            beside.write_bytes(self.model)


def train_one(training: Training, seed: int, folder: Path, tensorboard: bool = False) -> Trained:
    """Train with one seed on a single thread, so that one training per core can run in parallel."""
    import torch

    torch.set_num_threads(1)
    curve = training.train(seed, folder, tensorboard=tensorboard)
    return Trained(curve, (folder / MODEL).read_bytes())


class _Evaluator(BaseCallback):  # type: ignore[misc]
    """Callback that evaluates and saves the model during training."""

    def __init__(self, training: Training, seed: int, folder: Path, env: VecEnv, curve: list[Row]) -> None:
        super().__init__()
        self.subject, self.seed, self.folder, self.curve = training, seed, folder, curve
        self.env = env
        self._start = time.monotonic() - (curve[-1]["wall_s"] if curve else 0.0)
        self._due = self._due_after(curve[-1]["steps"] if curve else 0)

    def _due_after(self, steps: int) -> int:
        """Return the step of the next evaluation; it depends on `steps` alone, so an interruption changes nothing."""
        return self.subject.evaluate_every * (1 + steps // self.subject.evaluate_every)

    def _on_training_start(self) -> None:
        if not self.curve:
            self._evaluate_and_log()

    def _on_rollout_start(self) -> None:
        # Between rollouts, so that a checkpoint loses no samples.
        if self.num_timesteps >= self._due:
            self._due = self._due_after(self.num_timesteps)
            self._evaluate_and_log()

    def _on_step(self) -> bool:
        return True

    def _evaluate_and_log(self) -> None:
        for name, value in self.evaluate(self.model, self.num_timesteps).items():
            self.logger.record(f"evaluation/{name}", value)

    def evaluate(self, model: Any, steps: int) -> Row:
        """Evaluate, write the curve and a checkpoint, keep the model if it is the best so far; return the metrics."""
        subject = self.subject
        scores = subject.evaluate(model, self.env)
        row = {"steps": steps, **scores, "wall_s": time.monotonic() - self._start}
        best = max((subject.score(r) for r in self.curve), default=(-np.inf,))
        self.curve.append(row)
        card = subject.model_card(self.seed, steps)
        if steps and hasattr(model, "save_replay_buffer"):
            with atomic_write(self.folder / REPLAY) as beside:
                model.save_replay_buffer(beside)
        save_model(model, card, self.folder / CHECKPOINT)
        if subject.score(row) >= best:
            save_model(model, card, self.folder / MODEL)
        write_curve(self.folder / CURVE, self.curve)
        return scores


def save_model(model: Any, card: ModelCard, path: Path) -> None:
    """Write a model file atomically."""
    with atomic_write(path) as beside, beside.open("wb") as file:
        model.save(file, exclude=["env"])
        file.close()
        card.add_to(beside)


def write_curve(path: Path, curve: Sequence[Mapping[str, Any]]) -> None:
    """Write evaluations as CSV."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(curve[0]) if curve else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(curve)
    with atomic_write(path) as beside:
        beside.write_text(text.getvalue(), encoding="utf-8")


def read_curve(path: Path) -> list[Row]:
    """Read evaluations from CSV; return an empty list if there is no file.

    Raises:
        InputError: a value is not a number.
    """
    if not path.exists():
        return []
    try:
        return [
            {name: int(value) if name == "steps" else float(value) for name, value in row.items()}
            for _, row in csv_records(path)
        ]
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{path}: want numbers in every column of every line ({error})") from error
