"""Training of one agent under one seed: learn, be examined in worlds that were never trained on, leave checkpoints.

What is learned, and how well it is, says a subclass of `Training`: `parkenv.evaluation.training.search_training`, and
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
from parkenv.evaluation.training.configs import Recipe
from parkenv.files.atomic_write import atomic_write
from planners.learned import ModelCard, algorithm_class

TRAINING_SEEDS = 10_000_000
"""Worlds of seed s begin here, times s + 1: far from those of comparisons, examinations and benchmark suites."""
MODEL, CHECKPOINT, REPLAY, CURVE = "model.zip", "checkpoint.zip", "replay.pkl", "curve.csv"

Row = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Training(ABC):
    """What is to be trained, for how long, and how it is examined.

    Args:
        algorithm: one of those that have a recipe.
        steps: decisions to make.
        examine_every: decisions between examinations.

    Raises:
        InputError: an unknown algorithm, or a number out of its range.
    """

    algorithm: str
    steps: int
    examine_every: int

    def __post_init__(self) -> None:
        _ = self.recipe
        for name in ("steps", "examine_every"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}, want at least 1")

    @property
    @abstractmethod
    def recipe(self) -> Recipe:
        """Settings of the algorithm.

        Raises:
            InputError: there are none for it.
        """

    @property
    @abstractmethod
    def scores(self) -> tuple[str, ...]:
        """What an examination finds out; columns of `curve.csv`."""

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns of `curve.csv`."""
        return ("steps", *self.scores, "wall_s")

    @abstractmethod
    def practice(self, seed: int, curve: Sequence[Row]) -> VecEnv:
        """Where to learn.

        Args:
            seed: of its worlds.
            curve: examinations so far; none at the beginning.
        """

    @abstractmethod
    def examine(self, model: Any, practice: VecEnv) -> Row:
        """Examine a model, always in the same worlds; returns `scores`."""

    @abstractmethod
    def merit(self, row: Row) -> tuple[float, ...]:
        """How good an examination was: the more, the better."""

    @abstractmethod
    def card(self, seed: int, steps: int) -> ModelCard:
        """What the model file is to say."""

    def settings(self) -> dict[str, Any]:
        """Of the algorithm's constructor, by its own names; without the learning rate."""
        return {name: value for name, value in self.recipe.settings.items() if name != "learning_rate"}

    def prepare(self, model: Any, seed: int) -> None:
        """What happens to a fresh model before it learns: nothing, unless a subclass says so."""
        del model, seed

    def train(self, seed: int, folder: Path, *, tensorboard: bool = False) -> list[Row]:
        """Learn under one seed; go on from the folder's checkpoint where there is one.

        `model.zip` is the checkpoint that did best in the examinations, `curve.csv` has them all.

        Args:
            seed: of the network and of the worlds.
            folder: made where it is not there.
            tensorboard: whether to keep a log for TensorBoard.

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
            # Not the worlds of the beginning again.
            env = self.practice(first + done, curve)
            model = kind.load(checkpoint, env=env, device="cpu", tensorboard_log=log)
            if (folder / REPLAY).exists():
                with warnings.catch_warnings():
                    # Drives under way end where they were left, of which hindsight would tell.
                    warnings.filterwarnings("ignore", message="The last trajectory", category=UserWarning)
                    model.load_replay_buffer(folder / REPLAY)
            elif hasattr(model, "learning_starts"):
                model.learning_starts += done
        else:
            curve, env = [], self.practice(first, ())
            rate = self.recipe.settings["learning_rate"]
            schedule = LinearSchedule(rate, rate * self.recipe.final_learning_rate, 1.0)
            model = kind(
                self.recipe.policy,
                env,
                learning_rate=schedule,
                seed=seed,
                device="cpu",
                tensorboard_log=log,
                **self.settings(),
            )
            self.prepare(model, seed)
        examiner = _Examiner(self, seed, folder, env, curve)
        left = self.steps - model.num_timesteps
        if left > 0:
            model.learn(left, callback=examiner, reset_num_timesteps=False, tb_log_name="run")
        if examiner.curve[-1]["steps"] < model.num_timesteps:
            examiner.examine(model, model.num_timesteps)
        (folder / REPLAY).unlink(missing_ok=True)
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
        with atomic_write(folder / MODEL) as beside:
            beside.write_bytes(self.model)


def train_one(training: Training, seed: int, folder: Path, tensorboard: bool = False) -> Trained:
    """Train under one seed, on one thread: as many as there are cores may run side by side."""
    import torch

    torch.set_num_threads(1)
    curve = training.train(seed, folder, tensorboard=tensorboard)
    return Trained(curve, (folder / MODEL).read_bytes())


class _Examiner(BaseCallback):  # type: ignore[misc]
    """Examines the model as it learns, and keeps it."""

    def __init__(
        self, training: Training, seed: int, folder: Path, practice: VecEnv, curve: list[Row]
    ) -> None:
        super().__init__()
        self.subject, self.seed, self.folder, self.curve = training, seed, folder, curve
        self.practice = practice
        self._start = time.monotonic() - (curve[-1]["wall_s"] if curve else 0.0)
        self._due = self._due_after(curve[-1]["steps"] if curve else 0)

    def _due_after(self, steps: int) -> int:
        """Decisions at which the next examination is due; a function of those made, so that a stop changes nothing."""
        return self.subject.examine_every * (1 + steps // self.subject.examine_every)

    def _on_training_start(self) -> None:
        if not self.curve:
            self._examine_and_log()

    def _on_rollout_start(self) -> None:
        # Between rollouts, so that a checkpoint loses nothing that was gathered.
        if self.num_timesteps >= self._due:
            self._due = self._due_after(self.num_timesteps)
            self._examine_and_log()

    def _on_step(self) -> bool:
        return True

    def _examine_and_log(self) -> None:
        for name, value in self.examine(self.model, self.num_timesteps).items():
            self.logger.record(f"examination/{name}", value)

    def examine(self, model: Any, steps: int) -> Row:
        """Examine; write the curve, a checkpoint, and the model if it is the best yet; returns the scores."""
        subject = self.subject
        scores = subject.examine(model, self.practice)
        row = {"steps": steps, **scores, "wall_s": time.monotonic() - self._start}
        best = max((subject.merit(r) for r in self.curve), default=(-np.inf,))
        self.curve.append(row)
        card = subject.card(self.seed, steps)
        if steps and hasattr(model, "save_replay_buffer"):
            with atomic_write(self.folder / REPLAY) as beside:
                model.save_replay_buffer(beside)
        save_model(model, card, self.folder / CHECKPOINT)
        if subject.merit(row) >= best:
            save_model(model, card, self.folder / MODEL)
        write_curve(self.folder / CURVE, self.curve)
        return scores


def save_model(model: Any, card: ModelCard, path: Path) -> None:
    """Write a model file, whole or not at all."""
    with atomic_write(path) as beside, beside.open("wb") as file:
        model.save(file, exclude=["env"])
        file.close()
        card.add_to(beside)


def write_curve(path: Path, curve: Sequence[Mapping[str, Any]]) -> None:
    """Write examinations as CSV."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(curve[0]) if curve else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(curve)
    with atomic_write(path) as beside:
        beside.write_text(text.getvalue(), encoding="utf-8")


def read_curve(path: Path) -> list[Row]:
    """Examinations from CSV; none where there is no file.

    Raises:
        InputError: something else than numbers.
    """
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        try:
            return [
                {name: int(value) if name == "steps" else float(value) for name, value in row.items()}
                for row in csv.DictReader(file)
            ]
        except (TypeError, ValueError) as error:
            raise InputError(f"{path}: want numbers in every column of every line ({error})") from error
