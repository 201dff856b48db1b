"""The thesis's solver: policy iteration (T §3.4.3, eq. 3.26-3.30)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import require
from parkenv.world.lot import PARK
from planners.thesis.mdp import ParkingMDP

MOST_ITERATIONS = 10_000


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of a solver."""

    values: FloatArray  # (n,) float64, s, the utility of each state (eq. 3.26); the goal's is 0.
    policy: NDArray[np.int64]  # (n,) int64, an optimal action of each state (eq. 3.27).
    iterations: int  # number of rounds of the solver


def policy_iteration(mdp: ParkingMDP, policy: NDArray[np.int64] | None = None) -> Solution:
    """Alternate evaluation by sparse LU (eq. 3.29) and greedy improvement (eq. 3.30).

    Stops when the policy no longer changes. If actions differ only by rounding, the current one is kept, so ties cannot
    make it run for ever.

    Args:
        mdp: the process; gamma must be below 1, since a policy that never parks has no finite value at 1.
        policy: (n,) initial policy, for a warm start; None: park everywhere.

    Raises:
        InputError: gamma is 1, or the policy has the wrong shape.
        RuntimeError: not converged within `MOST_ITERATIONS`.
    """
    require(
        mdp.gamma < 1.0,
        "policy iteration needs gamma below 1: else a policy that never parks has no finite value",
    )
    n = mdp.n_states
    state = np.arange(n)
    rewards, successors, continuation = mdp.rewards(), mdp.successors(), mdp.continuation()
    policy = np.full(n, PARK, dtype=np.int64) if policy is None else np.array(policy, dtype=np.int64)
    require(policy.shape == (n,), f"policy has shape {policy.shape}, want ({n},)")
    for iteration in range(1, MOST_ITERATIONS + 1):
        weights = np.concatenate([np.ones(n), -continuation[state, policy]])
        entries = np.concatenate([state, state]), np.concatenate([state, successors[state, policy]])
        system = csc_array((weights, entries), shape=(n, n))
        values = splu(system).solve(rewards[state, policy])
        q = rewards + continuation * values[successors]
        current, best = q[state, policy], q.max(axis=1)
        better = best > current + 1e-11 * (1.0 + np.abs(current))
        if not better.any():
            return Solution(values, policy, iteration)
        policy = np.where(better, q.argmax(axis=1), policy)
    raise RuntimeError(f"policy iteration did not converge within {MOST_ITERATIONS} iterations")
