"""A trained policy network as a compiled policy of a fleet."""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.memory import (
    ADDRESS,
    float32_array,
    float32s,
    float64_array,
    int16_array,
    int32_array,
    int64_array,
    int64s,
    record_at,
)
from parkenv.engine.local_observation import (
    FIRST_NEAR,
    N_MOVES,
    PER_NEAR,
    SAMPLES,
    Surroundings,
    observe_surroundings,
)
from parkenv.engine.policy import (
    CompiledPolicy,
    PolicyData,
    car_of,
    draw_uniform,
    is_allowed,
    policy_data,
    search_of,
)
from parkenv.engine.records import N_ACTIONS, N_REGIONS
from parkenv.errors import InputError, require_one_of
from parkenv.world.occupancy.kernel import inlined, kernel
from parkenv.world.scenario import SearchProblem

# Weights, (n_outputs, n_inputs), and biases, (n_outputs,), of a layer, as in PyTorch.
Layer = tuple[NDArray[np.float32], NDArray[np.float32]]
ACTIVATIONS = ("tanh", "relu")
TANH, RELU = range(2)

# Addresses of the arrays of `Surroundings`, and their lengths.
SURROUNDINGS = np.dtype(
    [
        *((name, ADDRESS) for name in Surroundings._fields),
        *((name, np.int64) for name in ("n_lots", "n_vertices", "n_numbers", "n_indices", "k")),
    ],
    align=True,
)  # fmt: skip

# A policy network that observes `local` and `action_mask`.
NETWORK = np.dtype(
    [
        # The SURROUNDINGS record, and room for an observation, (width,) float32.
        ("surroundings", ADDRESS),
        ("local", ADDRESS),
        # (n_layers + 1,) int64, widths from the inputs to the outputs; float32: for each layer the weights,
        # (n_inputs, n_outputs), then the biases; room for two layers.
        ("n_layers", np.int64),
        ("widths", ADDRESS),
        ("weights", ADDRESS),
        ("values", ADDRESS),
        ("widest", np.int64),
        # Activation of the hidden layers; whether actions that the graph does not have are left out; whether actions
        # are drawn from the policy, instead of taking the most probable one.
        ("activation", np.int64),
        ("masked", np.bool_),
        ("sampled", np.bool_),
    ],
    align=True,
)

surroundings_at, network_at = record_at(SURROUNDINGS), record_at(NETWORK)


@kernel
def decide_by_network(address: int, number: int) -> int:
    car = car_of(address, number)
    search, network = search_of(car.search), network_at(policy_data(address, car), 0)
    around = _surroundings_of(network)
    width = FIRST_NEAR + PER_NEAR * surroundings_at(network.surroundings, 0).k
    observe_surroundings(search, around, float32_array(network.local, (width,)))
    return int(_choose(network, search, _logits(network, search)))


@inlined
def _surroundings_of(network: Any) -> Surroundings:
    around = surroundings_at(network.surroundings, 0)
    n_lots, n = around.n_lots, around.n_vertices
    # The lengths of flat arrays do not matter to compiled code, but for that of the last.
    return Surroundings(
        int64_array(around.first, (n_lots,)),
        float32_array(around.numbers, (n, around.n_numbers)),
        int16_array(around.indices, (n, around.n_indices)),
        int32_array(around.targets, (n, N_MOVES)),
        int32_array(around.starts, (n + 1,)),
        int32_array(around.slots, (n,)),
        float64_array(around.crow_s, (n, 2)),
        int32_array(around.samples, (n_lots, N_REGIONS, SAMPLES)),
        int64_array(around.first_view, (n_lots,)),
        float32_array(around.view_s, (n,)),
        int32_array(around.columns, ((N_MOVES + 1) * around.k,)),
    )


@inlined
def _logits(network: Any, search: Any) -> int:
    """Return the address of the network's output, (5,) float32, for the observation in `local`."""
    widths = int64s(network.widths)
    local, values = float32s(network.local), float32s(network.values)
    # The inputs are in alphabetical order: `action_mask`, then `local`.
    for action in range(N_ACTIONS):
        values[action] = is_allowed(search, action)
    for i in range(widths[0] - N_ACTIONS):
        values[N_ACTIONS + i] = local[i]
    at, before = network.weights, network.values
    for layer in range(network.n_layers):
        after = network.values + 4 * network.widest * ((layer + 1) & 1)
        n_inputs, n_outputs = widths[layer], widths[layer + 1]
        _apply_layer(at, before, after, n_inputs, n_outputs)
        if layer < network.n_layers - 1:
            _activate(after, n_outputs, network.activation)
        at += 4 * (n_inputs + 1) * n_outputs
        before = after
    return int(before)


