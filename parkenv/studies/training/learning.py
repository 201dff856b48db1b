"""Training with stable-baselines3: learn, evaluate in held-out worlds, write checkpoints."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from parkenv.errors import InputError
from parkenv.files.csv_tables import write_csv
from parkenv.studies.training.checkpoint import read_checkpoint, restore, save_checkpoint
from parkenv.studies.training.configs import TrainingConfig
from parkenv.studies.training.curve_file import CURVE, Row, read_curve, require_columns
from parkenv.studies.training.spec import RLTrainingSpec
from parkenv.studies.training.training import MODEL, TRAINING_SEEDS, Training
from planners.model_file import algorithm_class, save_model

CHECKPOINT = "checkpoint.pt"


class RLTraining(Training):
    """Base class of trainings with stable-baselines3."""

    spec: RLTrainingSpec
    configs: ClassVar[Mapping[str, TrainingConfig]]
    """Training config of each algorithm."""
    evaluations: ClassVar[int] = 10
    """How many evaluations there are if the specification does not say."""
    most_between: ClassVar[int | None] = None
    """Decisions between evaluations at most, then."""

    n_envs: int | None = None
    """Environments of the training that goes on; None for a new one."""

    @property
    def config(self) -> TrainingConfig:
        """Training config of the algorithm, for a training of so many steps."""
        return self.configs[self.algorithm].for_steps(self.steps, self.n_envs)

    @property
    def steps(self) -> int:
        """See `Training`."""
        return self.spec.steps or self.configs[self.algorithm].steps

    @property
    def evaluate_every(self) -> int:
        """Decisions between evaluations."""
        every = max(1, self.steps // self.evaluations)
        return self.spec.evaluate_every or min(every, self.most_between or every)

    @abstractmethod
    def make_env(self) -> VecEnv:
        """Make the training environment, with `get_state` and `set_state` for checkpoints."""

    @abstractmethod
    def evaluate(self, policy: Any, env: VecEnv) -> Row:
        """Evaluate a policy in the held-out worlds, which never change; return the `metrics`."""

    def score(self, row: Row) -> tuple[float, ...]:
        """Return the score of an evaluation, for comparing checkpoints; higher is better: minus the mean total time."""
        return (-row["total_s"],)

    @abstractmethod
    def description(self) -> dict[str, Any]:
        """Return `scenarios` and `settings` for `planners.model_file.save_model`."""

    def settings(self) -> Row:
        """See `Training`; without the steps, of which a resumed training may have more."""
        return {name: its for name, its in super().settings().items() if name != "steps"}

    def settings_of_model(self, **others: Any) -> dict[str, Any]:
        """Return the settings of a model for its file: those of the config, and others."""
        return {"n_envs": self.config.n_envs, "policy": self.config.policy, **self.config.settings, **others}

    def arguments(self) -> dict[str, Any]:
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

    def train(self, seed: int, folder: Path) -> list[Row]:
        """Train with one seed; resume from the folder's checkpoint if there is one, as if there had been no stop.

        `model.safetensors` is the model with the best evaluation, `curve.csv` lists all evaluations. The checkpoint
        stays, so that a training can be made longer: what depends on how much of it is over, such as the learning
        rate, goes on as at that point of the longer one.

        Args:
            seed: seed of the network and of the worlds.
            folder: output folder, created if missing.

        Returns:
            The rows of `curve.csv`.

        Raises:
            InputError: a training to go on with has lost its checkpoint.
        """
        folder.mkdir(parents=True, exist_ok=True)
        checkpoint, curve = folder / CHECKPOINT, read_curve(folder / CURVE, self.columns)
        if curve and curve[-1]["steps"] >= self.steps:
            return curve
        if len(curve) > 1 and not checkpoint.exists():
            raise InputError(
                f"{checkpoint}: is gone; the training cannot go on from {curve[-1]['steps']} steps"
            )
        begun = read_checkpoint(checkpoint) if checkpoint.exists() else None
        self.n_envs = begun and begun[0]["numbers"]["n_envs"]
        env, rate = self.make_env(), self.config.settings["learning_rate"]
        model = algorithm_class(self.algorithm)(
            self.config.policy,
            env,
            learning_rate=LinearSchedule(rate, rate * self.config.final_learning_rate, 1.0),
            seed=seed,
            device="cpu",
            tensorboard_log=str(folder / "tensorboard") if self.spec.tensorboard else None,
            **self.arguments(),
        )
        if not self.spec.tensorboard:
            # Otherwise stable-baselines3 makes a new folder for logs in the system's folder of temporary files.
            model.set_logger(Logger(None, []))
        # stable-baselines3 has seeded the environment with the network's seed.
        env.seed(TRAINING_SEEDS * (seed + 1))
        self.connect(model)
        if begun is not None:
            state, curve = begun
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
        return curve


class _Evaluator(BaseCallback):  # type: ignore[misc]
    """Callback that evaluates and saves the model during training."""

    def __init__(self, training: RLTraining, folder: Path, curve: list[Row]) -> None:
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
