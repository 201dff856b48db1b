"""Checkpoints of a training: everything that decides how it continues, so a resumed training equals an unbroken one.

A checkpoint is a PyTorch file of tensors, numbers and text, read with `weights_only=True`, which runs no code.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from parkenv.errors import InputError
from parkenv.files.atomic_write import atomic_write

_FORMAT = "parkenv-checkpoint-2"
_LAST = ("_last_obs", "_last_episode_starts")
_COUNTERS = (
    "num_timesteps", "_total_timesteps", "_num_timesteps_at_start", "start_time", "_episode_num", "_n_updates",
    "_n_calls", "_current_progress_remaining", "exploration_rate",
)  # fmt: skip
"""Numbers of a model that change while it learns; all others are its settings."""

Row = dict[str, Any]


def save_checkpoint(path: Path, model: Any, curve: list[Row]) -> None:
    """Write the state of a model between two rollouts, of its environment and of the random generators.

    Args:
        path: file to write, atomically.
        model: of stable-baselines3 or sb3-contrib; its environment has `get_state` and `set_state`.
        curve: evaluations so far.
    """
    buffer = getattr(model, "replay_buffer", None)
    state = {
        "format": _FORMAT,
        "curve": _plain(curve),
        "n_envs": model.n_envs,
        "counters": _counters(model),
        "parameters": model.get_parameters(),
        "last": _tensors([getattr(model, name) for name in _LAST]),
        "memory": _tensors(getattr(model, "_last_lstm_states", None)),
        "buffer": None if buffer is None else _tensors(_transitions(buffer)),
        "env": _tensors(model.env.get_state()),
        "random": _tensors(
            (
                model.action_space.np_random.bit_generator.state,
                np.random.get_state(legacy=False),  # noqa: NPY002 - stable-baselines3 draws from it
                torch.get_rng_state(),
            )
        ),
    }
    with atomic_write(path) as beside, beside.open("wb", buffering=0) as file:
        try:
            torch.save(state, file)
        except RuntimeError as error:
            # PyTorch raises its own error after that of a full disk.
            raise error.__context__ or error from None


def read_checkpoint(path: Path) -> tuple[dict[str, Any], list[Row]]:
    """Read a checkpoint for `restore`, and its curve."""
    try:
        with zipfile.ZipFile(path) as archive:
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
                raise ValueError("it has compressed parts")
            if damaged := archive.testzip():
                raise ValueError(f"{damaged} is not as it was written")
        state = torch.load(path, map_location="cpu", weights_only=True)
        if state["format"] != _FORMAT:
            raise ValueError(f"its format is {state['format']!r}, want {_FORMAT!r}")
        if not isinstance(n_envs := state["n_envs"], int):
            raise ValueError(f"n_envs is {n_envs!r:.40}")
        return state, _plain(state["curve"])
    except Exception as error:  # torch raises many types for damaged files
        raise InputError(
            f"{path}: no checkpoint of this version, or a damaged one ({error}); train again with --overwrite"
        ) from error


def restore(state: Mapping[str, Any], model: Any) -> None:
    """Bring a new model with the same settings, its environment and the random generators to a checkpoint."""
    try:
        for name, value in _counters(model).items():
            setattr(model, name, type(value)(state["counters"][name]))
        model.set_parameters(state["parameters"], device="cpu")
        for name, value in zip(_LAST, _arrays(state["last"]), strict=True):
            setattr(model, name, value)
        if (memory := getattr(model, "_last_lstm_states", None)) is not None:
            model._last_lstm_states = type(memory)(*state["memory"])
        if (buffer := getattr(model, "replay_buffer", None)) is not None:
            contents = _arrays(state["buffer"])
            for name in _transitions(buffer):
                setattr(buffer, name, contents[name])
        model.env.set_state(_arrays(state["env"]))
        actions, draws, _ = _arrays(state["random"])
        model.action_space.np_random.bit_generator.state = actions
        np.random.set_state(draws)  # noqa: NPY002
        torch.set_rng_state(state["random"][2])
    except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        raise InputError(
            f"the checkpoint does not fit this training ({error}); train again with --overwrite"
        ) from error


def _plain(curve: list[Row]) -> list[Row]:
    """Return evaluations with Python's numbers, each with its `steps`."""
    return [
        {"steps": int(row["steps"])} | {name: float(row[name]) for name in row if name != "steps"}
        for row in curve
    ]


def _counters(model: Any) -> dict[str, Any]:
    numbers = {name: getattr(model, name) for name in _COUNTERS if hasattr(model, name)}
    return {
        name: value.item() if isinstance(value, np.generic) else value
        for name, value in numbers.items()
        if value is not None
    }


def _transitions(buffer: Any) -> dict[str, Any]:
    """Return the transitions in a replay buffer and the position in it."""
    names = [
        name
        for name, value in vars(buffer).items()
        if name in ("pos", "full", "observations", "next_observations")
        or (isinstance(value, np.ndarray) and value.dtype != object)
    ]
    return {name: getattr(buffer, name) for name in names}


def _tensors(tree: Any) -> Any:
    """Replace arrays in mappings and sequences by tensors, which a checkpoint can hold."""
    if isinstance(tree, np.ndarray):
        return torch.from_numpy(np.ascontiguousarray(tree))
    if isinstance(tree, Mapping):
        return {key: _tensors(value) for key, value in tree.items()}
    return tuple(map(_tensors, tree)) if isinstance(tree, (list, tuple)) else tree


def _arrays(tree: Any) -> Any:
    """Reverse `_tensors`."""
    if isinstance(tree, torch.Tensor):
        return tree.numpy()
    if isinstance(tree, Mapping):
        return {key: _arrays(value) for key, value in tree.items()}
    return tuple(map(_arrays, tree)) if isinstance(tree, tuple) else tree
