"""Model files: a policy's weights and its card in one safetensors file, which runs no code when it is opened.

The file begins with the length of the header, 8 bytes, little-endian, and the header, JSON; the tensors follow. The
card is JSON in the header's metadata. It holds what is needed to build the policy again, and what the model was trained
on. Archives that stable-baselines3 writes itself hold pickled Python objects, which run code.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, JsonValue, model_validator
from pydantic_core import to_jsonable_python

from parkenv.engine.local_observation import FIRST_NEAR, PER_NEAR, local_space
from parkenv.errors import InputError, require, with_extra
from parkenv.files.atomic_write import atomic_write
from parkenv.files.limited_reading import parse_json, read_bytes
from parkenv.files.spec_file import Several, Spec
from parkenv.version import __version__
from parkenv.world.lot import ACTIONS
from parkenv.world.scenario import SearchProblem
from planners.names import ALGORITHMS

CARD_KEY = "parkenv"  # key of the card in the metadata
_MAX_HEADER = 1_000_000
# Version of the layout of `parkenv.engine.local_observation`, which search models observe.
OBSERVATION = "local-1"
_MAX_BYTES = 500_000_000
_MAX_WEIGHT = 1e6  # products of larger ones over several layers could overflow
_ZIP = b"PK"
_NORMALIZATION = "normalization"
_TRANSFORMING = (gym.ObservationWrapper, gym.ActionWrapper)

# Bounds, so that a card cannot ask for more memory than a network of a few million weights needs.
Width = Annotated[int, Field(ge=1, le=1024)]
Layers = Annotated[Several[Width], Field(max_length=8)]


def read_header(
    data: bytes, path: str | os.PathLike[str]
) -> tuple[dict[str, Any], dict[str, Any], memoryview]:
    """Return the card and the entries of the tensors, neither validated, and the bytes behind."""
    size = int.from_bytes(data[:8], "little")
    require(
        data[8:9] == b"{" and size <= min(_MAX_HEADER, len(data) - 8),
        f"{path}: no model file, or a damaged one",
    )
    header = parse_json(data[8 : 8 + size], f"{path}: header")
    metadata = header.pop("__metadata__", None)
    text: Any = metadata.get(CARD_KEY) if isinstance(metadata, dict) else None
    require(isinstance(text, str), f"{path}: no model of `parkenv train`: it has no card")
    card = parse_json(text, f"{path}: card")
    require(isinstance(card, dict), f"{path}: card is a {type(card).__name__}, want a JSON object")
    return card, header, memoryview(data)[8 + size :]


class _WithNulls(Spec):
    """Content of a card, in which null is as good as absent."""

    @model_validator(mode="before")
    @classmethod
    def _without_nulls(cls, tables: Any) -> Any:
        if not isinstance(tables, Mapping):
            return tables
        return {name: value for name, value in tables.items() if value is not None}


class PolicyOptions(_WithNulls):
    """Arguments of stable-baselines3's policies that a model file can hold; classes go by their names."""

    net_arch: Layers | dict[Literal["pi", "vf"], Layers] | None = None
    activation_fn: Literal["Tanh", "ReLU", "ELU", "GELU", "SiLU", "LeakyReLU"] | None = None
    ortho_init: bool | None = None
    lstm_hidden_size: Width | None = None
    n_lstm_layers: Annotated[int, Field(ge=1, le=4)] | None = None
    shared_lstm: bool | None = None
    enable_critic_lstm: bool | None = None

    def arguments(self) -> dict[str, Any]:
        import torch

        given = self.model_dump(exclude_none=True)
        if self.activation_fn is not None:
            given["activation_fn"] = getattr(torch.nn, self.activation_fn)
        if isinstance(self.net_arch, tuple):
            given["net_arch"] = list(self.net_arch)
        return given


