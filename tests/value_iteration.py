"""Value iteration with in-place (Gauss-Seidel) sweeps: slow, and independent of the solvers that it checks."""

import numpy as np

from parkenv.compiled.jit import compiled
from planners.thesis.policy_iteration import Solution

MOST_SWEEPS = 2_000_000


def value_iteration(mdp, tolerance=1e-9):
    """Apply the Bellman update until every value is within `tolerance`, s, of the optimum.

    The error is at most the last change times γ/(1-γ); at γ = 1, without such a bound, the last change has the limit.
    """
    rewards, successors, continuation = mdp.rewards(), mdp.successors(), mdp.continuation()
    # Start below the optimum, from attempts here for ever: at γ = 1 values above it could be fixed points, too.
    with np.errstate(divide="ignore", invalid="ignore"):
        retry = rewards[:, -1] / (1.0 - continuation[:, -1])
    never = -1e9 if mdp.gamma == 1.0 else -mdp.failure_s / (1.0 - mdp.gamma)
    values = np.where(mdp.p_free > 0.0, retry, never)
    step = tolerance if mdp.gamma == 1.0 else tolerance * (1.0 - mdp.gamma) / mdp.gamma
    sweeps = _sweep_until(values, rewards, successors, continuation, step)
    assert sweeps <= MOST_SWEEPS, "not converged"
    return Solution(values, mdp.action_values(values).argmax(axis=1), sweeps)


@compiled
def _sweep_until(values, rewards, successors, continuation, step):
    n, n_actions = rewards.shape
    for sweep in range(1, MOST_SWEEPS + 1):
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
    return MOST_SWEEPS + 1
