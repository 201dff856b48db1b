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

_FORMAT = "parkenv-checkpoint-1"
_LAST = ("_last_obs", "_last_episode_starts")

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
        "numbers": _numbers(model),
        "parameters": model.get_parameters(),
        "variables": {name: getattr(model, name).detach() for name in _variables(model)},
        "last": _tensors({name: getattr(model, name) for name in _LAST}),
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
    with atomic_write(path) as beside:
        torch.save(state, beside)


def read_checkpoint(path: Path) -> tuple[dict[str, Any], list[Row]]:
    """Read a checkpoint for `restore`, and its curve.

    Raises:
        InputError: the file is no checkpoint of this version, or a damaged one.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
                raise ValueError("it has compressed parts")
        state = torch.load(path, map_location="cpu", weights_only=True)
        if state["format"] != _FORMAT:
            raise ValueError(f"its format is {state['format']!r}, want {_FORMAT!r}")
        return state, _plain(state["curve"])
    except Exception as error:  # torch raises many types for damaged files
        raise InputError(
            f"{path}: no checkpoint of this version, or a damaged one ({error}); train again with --overwrite"
        ) from error


def restore(state: Mapping[str, Any], model: Any) -> None:
    """Bring a new model with the same settings, its environment and the random generators to a checkpoint.

    Raises:
        InputError: the checkpoint is of a training with other settings.
    """
    try:
        for name in _numbers(model):
            setattr(model, name, state["numbers"][name])
        model.set_parameters(state["parameters"], device="cpu")
        for name in _variables(model):
            getattr(model, name).data = state["variables"][name]
        for name, value in _arrays(state["last"]).items():
            setattr(model, name, value)
        if state["memory"] is not None:
            model._last_lstm_states = type(model._last_lstm_states)(*state["memory"])
        if state["buffer"] is not None:
            contents = _arrays(state["buffer"])
            for name in _transitions(model.replay_buffer):
                setattr(model.replay_buffer, name, contents[name])
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


def _numbers(model: Any) -> dict[str, Any]:
    """Return the counters and numeric settings of a model."""
    return {
        name: value.item() if isinstance(value, np.generic) else value
        for name, value in vars(model).items()
        if isinstance(value, (bool, int, float))
    }


def _variables(model: Any) -> list[str]:
    """Return the names of learned variables outside the networks, such as SAC's entropy coefficient."""
    return [name for name in model._get_torch_save_params()[1] if getattr(model, name) is not None]


def _transitions(buffer: Any) -> dict[str, Any]:
    """Return the transitions in a replay buffer and the position in it."""
    names = [
        name
        for name, value in vars(buffer).items()
        if name in ("pos", "full", "observations", "next_observations")
        or (isinstance(value, np.ndarray) and value.dtype != object)
    ]
    # Hindsight experience replay keeps `info`, of which only contacts are used.
    return {name: getattr(buffer, name) for name in names + ["contacts"] * hasattr(buffer, "contacts")}


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
