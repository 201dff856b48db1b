"""The network's weights: their file, and the network itself in NumPy.

The file is a model file as of `planners.model_file`; it is read without PyTorch and the library of safetensors.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, JsonValue

from parkenv import __version__
from parkenv.errors import InputError
from parkenv.files.atomic_write import atomic_write
from parkenv.files.limited_reading import read_bytes
from parkenv.files.spec_file import Several, Spec
from planners.model_header import CARD_KEY, read_header
from planners.network.features import (
    ACTION_FEATURES,
    BEST_KNOWN_FREE,
    DAY_SHIFT,
    DAY_SPREAD,
    EXPECTED_REGRET,
    IS_RETURN,
    IS_SLOT,
    KNOWN_FREE,
    KNOWN_FREE_REGRET,
    LAST_OBSERVED,
    LAST_VISIT,
    LOOKAHEAD,
    P_FREE_SPREAD,
    PATHS,
    SITUATION,
    SLOT_SHIFT,
    TOKEN_FEATURES,
    Features,
)

FORMAT = "parkenv-network-1"
SHIPPED = Path(__file__).with_name("models") / "network.safetensors"
_MAX_BYTES, _MAX_WEIGHT = 8_000_000, 1e4

Part = Literal["lookahead", "tokens", "day", "memory"]


class NetworkCard(Spec):
    """Metadata of a file of weights: the model card."""

    format: Literal["parkenv-network-1"] = "parkenv-network-1"
    observation: Literal["network-1"] = "network-1"
    width: Annotated[int, Field(ge=1, le=256)] = Field(64, description="Units of a layer.")
    token_width: Annotated[int, Field(ge=1, le=256)] = Field(48, description="Units of a layer over tokens.")
    without: Several[Part] = Field((), description="Parts left out, for comparisons.")
    trained_on: Several[str] = Field((), description="Places that it was trained on.")
    seed: int | None = Field(None, description="Of the training.")
    decisions: int = Field(0, ge=0, description="Decisions that it was trained on.")
    settings: dict[str, JsonValue] = Field({}, description="Of the training.")
    results: dict[str, float | None] = Field({}, description="Of the evaluation during training.")
    command: Several[str] = Field((), description="Command line of the training.")
    parkenv: str = __version__

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of every weight."""
        t, w = self.token_width, self.width
        layers = {
            "token_1": (TOKEN_FEATURES, t), "token_2": (t, t), "attention": (t, 1),
            "action_1": (ACTION_FEATURES + 2 * t, w), "action_2": (w, w),
            "score_1": (3 * w, w), "score_2": (w, 1),
        }  # fmt: skip
        return {f"{name}.weight": shape for name, shape in layers.items()} | {
            f"{name}.bias": shape[1:] for name, shape in layers.items()
        }


