"""The network's weights: their file, and the network itself.

The file is a model file (see `planners.model_file`); it is read without PyTorch and the library of safetensors.
"""

import json
import math
import os
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, JsonValue

from parkenv.compiled.arrays import Float32Array
from parkenv.compiled.jit import compiled
from parkenv.errors import require
from parkenv.files.atomic_write import atomic_write
from parkenv.files.limited_reading import read_bytes
from parkenv.files.spec_file import Several, Spec
from parkenv.version import __version__
from planners.model_file import CARD_KEY, read_header
from planners.network.features import (
    ACTION_COUNT,
    ACTION_FEATURES,
    CANDIDATES,
    IS_SLOT,
    LOOKAHEAD,
    TOKEN_FEATURES,
    Features,
)

FORMAT = "parkenv-network-1"
SHIPPED = Path(__file__).with_name("models") / "network.safetensors"
_MAX_BYTES, _MAX_WEIGHT = 8_000_000, 1e4

LAYERS = "token_1", "token_2", "attention", "action_1", "action_2", "score_1", "score_2"


class NetworkCard(Spec):
    """Metadata of a file of weights: the model card."""

    format: Literal["parkenv-network-1"] = "parkenv-network-1"
    observation: Literal["network-1"] = "network-1"
    width: Annotated[int, Field(ge=1, le=256)] = Field(64, description="Units of a layer.")
    token_width: Annotated[int, Field(ge=1, le=256)] = Field(48, description="Units of a layer over tokens.")
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
        of_tokens = (TOKEN_FEATURES, t), (t, t), (t, 1)
        of_actions = (ACTION_FEATURES + 2 * t, w), (w, w), (3 * w, w), (w, 1)
        layers = dict(zip(LAYERS, of_tokens + of_actions, strict=True))
        return {f"{name}.weight": shape for name, shape in layers.items()} | {
            f"{name}.bias": shape[1:] for name, shape in layers.items()
        }

    def layout(self) -> dict[str, dict[str, Any]]:
        """Return the header of the weights, one behind the other."""
        entries, end = {}, 0
        for name, shape in self.shapes().items():
            begin, end = end, end + 4 * math.prod(shape)
            entries[name] = {"dtype": "F32", "shape": list(shape), "data_offsets": [begin, end]}
        return entries


Layer = tuple[Float32Array, Float32Array]  # weights, (n_inputs, n_outputs), and biases, (n_outputs,)


