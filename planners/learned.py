"""Trained models as agents, and their model files.

A model file is a stable-baselines3 archive with an added member `parkenv.json`, the model card: on what and with which
settings the model was trained, and what it observes.
"""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.world.scenario import SearchProblem

ALGORITHMS = {
    "dqn": ("stable_baselines3", "DQN"),
    "ppo": ("stable_baselines3", "PPO"),
    "maskable-ppo": ("sb3_contrib", "MaskablePPO"),
    "recurrent-ppo": ("sb3_contrib", "RecurrentPPO"),
    "sac": ("stable_baselines3", "SAC"),
    "tqc": ("sb3_contrib", "TQC"),
}
"""Module and class of each algorithm."""
OBSERVATION = "local-1"
"""Version of the layout of `parkenv.envs.local_observation` that models must have been trained on."""
TASKS = {"search": "parkenv compare", "drive": "parkenv park"}
"""Tasks of models, and the command that runs each."""
_CARD = "parkenv.json"
_FORMAT = "parkenv-model"
_VERSION = 1


@dataclass(frozen=True)
class ModelCard:
    """Metadata of a model file.

    Args:
        algorithm: one of `ALGORITHMS`.
        scenarios: names of the training scenarios; for driving, of the lots.
        k: number of slots in the observation; 0 for driving.
        observation: version of the observation's layout.
        seed: seed of the training.
        steps: environment steps of the training.
        settings: settings of the algorithm, from its training config.
        parkenv: version of this package at training time.
        task: one of `TASKS`.
    """

    algorithm: str
    scenarios: tuple[str, ...]
    k: int
    observation: str
    seed: int
    steps: int
    settings: Mapping[str, Any]
    parkenv: str
    task: str = "search"

    @classmethod
    def of_file(cls, path: str | os.PathLike[str]) -> Self:
        """Read the card of a model file.

        Raises:
            InputError: the file is missing or damaged, has no card, or has a card of another version.
        """
        try:
            with zipfile.ZipFile(path) as archive:
                if (bad := archive.testzip()) is not None:
                    raise InputError(f"{path}: is damaged: {bad} in it cannot be read")
                if _CARD not in archive.namelist():
                    raise InputError(f"{path}: no model of `parkenv train`: {_CARD} is missing in it")
                content = json.loads(archive.read(_CARD))
        except (OSError, ValueError, zipfile.BadZipFile) as error:
            raise InputError(f"{path}: no model file, or a damaged one ({error})") from error
        if not isinstance(content, dict):
            raise InputError(f"{path}: {_CARD} in it holds a {type(content).__name__}, want a model card")
        if content.pop("format", None) != _FORMAT or content.pop("version", None) != _VERSION:
            raise InputError(f"{path}: want a {_FORMAT} of version {_VERSION}; train it again")
        try:
            return cls(**{**content, "scenarios": tuple(content["scenarios"])})
        except (KeyError, TypeError) as error:
            raise InputError(f"{path}: its card is incomplete ({error})") from error

    def add_to(self, path: str | os.PathLike[str]) -> None:
        """Add the card to an archive that stable-baselines3 saved."""
        content = {"format": _FORMAT, "version": _VERSION, **asdict(self)}
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr(_CARD, json.dumps(content, indent=2))


def algorithm_class(name: str) -> Any:
    """Return the stable-baselines3 class of an algorithm.

    Raises:
        InputError: the name is unknown, or the extra `rl` is not installed.
    """
    if name not in ALGORITHMS:
        raise InputError(f"unknown algorithm {name!r}; known: {', '.join(ALGORITHMS)}")
    module, class_name = ALGORITHMS[name]
    try:
        return getattr(import_module(module), class_name)
    except ImportError as error:
        raise InputError(f'{name} needs the extra rl: pip install "parkenv[rl]"') from error


def load_model(
    algorithm: str, path: str | os.PathLike[str], task: str, observation: str
) -> tuple[ModelCard, Any]:
    """Load a model and its card.

    Args:
        algorithm: algorithm that it was trained with.
        path: the model file.
        task: one of `TASKS`.
        observation: version of the environment's observation layout.

    Raises:
        InputError: the file is not a model, or is one of another algorithm, task or observation.
    """
    card = ModelCard.of_file(path)
    if card.algorithm != algorithm:
        raise InputError(f"{path}: is a model of {card.algorithm}, not of {algorithm}")
    if card.task != task:
        raise InputError(
            f"{path}: was trained to {card.task}, not to {task}; `{TASKS.get(card.task, 'another parkenv')}` runs it"
        )
    if card.observation != observation:
        raise InputError(
            f"{path}: observes {card.observation!r}, this version of parkenv gives {observation!r}; "
            f"it was trained with parkenv {card.parkenv}"
        )
    # A model that is not trained further needs no replay buffer.
    unneeded: dict[str, Any] = {"replay_buffer_class": None, "replay_buffer_kwargs": {}, "buffer_size": 1}
    kind = algorithm_class(algorithm)
    try:
        return card, kind.load(Path(path), device="cpu", custom_objects=unneeded)
    except Exception as error:  # torch raises many types for damaged files
        raise InputError(f"{path}: its network cannot be read ({type(error).__name__}: {error})") from error


class LearnedAgent:
    """A trained model as an agent for any lot, on observations of `parkenv.envs.local_observation`.

    Args:
        problem: lot, goal, speeds and costs.
        algorithm: algorithm that it was trained with.
        path: the model file.

    Raises:
        InputError: the file is not a model, or is one of another algorithm, task or observation.

    Attributes:
        card: metadata of the file.
        local_k: number of slots in the observation.
    """

    def __init__(self, problem: SearchProblem, algorithm: str, path: str | os.PathLike[str]) -> None:
        self.name = f"{algorithm}:{path}"
        self.problem = problem.public()
        self.card, self.model = load_model(algorithm, path, "search", OBSERVATION)
        self.local_k = self.card.k

    def predict(
        self,
        observation: Mapping[str, NDArray[Any]],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """Choose an action for an observation of `LocalObservation` (stable-baselines3's interface).

        Raises:
            InputError: the observation has another layout, or its mask allows no action.
        """
        if "local" not in observation:
            raise InputError(
                f"{self.name} wants observations of parkenv.envs.local_observation.LocalObservation, got "
                f"{', '.join(observation)}"
            )
        given, wanted = observation["local"].shape[-1:], self.model.observation_space["local"].shape
        if given != wanted:
            raise InputError(
                f"{self.name} observes {wanted[0]} numbers, got {given[0]} for its k = {self.local_k}"
            )
        if not np.any(observation["action_mask"], axis=-1).all():
            raise InputError("action_mask allows nothing; a search that goes on allows at least one action")
        masks = {"action_masks": observation["action_mask"]} if self.card.algorithm == "maskable-ppo" else {}
        action, state = self.model.predict(
            dict(observation), state=state, episode_start=episode_start, deterministic=deterministic, **masks
        )
        return action, state
