"""Logits of slots on a day of average level, such that the mean over days is the forecast; see `day_error`."""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.jit import compiled
from parkenv.compiled.memory import address_of, float64s
from parkenv.forecast.logistic_normal import NormalQuadrature
from parkenv.world.occupancy.day_error import DayError

# The error is below 1e-9 for deviations up to 3, and below 1e-4 up to 7.
_NODES, _WEIGHTS = NormalQuadrature.evenly(0.25, 8.0)
_N_NODES = _NODES.size
_ITERATIONS = 100
_FAR = 500.0  # logits
_LAST_STEP = 1e-7  # Newton's method: the error after a step is of the order of its square


def centred_logits(p: ArrayLike, deviation: ArrayLike) -> FloatArray:
    """Return the logits x with E[sigmoid(x + deviation·Z)] = p for a standard normal Z; infinite for p = 0 and 1."""
    each = np.broadcast_arrays(np.asarray(p, float), np.asarray(deviation, float))
    table = np.stack([*(a.ravel() for a in each), np.empty(each[0].size)])
    nodes = np.stack([_NODES, _WEIGHTS, np.empty_like(_NODES)])
    _write_centred_logits(address_of(table, float), table.shape[1], address_of(nodes, float))
    logits: FloatArray = table[2].reshape(each[0].shape)
    return logits


@compiled(error_model="numpy", _nrt=False)
def _centred_logit(p: float, deviation: float, nodes: int) -> float:
    """Return `centred_logits` of one probability; at the address are weights of the nodes, and exp(deviation·z)."""
    weights, factors = float64s(nodes + 8 * _N_NODES), float64s(nodes + 16 * _N_NODES)
    wanted = math.log(p / (1.0 - p))
    if p <= 0.0 or p >= 1.0 or deviation == 0.0:
        return wanted
    far = wanted + math.copysign(0.5 * deviation * deviation, wanted)  # where the sigmoid is an exponential
    if abs(wanted) > _FAR:
        return far
    # Newton's method on the logit of the mean, which is nearly linear in x; the approximation by a probit starts it.
    x = wanted * math.sqrt(1.0 + math.pi * deviation * deviation / 8.0)
    x = math.copysign(min(abs(x), abs(far)), wanted)
    for _ in range(_ITERATIONS):
        taken = free = slope = 0.0
        odds = math.exp(x)
        for k in range(_N_NODES):
            # Both tails by themselves: 1 - taken would lose all digits near 1.
            p_free = 1.0 / (1.0 + odds * factors[k])
            p_taken = odds * factors[k] * p_free
            taken += weights[k] * p_taken
            free += weights[k] * p_free
            slope += weights[k] * p_taken * p_free
        step = (wanted - math.log(taken / free)) * taken * free / slope
        x += step
        if abs(step) < _LAST_STEP * max(1.0, abs(x)):
            break
    return x


TABLE_STEPS, TABLE_ROWS = 256, 8


@lru_cache(maxsize=64)
def centring_table(day_error: DayError) -> FloatArray:
    """Tabulate by which factor centring changes the odds of a slot, for compiled code.

    Returns:
        (rows, 257) float64, exp(centred_logits(p) - logit(p)). Column k is for p = k / 256; row j is for
        nearness² = j / 8. Without a slope there is one row for all.
    """
    if not day_error:
        return np.ones((1, TABLE_STEPS + 1))
    p = np.arange(TABLE_STEPS + 1) / TABLE_STEPS
    rows = np.sqrt(np.arange(TABLE_ROWS + 1) / TABLE_ROWS) if day_error.slope > 0.0 else np.zeros(1)
    deviation = day_error.deviations(rows)[:, None]
    factors = np.empty((rows.size, p.size))
    inner = p[1:-1]
    factors[:, 1:-1] = np.exp(centred_logits(inner, deviation) - np.log(inner / (1.0 - inner)))
    # For p near 0, E[sigmoid(x + deviation·Z)] approaches E[exp(x + deviation·Z)]; near 1, likewise.
    factors[:, :1], factors[:, -1:] = np.exp(-0.5 * deviation**2), np.exp(0.5 * deviation**2)
    factors.flags.writeable = False
    return factors


@compiled(error_model="numpy", _nrt=False)
def _write_centred_logits(table: int, n: int, nodes: int) -> None:
    """Write the last row of a table (3, n) of p, deviation and logits; `nodes` are z, weights and room for factors."""
    p, deviation, logits = float64s(table), float64s(table + 8 * n), float64s(table + 16 * n)
    z, factors = float64s(nodes), float64s(nodes + 16 * _N_NODES)
    for i in range(n):
        if i == 0 or deviation[i] != deviation[i - 1]:
            for k in range(_N_NODES):
                factors[k] = math.exp(deviation[i] * z[k])
        logits[i] = _centred_logit(p[i], deviation[i], nodes)
