"""Checkpoints of a training: everything that decides how it continues, so a resumed training equals an unbroken one.

A checkpoint is a PyTorch file of tensors, numbers and text, read with `weights_only=True`, which runs no code.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch

from parkenv.errors import InputError
from parkenv.files.atomic_write import atomic_write

_FORMAT = "parkenv-checkpoint-1"
_LAST = ("_last_obs", "_last_episode_starts")
_COUNTERS = (
    "num_timesteps", "_total_timesteps", "_num_timesteps_at_start", "start_time", "_episode_num", "_n_updates",
    "_n_calls", "_current_progress_remaining", "exploration_rate",
)  # fmt: skip
"""Numbers of a model that change while it learns; all others are its settings."""
_ADAM = {"step", "exp_avg", "exp_avg_sq"}

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
        if not isinstance(n_envs := state["numbers"]["n_envs"], int):
            raise ValueError(f"n_envs is {n_envs!r:.40}")
        return state, _plain(state["curve"])
    except Exception as error:  # torch raises many types for damaged files
        raise InputError(
            f"{path}: no checkpoint of this version, or a damaged one ({error}); train again with --overwrite"
        ) from error


def restore(state: Mapping[str, Any], model: Any) -> None:
    """Bring a new model with the same settings, its environment and the random generators to a checkpoint.

    Types and shapes are checked. Values are not: where the searches stood is taken at its word.
    """
    try:
        first = {
            "_last_obs": model.env.reset(),
            "_last_episode_starts": np.ones(model.n_envs, dtype=np.bool_),
        }
        _require_like(state["last"], _tensors(first), "last observation")
        _require_like(state["env"], _tensors(model.env.get_state()), "environment")
        for name, value in _numbers(model).items():
            saved = state["numbers"][name]
            if saved != value and name not in _COUNTERS:
                raise ValueError(f"{name} was {saved!r:.40}, is {value!r}")
            setattr(model, name, type(value)(saved))
        options = _options(model)
        model.set_parameters(state["parameters"], device="cpu")
        if _options(model) != options:
            raise ValueError("the optimizers have other options")
        _require_sound_weights(model)
        for name, value in _arrays(state["last"]).items():
            setattr(model, name, value)
        if (memory := getattr(model, "_last_lstm_states", None)) is not None:
            _require_like(state["memory"], _tensors(memory), "memory")
            model._last_lstm_states = type(model._last_lstm_states)(*state["memory"])
        if getattr(model, "replay_buffer", None) is not None:
            _require_like(state["buffer"], _tensors(_transitions(model.replay_buffer)), "replay buffer")
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


def _require_like(saved: Any, own: Any, name: str) -> None:
    """Raise a ValueError if saved values have other names, types or shapes; lists of numbers may have any length."""
    if type(saved) is not type(own):
        raise ValueError(f"{name} is a {type(saved).__name__}, want a {type(own).__name__}")
    if isinstance(own, torch.Tensor) and (saved.shape, saved.dtype) != (own.shape, own.dtype):
        raise ValueError(f"{name} is {saved.dtype} {tuple(saved.shape)}, want {own.dtype} {tuple(own.shape)}")
    if isinstance(own, Mapping):
        if saved.keys() != own.keys():
            raise ValueError(f"{name} has {', '.join(map(str, saved))}, want {', '.join(map(str, own))}")
        for key in own:
            _require_like(saved[key], own[key], f"{name}: {key}")
    if isinstance(own, tuple):
        for i, (part, its) in enumerate(zip(saved, own, strict=False)):
            _require_like(part, its, f"{name}: {i}")


def _optimizers(model: Any) -> list[torch.optim.Optimizer]:
    parts = [attrgetter(name)(model) for name in model._get_torch_save_params()[0]]
    return [part for part in parts if isinstance(part, torch.optim.Optimizer)]


def _options(model: Any) -> list[Any]:
    """Return the options of the optimizers, without the learning rate, which is set anew for each update."""
    kept = {"params", "lr"}
    groups = [group for optimizer in _optimizers(model) for group in optimizer.param_groups]
    return [{key: value for key, value in group.items() if key not in kept} for group in groups]


def _require_sound_weights(model: Any) -> None:
    """Raise a ValueError if a weight is no number, or if an optimizer's averages do not fit its weights."""
    for values in model.get_parameters().values():
        if not all(v.isfinite().all() for v in values.values() if isinstance(v, torch.Tensor)):
            raise ValueError("a weight is no number")
    for optimizer in _optimizers(model):
        for weight, averages in optimizer.state.items():
            sound = averages.keys() == _ADAM and all(
                isinstance(v, torch.Tensor) and bool(v.isfinite().all()) for v in averages.values()
            )
            if not sound or averages["step"].shape or averages["step"] < 1:
                raise ValueError("an optimizer's averages are damaged")
            if any(averages[name].shape != weight.shape for name in _ADAM - {"step"}):
                raise ValueError("an optimizer's averages are of other weights")


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