class ModelCard(_WithNulls):
    """Metadata of a model file."""

    model_config = ConfigDict(extra="ignore")  # earlier cards held the spaces, which follow from k

    format: Literal["parkenv-model-2"] = "parkenv-model-2"
    algorithm: Literal["dqn", "ppo", "maskable-ppo", "recurrent-ppo"]
    task: Literal["search"] = "search"
    observation: str = Field(description="Version of the observation's layout.")
    k: int = Field(ge=1, le=1_000, description="Slots in the observation.")
    policy: Literal["MultiInputPolicy", "MultiInputLstmPolicy"]
    policy_options: PolicyOptions
    scenarios: Several[str] = Field((), description="Trained on.")
    held_out: Several[str] = Field((), description="Places never trained on, which it was evaluated in.")
    seed: int | None = Field(None, description="Of the training.")
    steps: int = Field(0, ge=0, description="Decisions of the training.")
    settings: dict[str, JsonValue] = Field({}, description="Of the algorithm.")
    results: dict[str, float | None] = Field({}, description="Of the evaluation during training.")
    command: Several[str] = Field((), description="Command line of the training.")
    parkenv: str = __version__

    @classmethod
    def of_file(cls, path: str | os.PathLike[str]) -> Self:
        """Read the card of a model file.

        Raises:
            InputError: the file is missing or damaged, is a pickled archive, or has no card of this version.
        """
        return cls._of_bytes(read_bytes(Path(path), _MAX_BYTES), path)

    @classmethod
    def _of_bytes(cls, data: bytes, path: str | os.PathLike[str]) -> Self:
        require(
            not data.startswith(_ZIP),
            f"{path}: is an archive of pickled objects, which run code when they are loaded; if you trust its "
            f"author, load it with stable-baselines3 and write it by planners.model_file.save_model",
        )
        return cls.parse(read_header(data, path)[0], f"{path}: card")

    def build(self) -> Any:
        """Build the policy, with random weights."""
        from torch.random import fork_rng

        kind = algorithm_class(self.algorithm).policy_aliases[self.policy]
        actions = spaces.Discrete(len(ACTIONS))
        with fork_rng(devices=[]):  # the weights are replaced
            return kind(local_space(self.k), actions, lambda _: 0.0, **self.policy_options.arguments())


def algorithm_class(name: str) -> Any:
    require(name in ALGORITHMS, f"unknown algorithm {name!r}; known: {', '.join(ALGORITHMS)}")
    module, class_name = ALGORITHMS[name]
    with with_extra(name, "rl"):
        return getattr(import_module(module), class_name)


def save_model(
    model: Any,
    path: str | os.PathLike[str],
    *,
    scenarios: Sequence[str] = (),
    held_out: Sequence[str] = (),
    settings: Mapping[str, Any] | None = None,
    results: Mapping[str, float] | None = None,
    command: Sequence[str] = (),
) -> None:
    """Write a model of stable-baselines3 or sb3-contrib to a model file, atomically.

    Args:
        model: trained on `parkenv.envs.sb3.SearchVecEnv`, or another environment of the `local` observation. The
            statistics of `VecNormalize` around it are saved; other wrappers that change observations are refused.
        path: file to write; its name should end in `.safetensors`.
        scenarios: names of the training scenarios.
        held_out: names of the places that it was evaluated in, and never trained on.
        settings: settings of the algorithm, for the card.
        results: results of an evaluation, for the card.
        command: command line of the training, for the card.

    Raises:
        InputError: the model is of another algorithm or observation, or its policy has an option, or its environment
            a wrapper, that a model file cannot hold.
    """
    from safetensors.torch import save

    name = type(model).__name__
    algorithm = next((key for key, (_, class_name) in ALGORITHMS.items() if class_name == name), None)
    require(algorithm is not None, f"the model is a {name}, want one of {', '.join(ALGORITHMS)}")
    aliases = {kind: alias for alias, kind in type(model).policy_aliases.items()}
    options = {
        key: value.__name__ if isinstance(value, type) else value
        for key, value in (model.policy_kwargs or {}).items()
        if not key.startswith("optimizer_")
    }
    numbers = {key: None if value != value else float(value) for key, value in (results or {}).items()}
    card = ModelCard.parse(
        {
            "algorithm": algorithm, "observation": OBSERVATION, "k": slots_observed(model.observation_space),
            "policy": aliases.get(model.policy_class, model.policy_class.__name__), "policy_options": options,
            "scenarios": tuple(scenarios), "held_out": tuple(held_out), "seed": model.seed,
            "steps": model.num_timesteps, "settings": to_jsonable_python(dict(settings or {})),
            "results": numbers, "command": tuple(command),
        },
        "model",
    )  # fmt: skip
    # Networks may share tensors; safetensors wants each on its own.
    weights = {key: value.detach().cpu().clone() for key, value in model.policy.state_dict().items()}
    weights |= Normalization.of_model(model).tensors
    with atomic_write(path) as beside:
        beside.write_bytes(save(weights, {CARD_KEY: card.model_dump_json()}))