@kernel
def _apply_layer(weights_at: int, inputs_at: int, outputs_at: int, n_inputs: int, n_outputs: int) -> None:
    weights = float32_array(weights_at, (n_inputs + 1, n_outputs))
    inputs = float32_array(inputs_at, (n_inputs,))
    outputs = float32_array(outputs_at, (n_outputs,))
    for j in range(n_outputs):
        outputs[j] = weights[n_inputs, j]
    for i in range(n_inputs):
        value = inputs[i]
        if value != np.float32(0.0):
            for j in range(n_outputs):
                outputs[j] += value * weights[i, j]


@kernel
def _activate(values_at: int, n: int, activation: int) -> None:
    values = float32s(values_at)
    for j in range(n):
        values[j] = math.tanh(values[j]) if activation == TANH else max(values[j], np.float32(0.0))


@inlined
def _choose(network: Any, search: Any, logits_at: int) -> int:
    logits = float32s(logits_at)
    best, highest, total = -1, -np.inf, 0.0
    for action in range(N_ACTIONS):
        if network.masked and not is_allowed(search, action):
            logits[action] = -np.inf
        if logits[action] > highest:
            best, highest = action, logits[action]
    if not network.sampled:
        return best
    for action in range(N_ACTIONS):
        total += math.exp(logits[action] - highest)
    left = draw_uniform(search) * total
    for action in range(N_ACTIONS):
        left -= math.exp(logits[action] - highest)
        if left < 0.0:
            return action
    return best


def compiled_network(
    layers: Sequence[Layer],
    k: int = 5,
    *,
    activation: str = "tanh",
    masked: bool = True,
    sampled: bool = False,
    name: str = "network",
) -> CompiledPolicy:
    """Make a policy network, a multilayer perceptron on the `local` observation, a compiled policy of a fleet.

    Args:
        layers: weights and biases from the inputs, `action_mask` and `local`, to logits, or values, of the actions.
        k: number of slots in the observation.
        activation: of the hidden layers, `tanh` or `relu`.
        masked: whether actions that the graph does not have are left out.
        sampled: whether to draw actions from the policy, instead of taking the most probable one.
        name: for tables.
    """
    require_one_of("activation", activation, ACTIVATIONS)
    shapes = [weights.shape for weights, _ in layers]
    widths = [shapes[0][1], *(shape[0] for shape in shapes)] if shapes else [0]
    wanted = N_ACTIONS + FIRST_NEAR + PER_NEAR * k
    if (widths[0], widths[-1]) != (wanted, N_ACTIONS) or shapes != [(b, a) for a, b in pairwise(widths)]:
        raise InputError(f"layers have shapes {shapes}, want a chain from {wanted} numbers to {N_ACTIONS}")
    flat = [part for weights, biases in layers for part in (weights.T.ravel(), biases)]
    arrays: dict[str, NDArray[Any]] = {
        "widths": np.array(widths, np.int64),
        "weights": np.concatenate(flat).astype(np.float32),
        "values": np.zeros(2 * max(widths), np.float32),
    }
    numbers = {
        "n_layers": len(layers), "widest": max(widths), "activation": ACTIVATIONS.index(activation),
        "masked": masked, "sampled": sampled,
    }  # fmt: skip
    return CompiledPolicy(name, decide_by_network, partial(_tables, k, numbers, arrays))


def _tables(
    k: int, numbers: Mapping[str, int], arrays: Mapping[str, NDArray[Any]], problems: Sequence[SearchProblem]
) -> PolicyData:
    around = Surroundings.of(problems, k)
    lengths = {
        "n_lots": len(around.first), "n_vertices": len(around.numbers), "n_numbers": around.numbers.shape[1],
        "n_indices": around.indices.shape[1], "k": k,
    }  # fmt: skip
    contiguous = {name: np.ascontiguousarray(array) for name, array in around._asdict().items()}
    tables = PolicyData(SURROUNDINGS, lengths, contiguous)
    local = np.zeros(FIRST_NEAR + PER_NEAR * k, np.float32)
    return PolicyData(NETWORK, numbers, {**arrays, "surroundings": tables.record, "local": local}, tables)
