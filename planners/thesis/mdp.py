"""The thesis's Markov decision process of parking search (T §3.4.2)."""

import warnings
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import require, require_number
from parkenv.world.lot import ACTIONS, MOVES, PARK
from parkenv.world.scenario import SearchProblem

USUAL_DISCOUNT = 0.9999  # the thesis's discount per decision
SHORTEST_S = 1e-4  # drive time, s, that shorter edges count as in `discount`


class CirclingWarning(UserWarning):
    """The discount is so low that driving in circles for ever can look better than parking."""


def discount(problem: SearchProblem) -> float:
    """Return the discount per decision: the thesis's 0.9999, or as much as keeps circling from looking cheap.

    Driving in circles for ever costs min(d_min, Δt)/(1 - γ) at least. That has to be more than a search may cost, the
    give-up penalty and the most expensive arrival. Stops of mapped lots may be a millimetre apart, and then it is 4 s.
    """
    edges = problem.move_cost_s[problem.lot.neighbors >= 0]
    shortest = max(min(float(edges.min(initial=np.inf)), problem.wait_s), SHORTEST_S)
    return max(
        USUAL_DISCOUNT, 1.0 - shortest / (problem.give_up_s + float(problem.finite_cost_s.max()) + 1.0)
    )


@dataclass(frozen=True, eq=False)
class ParkingMDP:
    """States are the vertices of the drive graph and the absorbing goal; actions are four moves and "park".

    A move along an edge costs its drive time (eq. 3.16, 3.23); a move without an edge costs `wait_s` and stays. Parking
    at vertex s reaches the goal with probability `p_free[s]` and pays r_max - r_s, the saving against the slot with the
    highest arrival cost (eq. 3.17, 3.24); the arrival cost is the walk, and the price where slots have one. Otherwise
    parking costs `failure_s` and stays. The goal's value is zero.

    Args:
        neighbors: (n, 4) int, the vertex that up, down, left, right lead to, or -1.
        move_s: (n, 4) float64, s, cost of each edge: its drive time and what else it costs.
        p_free: (n,) float64, probability that a parking attempt succeeds; 0 where there is no slot.
        arrival_cost_s: (n,) float64, s, arrival cost of parking at each vertex (`SearchProblem.arrival_cost_s`).
        failure_s: s, the planner's cost of a failed attempt.
        wait_s: s, the cost of a move without an edge (the thesis's Δt).
        gamma: discount per decision, in (0, 1].

    Attributes:
        park_reward: (n,) float64, s, r_max - r_s; r_max is taken over the vertices where parking is possible.

    Raises:
        InputError: a value is out of range, or shapes of arrays do not agree.

    Example:
        Two slots on a line; the second is nearer to the goal but always taken.

        >>> mdp = ParkingMDP([[-1, -1, -1, 1], [-1, -1, 0, -1]], [[0, 0, 0, 2.0], [0, 0, 2.0, 0]],
        ...                  p_free=[0.5, 0.0], arrival_cost_s=[30.0, 10.0], failure_s=10.0, gamma=0.99)
        >>> from planners import policy_iteration
        >>> [ACTIONS[action] for action in policy_iteration(mdp).policy]
        ['park', 'left']
    """

    neighbors: NDArray[np.int64]
    move_s: FloatArray
    p_free: FloatArray
    arrival_cost_s: FloatArray
    failure_s: float
    wait_s: float = 1.0
    gamma: float = USUAL_DISCOUNT
    park_reward: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        neighbors = np.asarray(self.neighbors, dtype=np.int64)
        move_s = np.asarray(self.move_s, dtype=np.float64)
        p_free = np.asarray(self.p_free, dtype=np.float64)
        arrival_cost_s = np.asarray(self.arrival_cost_s, dtype=np.float64)
        n = len(neighbors)
        edges = (n, len(MOVES))
        for name, array, wanted in (
            ("neighbors", neighbors, edges),
            ("move_s", move_s, edges),
            ("p_free", p_free, (n,)),
            ("arrival_cost_s", arrival_cost_s, (n,)),
        ):
            require(array.shape == wanted, f"{name} has shape {array.shape}, want {wanted}")
            object.__setattr__(self, name, array)
        require(
            n > 0 and neighbors.max() < n and neighbors.min() >= -1,
            f"neighbors must hold vertices 0..{n - 1}, or -1 where there is no edge",
        )
        require(((p_free >= 0.0) & (p_free <= 1.0)).all(), "p_free must lie in [0, 1]")
        require(
            np.isfinite(arrival_cost_s).all() and (move_s[neighbors >= 0] >= 0.0).all(),
            "arrival_cost_s must be finite and move_s not negative",
        )
        for name in ("failure_s", "wait_s"):
            require_number(name, getattr(self, name), least=0.0)
        require_number("gamma", self.gamma, above=0.0, most=1.0)
        object.__setattr__(self, "park_reward", arrival_cost_s.max() - arrival_cost_s)

    @classmethod
    def from_belief(
        cls,
        problem: SearchProblem,
        p_occupied: ArrayLike,
        *,
        failure_s: float | None = None,
        gamma: float | None = None,
    ) -> Self:
        """Make the thesis's process from a belief about the slots.

        Args:
            problem: lot, goal, speeds and costs.
            p_occupied: (n_slots,) probability that each slot is taken.
            failure_s: s, the planner's cost of a failed attempt; None: the actual cost (`problem.failure_s`).
            gamma: discount per decision; None: `discount`.
        """
        n, n_slots = problem.lot.n_vertices, problem.lot.n_slots
        p_free = np.zeros(n)
        p_free[:n_slots] = 1.0 - np.asarray(p_occupied, dtype=np.float64)
        # Junctions have no slots: their cost must not raise r_max.
        arrival_cost_s = np.full(n, problem.finite_cost_s.max())
        arrival_cost_s[:n_slots] = problem.finite_cost_s
        return cls(
            neighbors=problem.lot.neighbors.astype(np.int64),
            move_s=problem.move_cost_s,
            p_free=p_free,
            arrival_cost_s=arrival_cost_s,
            failure_s=problem.failure_s if failure_s is None else failure_s,
            wait_s=problem.wait_s,
            gamma=discount(problem) if gamma is None else gamma,
        )

    @property
    def n_states(self) -> int:
        """Number of vertices; the goal is not counted."""
        return len(self.neighbors)

    def successors(self) -> NDArray[np.int64]:
        """Return the state after each action that does not reach the goal, (n, 5); missing moves and parking stay."""
        stay = np.arange(self.n_states)[:, None]
        return np.concatenate([np.where(self.neighbors >= 0, self.neighbors, stay), stay], axis=1)

    def rewards(self) -> FloatArray:
        """Return the expected reward, (n, 5) s, of each action (eq. 3.23, 3.24 and the failure costs)."""
        move = np.where(self.neighbors >= 0, -self.move_s, -self.wait_s)
        park = self.p_free * self.park_reward - (1.0 - self.p_free) * self.failure_s
        return np.concatenate([move, park[:, None]], axis=1)

    def continuation(self) -> FloatArray:
        """Return the discounted probability, (n, 5), that an action leads to its successor and not to the goal."""
        keep = np.full((self.n_states, len(ACTIONS)), self.gamma)
        keep[:, PARK] *= 1.0 - self.p_free
        return keep

    def action_values(self, values: FloatArray) -> FloatArray:
        """Return Q, (n, 5) s, of each action given the values, (n,) s, of the states (inner part of eq. 3.30)."""
        return self.rewards() + self.continuation() * values[self.successors()]

    def expected_time(self, values: FloatArray) -> FloatArray:
        """Return the expected time, (n,) s, from each state to the goal: r_max minus its value."""
        return float(self.arrival_cost_s.max()) - values

    def check_discount(self, values: FloatArray) -> None:
        """Warn where discounting breaks the equivalence with time (eq. 3.28).

        Driving in circles for ever costs at least min(d_min, Δt)/(1 - γ), and attempting a taken slot for ever costs
        `failure_s`/(1 - γ). Neither can be optimal if the cost of every state is below both.
        """
        if self.gamma == 1.0:
            return
        edges = self.move_s[self.neighbors >= 0]
        shortest, what = min(float(edges.min()) if len(edges) else np.inf, self.wait_s), "driving in circles"
        if (self.p_free < 1.0).any() and self.failure_s < shortest:
            shortest, what = self.failure_s, "attempting a taken slot"
        bound = shortest / (1.0 - self.gamma)
        worst = float(-values.min())
        if worst >= bound:
            warnings.warn(
                f"with gamma {self.gamma}, {what} for ever costs {bound:.0f} s, no more than the longest search, "
                f"{worst:.0f} s, so the plan may prefer it to parking; set gamma nearer to 1"
                if bound > 0.0
                else "a failed attempt costs nothing, so the plan may attempt a taken slot for ever; set a failure "
                "cost above 0 s, for this planner alone by its option failure_s",
                CirclingWarning,
                stacklevel=2,
            )