def feature_masks(without: tuple[Part, ...]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return factors of the features of actions, (ACTION_FEATURES,), and of tokens: 0 for parts left out."""
    actions, tokens = np.ones(ACTION_FEATURES, np.float32), np.ones(TOKEN_FEATURES, np.float32)
    if "lookahead" in without:
        actions[[LOOKAHEAD, KNOWN_FREE, KNOWN_FREE_REGRET, BEST_KNOWN_FREE]] = 0.0
        actions[PATHS:SITUATION] = tokens[EXPECTED_REGRET] = 0.0
    if "tokens" in without:
        tokens[:] = 0.0
    if "day" in without:
        actions[[DAY_SHIFT, DAY_SPREAD]] = tokens[[P_FREE_SPREAD, SLOT_SHIFT]] = 0.0
    if "memory" in without:
        actions[[IS_RETURN, LAST_VISIT]] = tokens[LAST_OBSERVED] = 0.0
    return actions, tokens


class NetworkPolicy(NamedTuple):
    """The network: its card, and its weights by name, float32."""

    card: NetworkCard
    weights: dict[str, NDArray[np.float32]]

    @classmethod
    def load(cls, path: str | os.PathLike[str] = SHIPPED) -> Self:
        """Read a file of weights.

        Raises:
            InputError: the file is missing or damaged, or holds another network.
        """
        data = read_bytes(Path(path), _MAX_BYTES)
        header = read_header(data, path)
        if header.card.get("format") != FORMAT:
            raise InputError(f"{path}: has no card of a network; want a file of `parkenv train network`")
        card = NetworkCard.parse(header.card, f"{path}: card")
        weights = {}
        for name, shape in card.shapes().items():
            begin, end = _offsets(header.tensors.get(name), name, shape, len(header.body), path)
            values = np.frombuffer(header.body[begin:end], "<f4").reshape(shape)
            if not (np.abs(values) <= _MAX_WEIGHT).all():
                raise InputError(f"{path}: {name} has weights that are no numbers, or above {_MAX_WEIGHT:g}")
            weights[name] = values.astype(np.float32)
        return cls(card, weights)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the file, atomically."""
        header: dict[str, object] = {"__metadata__": {CARD_KEY: self.card.model_dump_json()}}
        at = 0
        for name, values in self.weights.items():
            header[name] = {"dtype": "F32", "shape": values.shape, "data_offsets": [at, at + values.nbytes]}
            at += values.nbytes
        text = json.dumps(header).encode()
        text += b" " * (-len(text) % 8)
        with atomic_write(path) as beside:
            body = b"".join(np.ascontiguousarray(v, "<f4").tobytes() for v in self.weights.values())
            beside.write_bytes(len(text).to_bytes(8, "little") + text + body)

    def scores(self, features: Features) -> NDArray[np.float32]:
        """Score the actions, (..., 6): minus expected times, in time scales, up to a constant; -inf if not allowed.

        Args:
            features: the observation of a decision, or of many: arrays with further axes before theirs.
        """
        w, without = self.weights, self.card.without
        own, tokens = features.actions, features.tokens
        if without:
            of_actions, of_tokens = feature_masks(without)
            own, tokens = own * of_actions, tokens * of_tokens
        h = np.maximum(tokens @ w["token_1.weight"] + w["token_1.bias"], 0.0)
        h = np.maximum(h @ w["token_2.weight"] + w["token_2.bias"], 0.0)
        absent = tokens[..., IS_SLOT, None] == 0.0
        attention = h @ w["attention.weight"] + w["attention.bias"] - 1e4 * absent
        attention = np.exp(attention - attention.max(axis=-2, keepdims=True))
        attention /= attention.sum(axis=-2, keepdims=True)
        pooled = (attention * h).sum(axis=-2), (h * ~absent).max(axis=-2)
        x = np.concatenate([own, *pooled], axis=-1)
        x = np.maximum(x @ w["action_1.weight"] + w["action_1.bias"], 0.0)
        x = np.maximum(x @ w["action_2.weight"] + w["action_2.bias"], 0.0)
        there = features.allowed[..., None]
        x = x * there
        mean = x.sum(axis=-2, keepdims=True) / np.maximum(there.sum(axis=-2, keepdims=True), 1)
        most = x.max(axis=-2, keepdims=True)
        x = np.concatenate([x, *np.broadcast_arrays(mean, most, x)[:2]], axis=-1)
        x = np.maximum(x @ w["score_1.weight"] + w["score_1.bias"], 0.0)
        score = (x @ w["score_2.weight"] + w["score_2.bias"])[..., 0]
        if "lookahead" not in without:
            score = score - features.actions[..., LOOKAHEAD]
        return np.where(features.allowed, score, -np.inf).astype(np.float32)


def _offsets(
    entry: object, name: str, shape: tuple[int, ...], size: int, path: str | os.PathLike[str]
) -> tuple[int, int]:
    """Return where the bytes of a weight begin and end."""
    if isinstance(entry, dict) and entry.get("dtype") == "F32" and entry.get("shape") == list(shape):
        offsets = entry.get("data_offsets")
        if isinstance(offsets, list) and len(offsets) == 2 and all(type(o) is int for o in offsets):
            begin, end = offsets
            if begin >= 0 and end == begin + 4 * int(np.prod(shape)) and end <= size:
                return begin, end
    raise InputError(f"{path}: has no weights {name!r} of shape {shape}, float32")
