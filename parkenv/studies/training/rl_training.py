"""Train one agent with one seed: learn, evaluate in held-out worlds, write checkpoints.

Subclasses of `Training` define the task and its score: `parkenv.studies.training.search_training` and
`parkenv.studies.training.drive_training`.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from parkenv.errors import InputError
from parkenv.files.atomic_write import atomic_write
from parkenv.files.csv_writing import write_csv
from parkenv.studies.training.checkpoint import read_checkpoint, restore, save_checkpoint
from parkenv.studies.training.configs import TrainingConfig
from parkenv.studies.training.curve_file import CURVE, Row, read_curve, require_columns
from planners.model_file import algorithm_class, save_model

TRAINING_SEEDS = 10_000_000
"""World seeds of training seed s start at (s + 1) times this, far from those of evaluations and benchmark suites."""
MODEL, CHECKPOINT = "model.safetensors", "checkpoint.pt"


@dataclass(frozen=True, eq=False)
class AnyTraining(ABC):
    """Base class of all trainings: what is trained, and for how long.

    Args:
        algorithm: name of the algorithm.
        steps: decisions in total.
        evaluate_every: decisions between evaluations.
        command: command line of the training, for the model's card.

    Raises:
        InputError: a number out of range.
    """

    algorithm: str
    steps: int
    evaluate_every: int
    command: tuple[str, ...] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        for name in ("steps", "evaluate_every"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}, want at least 1")

    @property
    @abstractmethod
    def metrics(self) -> tuple[str, ...]:
        """Names of the results of an evaluation; columns of `curve.csv`."""

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns of `curve.csv`."""
        return ("steps", *self.metrics, "wall_s")

    @abstractmethod
    def train(self, seed: int, folder: Path, *, tensorboard: bool = False) -> list[Row]:
        """Train with one seed; write the model and `curve.csv` to a folder.

        Args:
            seed: seed of the network and of the worlds.
            folder: output folder, created if missing.
            tensorboard: whether to write a log for TensorBoard.

        Returns:
            The rows of `curve.csv`.
        """


class Training(AnyTraining):
    """Base class of trainings with stable-baselines3.

    Raises:
        InputError: an unknown algorithm, or a number out of range.
    """

    def __post_init__(self) -> None:
        _ = self.config
        super().__post_init__()

    @property
    @abstractmethod
    def config(self) -> TrainingConfig:
        """Training config of the algorithm.

        Raises:
            InputError: the algorithm has no config for this task.
        """

    @abstractmethod
    def make_env(self) -> VecEnv:
        """Make the training environment, with `get_state` and `set_state` for checkpoints."""

    @abstractmethod
    def evaluate(self, policy: Any, env: VecEnv) -> Row:
        """Evaluate a policy in the held-out worlds, which never change; return the `metrics`."""

    @abstractmethod
    def score(self, row: Row) -> tuple[float, ...]:
        """Return the score of an evaluation, for comparing checkpoints; higher is better."""

    @abstractmethod
    def description(self) -> dict[str, Any]:
        """Return `scenarios` and `settings` for `planners.model_file.save_model`."""

    def settings(self) -> dict[str, Any]:
        """Return the arguments of the algorithm's constructor, without the learning rate."""
        return {name: value for name, value in self.config.settings.items() if name != "learning_rate"}

    def connect(self, model: Any) -> None:
        """Called once the model exists, new or to be restored; subclasses may tell the environment of it."""
        del model

    def prepare(self, model: Any, seed: int) -> None:
        """Prepare a new model before training; subclasses may pretrain it."""
        del model, seed

    def before_rollout(self, model: Any) -> None:
        """Called before each rollout; subclasses may make the environment harder. It must depend on the steps alone."""
        del model

    def before_checkpoint(self, model: Any) -> None:
        """Called between rollouts, before a checkpoint; subclasses may bring the environment to a simpler state."""
        del model

    def train(self, seed: int, folder: Path, *, tensorboard: bool = False) -> list[Row]:
        """Train with one seed; resume from the folder's checkpoint if there is one, as if there had been no stop.

        `model.safetensors` is the model with the best evaluation, `curve.csv` lists all evaluations; the checkpoint is
        removed at the end.

        Args:
            seed: seed of the network and of the worlds.
            folder: output folder, created if missing.
            tensorboard: whether to write a log for TensorBoard.

        Returns:
            The rows of `curve.csv`.
        """
        folder.mkdir(parents=True, exist_ok=True)
        checkpoint, curve = folder / CHECKPOINT, read_curve(folder / CURVE, self.columns)
        if not checkpoint.exists() and curve and curve[-1]["steps"] >= self.steps:
            return curve
        env, rate = self.make_env(), self.config.settings["learning_rate"]
        model = algorithm_class(self.algorithm)(
            self.config.policy,
            env,
            learning_rate=LinearSchedule(rate, rate * self.config.final_learning_rate, 1.0),
            seed=seed,
            device="cpu",
            tensorboard_log=str(folder / "tensorboard") if tensorboard else None,
            **self.settings(),
        )
        if not tensorboard:
            # Otherwise stable-baselines3 makes a new folder for logs in the system's folder of temporary files.
            model.set_logger(Logger(None, []))
        # stable-baselines3 has seeded the environment with the network's seed.
        env.seed(TRAINING_SEEDS * (seed + 1))
        self.connect(model)
        if checkpoint.exists():
            state, curve = read_checkpoint(checkpoint)
            require_columns(curve, self.columns, checkpoint)
            restore(state, model)
        else:
            curve = []
            self.prepare(model, seed)
        evaluator = _Evaluator(self, folder, curve)
        left = self.steps - model.num_timesteps
        if left > 0:
            model.learn(left, callback=evaluator, reset_num_timesteps=False, tb_log_name="run")
        if curve[-1]["steps"] < model.num_timesteps:
            evaluator.evaluate(model)
        checkpoint.unlink(missing_ok=True)
        return curve


