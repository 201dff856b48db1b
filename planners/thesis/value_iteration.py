"""The reference solver: value iteration with in-place (Gauss-Seidel) sweeps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.jit import compiled
from parkenv.errors import InputError
from planners.thesis.mdp import ParkingMDP
from planners.thesis.policy_iteration import Solution


def value_iteration(mdp: ParkingMDP, *, tolerance: float = 1e-9, max_iterations: int = 2_000_000) -> Solution:
    """Apply the Bellman update until every value is within `tolerance` of the optimum.

    It is slow if gamma is close to 1 and few slots are free. It is independent of the other solvers and serves to check
    them.

    Args:
        mdp: the process.
        tolerance: s, bound on the error of the values, which is the last change times γ/(1-γ); at γ = 1, where no such
            bound exists, a limit on the last change itself.
        max_iterations: maximum number of sweeps.

    Raises:
        InputError: the tolerance is not positive.
        RuntimeError: not converged within `max_iterations`.
    """
    if not tolerance > 0.0:
        raise InputError(f"tolerance is {tolerance}, want above 0")
    rewards, successors, continuation = mdp.rewards(), mdp.successors(), mdp.continuation()
    # Start below the optimum, from attempts here for ever: at γ = 1 values above it could be fixed points, too.
    with np.errstate(divide="ignore", invalid="ignore"):
        retry = rewards[:, -1] / (1.0 - continuation[:, -1])
    values = np.where(
        mdp.p_free > 0.0, retry, -1e9 if mdp.gamma == 1.0 else -mdp.failure_s / (1.0 - mdp.gamma)
    )
    step = tolerance if mdp.gamma == 1.0 else tolerance * (1.0 - mdp.gamma) / mdp.gamma
    sweeps = _sweep_until(values, rewards, successors, continuation, step, max_iterations)
    if sweeps > max_iterations:
        raise RuntimeError(f"value iteration did not converge within {max_iterations} sweeps")
    return Solution(values, mdp.action_values(values).argmax(axis=1), sweeps)


@compiled
def _sweep_until(
    values: FloatArray,
    rewards: FloatArray,
    successors: NDArray[np.int64],
    continuation: FloatArray,
    step: float,
    max_sweeps: int,
) -> int:
    n, n_actions = rewards.shape
    for sweep in range(1, max_sweeps + 1):
        change = 0.0
        for s in range(n):
            best = -np.inf
            for a in range(n_actions):
                best = max(best, rewards[s, a] + continuation[s, a] * values[successors[s, a]])
            # Ignore changes by rounding, which can go on for ever.
            moved = abs(best - values[s])
            if moved > 4e-16 * abs(best):
                change = max(change, moved)
            values[s] = best
        if change <= step:
            return sweep
    return max_sweeps + 1