def slots_observed(space: spaces.Space[Any]) -> int:
    shape = space["local"].shape if isinstance(space, spaces.Dict) and "local" in space.spaces else None
    k = (shape[0] - FIRST_NEAR) // PER_NEAR if shape else 0
    require(k >= 1 and space == local_space(k), "the model does not observe `local`")
    return k


def load_model(algorithm: str, path: str | os.PathLike[str]) -> tuple[ModelCard, Any, Normalization]:
    """Load card, policy and normalization of a model trained with an algorithm; no code from the file is run."""
    data = read_bytes(Path(path), _MAX_BYTES)
    card = ModelCard._of_bytes(data, path)
    require(card.algorithm == algorithm, f"{path}: is a model of {card.algorithm}, not of {algorithm}")
    require(
        card.observation == OBSERVATION,
        f"{path}: observes {card.observation!r}, parkenv {card.parkenv}'s; want {OBSERVATION!r}",
    )
    try:
        policy = card.build()
        weights = import_module("safetensors.torch").load(data)
        require(
            all(bool((w.abs() <= _MAX_WEIGHT).all()) for w in weights.values()),
            f"{path}: has weights that are no numbers, or above {_MAX_WEIGHT:g}",
        )
        normalization = Normalization.take_from(weights, policy.observation_space)
        policy.load_state_dict(weights)
    except InputError:
        raise
    except Exception as error:  # torch and stable-baselines3 raise many types for weights that do not fit
        raise InputError(f"{path}: its network cannot be read ({type(error).__name__}: {error})") from error
    policy.set_training_mode(False)
    return card, policy, normalization


