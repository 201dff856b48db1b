"""The search in a small lot as a file of Cassandra's format `.pomdp`, for solvers of others.

`python examples/write_pomdp.py` writes `mini.pomdp`: each slot doubles the number of states, 12,289 for ten slots. It
assumes that slots do not change, are taken independently of each other, and are observed without error once they are
in view. A state is the vertex of the car and the slots that are taken, or `done`. Rewards are minus seconds.

Two things make the optimum that of a search: at the start, a state of its own, the car has observed nothing yet and
cannot park; and giving up in a lot that is not full costs so much that it is never optimal before every slot was
observed. Solvers that want a discount below 1 find `DISCOUNT` at the top.
"""

from pathlib import Path

import gymnasium as gym
import numpy as np

import parkenv
from parkenv.belief.slot_belief import SlotBelief
from parkenv.world.lot import ACTIONS, PARK
from planners.routes import DriveRoutes

SCENARIO, SEED, DISCOUNT = "mini", 0, 1.0
FILE = Path("mini.pomdp")


def pomdp_lines(problem, p_occupied, vertex, discount=1.0):
    """Yield the lines of the search from a vertex in which no slot has been observed.

    Args:
        problem: lot, goal, speeds and costs; the sensor must not err, and every slot be in view of some vertex.
        p_occupied: (n_slots,) probability that each slot is taken; none is sure to be.
        vertex: where the car is.
        discount: of each step.
    """
    n, routes = problem.lot.n_slots, DriveRoutes(problem)
    p_free = 1.0 - np.asarray(p_occupied, np.float64)
    vertices = np.flatnonzero(np.isfinite(routes.seconds_from(vertex))).tolist()
    drives = np.array([routes.seconds_from(v)[vertices] for v in vertices])
    # To see all slots saves no more than this, and what is unseen is free with at least some probability.
    longest_s = n * drives[np.isfinite(drives)].max() + problem.arrival_cost_s.max()
    false_give_up_s = float((longest_s + problem.give_up_s) / p_free.min())
    # From a slot's own vertex the car could park before it has looked; elsewhere the start is a vertex as others are.
    vertices.sort(key=lambda v: v != vertex)
    places = [("start", vertex)] * bool(problem.action_masks[vertex, PARK]) + [(f"v{v}", v) for v in vertices]
    most_seen = max(len(problem.in_view(v)) for v in vertices)

    def bits(number, length=n):
        return "".join(str(number >> i & 1) for i in range(length))

    def outcome(place, v, taken, action):
        """Return the vertex, or -1 after parking, and the cost, s."""
        if action != PARK:
            return int(problem.edges[v, action]["target"]), float(problem.edges[v, action]["seconds"])
        if place == "start" or not problem.action_masks[v, PARK]:
            # The car waits, at a vertex where a move is missing.
            return v, problem.wait_s if (problem.lot.neighbors[v] < 0).any() else false_give_up_s
        return (v, problem.failure_s) if taken >> v & 1 else (-1, float(problem.arrival_cost_s[v]))

    start = np.ones(1)  # the probability of each set of taken slots
    for free in p_free:
        start = np.concatenate([start * free, start * (1.0 - free)])
    yield "# State vV_BITS: the car is at vertex V (start: has not looked yet); slot i is taken where bit i is 1."
    yield "# Observation seen_BITS: which of the slots in view of the vertex are taken, in their order; then zeros."
    yield f"discount: {discount}"
    yield "values: reward"
    yield f"states: {' '.join(f'{place}_{bits(taken)}' for place, _ in places for taken in range(2**n))} done"
    yield f"actions: {' '.join(ACTIONS)} give-up"
    yield f"observations: {' '.join(f'seen_{bits(seen, most_seen)}' for seen in range(2**most_seen))}"
    elsewhere = [0.0] * ((len(places) - 1) * 2**n + 1)
    yield f"start: {' '.join(str(float(p)) for p in [*start, *elsewhere])}"
    yield "T: * : done : done 1.0"
    yield f"O: * : done : seen_{bits(0, most_seen)} 1.0"
    for place, v in places:
        for taken in range(2**n):
            state = f"{place}_{bits(taken)}"
            seen = sum((taken >> int(slot) & 1) << i for i, slot in enumerate(problem.in_view(v)))
            yield f"O: * : {state} : seen_{bits(seen, most_seen)} 1.0"
            for action, name in enumerate(ACTIONS):
                target, cost_s = outcome(place, v, taken, action)
                yield f"T: {name} : {state} : {'done' if target < 0 else f'v{target}_{bits(taken)}'} 1.0"
                yield f"R: {name} : {state} : * : * {-cost_s}"
            cost_s = problem.give_up_s if taken == 2**n - 1 else false_give_up_s
            yield f"T: give-up : {state} : done 1.0"
            yield f"R: give-up : {state} : * : * {-cost_s}"


if __name__ == "__main__":
    scenario = parkenv.make_scenario(SCENARIO, day_error=0.0)
    observation, _ = gym.make("parkenv/Search-v2", scenario=scenario).reset(seed=SEED)
    belief, vertex = SlotBelief.of_observation(observation), int(observation["vertex"])
    lines = pomdp_lines(scenario.public(), belief.forecast, vertex, DISCOUNT)
    FILE.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    print(f"{FILE}: {FILE.stat().st_size / 1e6:.1f} MB")