@dataclass(frozen=True, eq=False)
class Trained:
    """Result of a training, as bytes, so that a worker on another machine can return it.

    Attributes:
        curve: rows of `curve.csv`.
        model: content of the model file.
    """

    curve: list[Row]
    model: bytes

    def save(self, folder: Path) -> None:
        """Write both files to a folder."""
        folder.mkdir(parents=True, exist_ok=True)
        write_csv(folder / CURVE, list(self.curve[0]), self.curve)
        with atomic_write(folder / MODEL) as beside:
            beside.write_bytes(self.model)


def train_one(training: AnyTraining, seed: int, folder: Path, tensorboard: bool = False) -> Trained:
    """Train with one seed on a single thread, so that one training per core can run in parallel."""
    import torch
    from numba import get_num_threads

    # Starting numba's threads sets the number of OpenMP's, which PyTorch has, too.
    get_num_threads()
    torch.set_num_threads(1)
    curve = training.train(seed, folder, tensorboard=tensorboard)
    return Trained(curve, (folder / MODEL).read_bytes())


class _Evaluator(BaseCallback):  # type: ignore[misc]
    """Callback that evaluates and saves the model during training."""

    def __init__(self, training: Training, folder: Path, curve: list[Row]) -> None:
        super().__init__()
        self.subject, self.folder, self.curve = training, folder, curve
        self._start = time.monotonic() - (curve[-1]["wall_s"] if curve else 0.0)
        self._due = self._due_after(curve[-1]["steps"] if curve else 0)

    def _due_after(self, steps: int) -> int:
        """Return the step of the next evaluation; it depends on `steps` alone, so an interruption changes nothing."""
        return self.subject.evaluate_every * (1 + steps // self.subject.evaluate_every)

    def _on_rollout_start(self) -> None:
        self.subject.before_rollout(self.model)
        # Between rollouts, so that a checkpoint loses no samples.
        if not self.curve or self.num_timesteps >= self._due:
            self._due = self._due_after(self.num_timesteps)
            for name, value in self.evaluate(self.model).items():
                self.logger.record(f"evaluation/{name}", value)

    def _on_step(self) -> bool:
        return True

    def evaluate(self, model: Any) -> Row:
        """Evaluate; keep the model if it is the best so far; write the curve and a checkpoint; return the metrics."""
        subject = self.subject
        scores = subject.evaluate(model.policy, model.env)
        best = max((subject.score(row) for row in self.curve), default=(-np.inf,))
        self.curve.append({"steps": model.num_timesteps, **scores, "wall_s": time.monotonic() - self._start})
        if subject.score(scores) >= best:
            save_model(
                model, self.folder / MODEL, results=scores, command=subject.command, **subject.description()
            )
        write_csv(self.folder / CURVE, list(self.curve[0]), self.curve)
        subject.before_checkpoint(model)
        # Last: a training that is killed before this line repeats what it has just done.
        save_checkpoint(self.folder / CHECKPOINT, model, self.curve)
        return scores