class Normalization:
    """Statistics by which `VecNormalize` of stable-baselines3 shifts and scales what a model observes.

    They are tensors of the model file: `normalization.KEY`, (2, n) float64, mean and variance of each number, and
    `normalization`, epsilon and the bound of the results.
    """

    def __init__(self, tensors: Mapping[str, Any]) -> None:
        self.tensors = tensors

    @classmethod
    def of_model(cls, model: Any) -> Self:
        """Return what the model's environment does to observations.

        Raises:
            InputError: it does something that a model file cannot hold, such as stacking frames.
        """
        from stable_baselines3.common.vec_env import VecCheckNan, VecEnvWrapper, VecMonitor, VecNormalize
        from stable_baselines3.common.vec_env import VecVideoRecorder as VecVideo

        env, tensors = model.get_env(), dict[str, Any]()
        if env is None:
            told = "the model has no environment: statistics of VecNormalize, if it was trained with any, are not saved"
            warnings.warn(told, stacklevel=3)
        while isinstance(env, VecEnvWrapper):
            name = type(env).__name__
            if type(env) is VecNormalize and not tensors:
                tensors = cls._statistics(env)
            elif not isinstance(env, (VecCheckNan, VecMonitor, VecVideo)):
                raise InputError(
                    f"the model's environment is wrapped in {name}, which a model file cannot hold"
                )
            env = env.venv
        require(
            env is None or not any(any(env.env_is_wrapped(kind)) for kind in _TRANSFORMING),
            "the model's environment has a wrapper of observations or actions, want none",
        )
        return cls(tensors)

    @staticmethod
    def _statistics(env: Any) -> dict[str, Any]:
        import torch

        if not env.norm_obs:
            return {}
        moments = {f"{_NORMALIZATION}.{key}": env.obs_rms[key] for key in env.norm_obs_keys}
        tensors = {key: torch.as_tensor(np.stack([m.mean, m.var])).double() for key, m in moments.items()}
        bounds = [env.epsilon, min(env.clip_obs, _MAX_WEIGHT)]
        return tensors | {_NORMALIZATION: torch.tensor(bounds, dtype=torch.float64)}

    @classmethod
    def take_from(cls, tensors: dict[str, Any], space: spaces.Dict) -> Self:
        """Remove the statistics from the tensors of a model file; a ValueError says why they do not fit."""
        names = [key for key in tensors if key.split(".")[0] == _NORMALIZATION]
        given = {name: tensors.pop(name).double().numpy() for name in names}
        shapes = {_NORMALIZATION: (2,)} | {
            f"{_NORMALIZATION}.{key}": (2, *(box.shape or ())) for key, box in space.items()
        }
        for name, values in given.items():
            if values.shape != shapes.get(name) or (values[1] < 0.0).any() or _NORMALIZATION not in given:
                raise ValueError(f"{name} is no {shapes.get(name)} array of statistics")
        if given and given[_NORMALIZATION][0] <= 0.0:
            raise ValueError("epsilon is not above 0")
        return cls(given)

    def __call__(self, observation: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Return the observation as the model observed it in training; rounded as `VecNormalize` does."""
        seen = dict(observation)
        for name, statistics in self.tensors.items():
            if name == _NORMALIZATION:
                continue
            (epsilon, bound), (mean, variance) = self.tensors[_NORMALIZATION], statistics
            key = name.partition(".")[2]
            scaled = (seen[key] - mean) / np.sqrt(variance + epsilon)
            seen[key] = np.clip(scaled, -bound, bound).astype(np.float32)
        return seen


class LearnedAgent:
    """A trained model as an agent, on `parkenv.engine.local_observation` of `local_k` slots."""

    def __init__(self, problem: SearchProblem, algorithm: str, path: str | os.PathLike[str]) -> None:
        self.name = f"{algorithm}:{path}"
        self.problem = problem.public()
        self.card, self.model, self.normalization = load_model(algorithm, path)
        lots = self.card.scenarios
        if lots and not {problem.lot.name, getattr(problem, "name", "")} & {*lots, *self.card.held_out}:
            named = ", ".join(lots[:3]) + (f" and {len(lots) - 3} more" if len(lots) > 3 else "")
            warnings.warn(f"{path}: was trained on {named}, not on {problem.lot.name}", stacklevel=2)
        self.local_k = self.card.k

    def predict(
        self,
        observation: Mapping[str, NDArray[Any]],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """Choose an action for an observation of `LocalObservation`, as stable-baselines3 does."""
        require(
            "local" in observation,
            f'{self.name} wants observations of an environment with observation="local", '
            f"got {', '.join(observation)}",
        )
        given, wanted = observation["local"].shape[-1:], self.model.observation_space["local"].shape
        require(
            given == wanted,
            f"{self.name} observes {wanted[0]} numbers, got {given[0]} for its k = {self.card.k}",
        )
        # At a dead end there is no action, and whatever is chosen waits.
        mask = observation["action_mask"] | ~np.any(observation["action_mask"], axis=-1, keepdims=True)
        masks = {"action_masks": mask} if self.card.algorithm == "maskable-ppo" else {}
        action, state = self.model.predict(
            self.normalization(observation), state=state, episode_start=episode_start, deterministic=deterministic,
            **masks,
        )  # fmt: skip
        return action, state
