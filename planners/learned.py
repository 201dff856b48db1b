"""Models that reinforcement learning made: their files, and the agents that they are.

A model file is stable-baselines3's own archive with one more member, `parkenv.json`: what it was trained on, with which
settings, and what it observes.
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
from parkenv.world.scenario import Scenario, SearchProblem

ALGORITHMS = {
    "dqn": ("stable_baselines3", "DQN"),
    "ppo": ("stable_baselines3", "PPO"),
    "maskable-ppo": ("sb3_contrib", "MaskablePPO"),
    "recurrent-ppo": ("sb3_contrib", "RecurrentPPO"),
    "sac": ("stable_baselines3", "SAC"),
    "tqc": ("sb3_contrib", "TQC"),
}
"""Names of algorithms, and where they are."""
OBSERVATION = "local-1"
"""Of `parkenv.envs.local_observation`: a model of another layout would read nonsense."""
TASKS = {"search": "parkenv compare", "drive": "parkenv park"}
"""What models are trained for, and which command runs them."""
_CARD = "parkenv.json"
_FORMAT = "parkenv-model"
_VERSION = 1


@dataclass(frozen=True)
class ModelCard:
    """What a model file says of itself.

    Args:
        algorithm: one of `ALGORITHMS`.
        scenarios: names of those it was trained on; of lots, if it drives.
        k: how many slots its observation tells of; 0, if it drives.
        observation: the layout of that.
        seed: of the training.
        steps: decisions made in training.
        settings: of the algorithm, as its recipe states them.
        parkenv: version of the package that trained it.
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
        """Read it from a model file.

        Raises:
            InputError: no such file, a torn one, one without a card, or of another version.
        """
        try:
            with zipfile.ZipFile(path) as archive:
                if (bad := archive.testzip()) is not None:
                    raise InputError(f"{path}: is torn: {bad} in it cannot be read")
                if _CARD not in archive.namelist():
                    raise InputError(f"{path}: no model of `parkenv train`: {_CARD} is missing in it")
                content = json.loads(archive.read(_CARD))
        except (OSError, ValueError, zipfile.BadZipFile) as error:
            raise InputError(f"{path}: no model file, or a torn one ({error})") from error
        if not isinstance(content, dict):
            raise InputError(
                f"{path}: {_CARD} in it holds a {type(content).__name__}, want what it was trained for"
            )
        if content.pop("format", None) != _FORMAT or content.pop("version", None) != _VERSION:
            raise InputError(f"{path}: want a {_FORMAT} of version {_VERSION}; train it anew")
        try:
            return cls(**{**content, "scenarios": tuple(content["scenarios"])})
        except (KeyError, TypeError) as error:
            raise InputError(f"{path}: its card is incomplete ({error})") from error

    def add_to(self, path: str | os.PathLike[str]) -> None:
        """Put it into the archive that stable-baselines3 saved."""
        content = {"format": _FORMAT, "version": _VERSION, **asdict(self)}
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr(_CARD, json.dumps(content, indent=2))


def algorithm_class(name: str) -> Any:
    """stable-baselines3's class of an algorithm.

    Raises:
        InputError: an unknown name, or the extra `rl` is not installed.
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
    """What a file says of its model, and the model.

    Args:
        algorithm: that made it.
        path: the model file.
        task: one of `TASKS`.
        observation: the layout that is observed.

    Raises:
        InputError: a file that is no model, of another algorithm, another task or another observation.
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
    # A model that learns no more needs no memory, and hindsight none of an environment's goals.
    unneeded: dict[str, Any] = {"replay_buffer_class": None, "replay_buffer_kwargs": {}, "buffer_size": 1}
    kind = algorithm_class(algorithm)
    try:
        return card, kind.load(Path(path), device="cpu", custom_objects=unneeded)
    except Exception as error:  # whatever a damaged network makes torch stumble over
        raise InputError(f"{path}: its network cannot be read ({type(error).__name__}: {error})") from error


class LearnedAgent:
    """A trained model as an agent; it observes what `parkenv.envs.local_observation` says, on any lot.

    Args:
        problem: where it is to search.
        algorithm: that made it.
        path: the model file.

    Raises:
        InputError: a file that is no model, of another algorithm, another task or another observation.

    Attributes:
        card: what the file says of itself.
        local_k: how many slots the observation has to tell of.
    """

    def __init__(
        self, problem: Scenario | SearchProblem, algorithm: str, path: str | os.PathLike[str]
    ) -> None:
        self.name = f"{algorithm}:{path}"
        self.problem = problem.public() if isinstance(problem, Scenario) else problem
        self.card, self.model = load_model(algorithm, path, "search", OBSERVATION)
        self.local_k = self.card.k

    def predict(
        self,
        observation: Mapping[str, NDArray[Any]],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """stable-baselines3's interface, over `LocalObservation`.

        Raises:
            InputError: another observation, or nothing can be done, says the mask.
        """
        if "local" not in observation:
            raise InputError(
                f"{self.name} observes what parkenv.envs.local_observation.LocalObservation says, got "
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