class NetworkPolicy(NamedTuple):
    """The network: its card, and its weights by name, float32."""

    card: NetworkCard
    weights: dict[str, Float32Array]

    @classmethod
    def load(cls, path: str | os.PathLike[str] = SHIPPED) -> Self:
        """Read a file of weights.

        Raises:
            InputError: the file is missing or damaged, or holds another network.
        """
        data = read_bytes(Path(path), _MAX_BYTES)
        content, tensors, body = read_header(data, path)
        require(
            content.get("format") == FORMAT,
            f"{path}: has no card of a network; want a file of weights of `network`",
        )
        card = NetworkCard.parse(content, f"{path}: card")
        layout = card.layout()
        require(
            tensors == layout and len(body) >= max(e["data_offsets"][1] for e in layout.values()),
            f"{path}: has not the weights of its card, {card.token_width} and {card.width} wide",
        )
        weights = {}
        for name, entry in layout.items():
            values = np.frombuffer(body[slice(*entry["data_offsets"])], "<f4").reshape(entry["shape"])
            require(
                (np.abs(values) <= _MAX_WEIGHT).all(),
                f"{path}: {name} has weights that are no numbers, or above {_MAX_WEIGHT:g}",
            )
            weights[name] = values.astype(np.float32)
        return cls(card, weights)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the file, atomically."""
        layout = self.card.layout()
        text = json.dumps({"__metadata__": {CARD_KEY: self.card.model_dump_json()}, **layout}).encode()
        text += b" " * (-len(text) % 8)
        with atomic_write(path) as beside:
            body = b"".join(np.ascontiguousarray(self.weights[name], "<f4").tobytes() for name in layout)
            beside.write_bytes(len(text).to_bytes(8, "little") + text + body)

    def scores(self, features: Features) -> Float32Array:
        """Score the actions, (..., 6): minus expected times, in time scales, up to a constant; -inf if not allowed.

        Args:
            features: the observation of a decision, or of many: arrays with further axes before theirs.
        """
        own, tokens = features.actions, features.tokens
        shape = features.allowed.shape
        scores = np.empty((int(np.prod(shape[:-1])), ACTION_COUNT), np.float32)
        _score(
            own.reshape(-1, *own.shape[-2:]),
            tokens.reshape(-1, *tokens.shape[-3:]),
            features.allowed.reshape(-1, ACTION_COUNT),
            tuple((self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]) for name in LAYERS),
            scores,
        )
        return scores.reshape(shape)


@compiled(error_model="numpy")
def _linear(x: Float32Array, layer: Layer, out: Float32Array) -> None:
    """Write the outputs, (n_outputs,), of a layer; sums are in the order of the inputs on every machine."""
    weight, bias = layer
    for j in range(len(out)):
        out[j] = bias[j]
    for k in range(len(x)):
        if x[k] != 0.0:  # as half of the inputs behind a ReLU
            for j in range(len(out)):
                out[j] += x[k] * weight[k, j]


@compiled(error_model="numpy")
def _rectified(x: Float32Array, layer: Layer, out: Float32Array) -> None:
    """Write the outputs of a layer followed by a ReLU."""
    _linear(x, layer, out)
    for j in range(len(out)):
        out[j] = max(out[j], np.float32(0.0))


@compiled(error_model="numpy")
def _score(
    actions: Float32Array,
    tokens: Float32Array,
    allowed: NDArray[np.bool_],
    layers: tuple[Layer, ...],
    scores: Float32Array,
) -> None:
    """Write the scores, (n, 6), of n decisions: outputs of the network minus the look-ahead's regret."""
    token_1, token_2, attention, action_1, action_2, score_1, score_2 = layers
    n_own, t, w = actions.shape[2], len(token_1[1]), len(action_1[1])
    hidden = np.empty((CANDIDATES, t), np.float32)
    weight, between = np.empty(CANDIDATES, np.float32), np.empty(max(t, w), np.float32)
    seen, of_action = np.empty(n_own + 2 * t, np.float32), np.empty((ACTION_COUNT, w), np.float32)
    of_all = np.empty(3 * w, np.float32)
    for i in range(len(scores)):
        of_all[:], n_allowed = 0.0, 0
        for a in range(ACTION_COUNT):
            if not allowed[i, a]:
                continue
            for c in range(CANDIDATES):
                _rectified(tokens[i, a, c], token_1, between[:t])
                _rectified(between[:t], token_2, hidden[c])
                _linear(hidden[c], attention, weight[c : c + 1])
                if tokens[i, a, c, IS_SLOT] == 0.0:
                    weight[c] -= np.float32(1e4)
            weight[:] = np.exp(weight - weight.max())
            weight /= weight.sum()
            seen[:n_own], seen[n_own:] = actions[i, a], 0.0
            for c in range(CANDIDATES):
                there = tokens[i, a, c, IS_SLOT] != 0.0
                for j in range(t):
                    seen[n_own + j] += weight[c] * hidden[c, j]
                    if there:
                        seen[n_own + t + j] = max(seen[n_own + t + j], hidden[c, j])
            _rectified(seen, action_1, between[:w])
            _rectified(between[:w], action_2, of_action[a])
            n_allowed += 1
            for j in range(w):
                of_all[w + j] += of_action[a, j]
                of_all[2 * w + j] = max(of_all[2 * w + j], of_action[a, j])
        of_all[w : 2 * w] /= np.float32(max(n_allowed, 1))
        for a in range(ACTION_COUNT):
            scores[i, a] = -np.inf
            if allowed[i, a]:
                of_all[:w] = of_action[a]
                _rectified(of_all, score_1, between[:w])
                _linear(between[:w], score_2, scores[i, a : a + 1])
                scores[i, a] -= actions[i, a, LOOKAHEAD]
