"""The heuristics as compiled policies, which drive the cars of a fleet without Python."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import OBSERVED_TAKEN, UNOBSERVED
from parkenv.compiled.memory import (
    ADDRESS,
    address_of,
    float64_array,
    float64s,
    int32_array,
    record_at,
    uint8_array,
)
from parkenv.engine.policy import (
    CompiledPolicy,
    PolicyData,
    car_of,
    clear_states,
    draw_uniform,
    is_allowed,
    policy_data,
    recent_state,
    search_of,
    write_p_occupied,
    write_recent_states,
)
from parkenv.world.lot import MOVES, PARK
from parkenv.world.occupancy.kernel import inlined, kernel
from parkenv.world.scenario import SearchProblem
from planners.heuristics.rules import (
    FIRST_FREE,
    GREEDY_DRIVE,
    GREEDY_GOAL,
    NO_SLOT,
    DriveGraph,
    choose_target,
    keeps_target,
    likeliest_target,
    plan_route,
)

_N_ACTIONS = PARK + 1

TABLES = np.dtype(
    [
        ("heuristic", np.int64),
        ("n_slots", np.int64),
        ("n_vertices", np.int64),
        ("n_edges", np.int64),
        # The arrays of `DriveGraph`.
        *((name, ADDRESS) for name in DriveGraph._fields),
        # By place: (n_slots,) float64 arrival costs, s; float64, arrival cost up to which a free slot is taken, s.
        ("arrival_cost_s", ADDRESS),
        ("near_s", ADDRESS),
        # Work space, (n_slots,): uint8 states, `UNOBSERVED` between two decisions; float64 P(taken).
        ("states", ADDRESS),
        ("p_occupied", ADDRESS),
    ],
    align=True,
)
"""What a heuristic needs in a fleet."""
tables_at = record_at(TABLES)


def near_cost_s(problem: SearchProblem, within_m: float | None) -> float:
    """Return the arrival cost, s, of a walk of `within_m`; the median of the lot's slots for None."""
    cost_s = problem.arrival_cost_s
    return float(np.median(cost_s) if within_m is None else within_m / problem.v_walk)


@kernel
def decide_by_rule(address: int, number: int) -> int:
    """Drive to one slot after another by the rule of the policy's tables, and park there if it is free."""
    car = car_of(address, number)
    search = search_of(car)
    tables = tables_at(policy_data(address, car), 0)
    target = car.target
    state = UNOBSERVED if target == NO_SLOT else recent_state(search, target)
    if not keeps_target(tables.heuristic, target, state):
        _choose(tables, car, search)
    if car.n_moves == 0:
        return PARK
    car.n_moves -= 1
    return int(uint8_array(car.moves, (tables.n_vertices,))[car.n_moves])


@kernel
def _choose(tables: Any, car: Any, search: Any) -> None:
    """Choose the car's target, and plan the route to it."""
    graph, states = _graph_of(tables), uint8_array(tables.states, (tables.n_slots,))
    costs_s = tables.arrival_cost_s + 8 * tables.n_slots * car.place
    arrival_cost_s = float64_array(costs_s, (tables.n_slots,))
    near_s = float64s(tables.near_s)[car.place]
    vertex, target = search.vertex, car.target
    write_recent_states(search, states)
    chosen = choose_target(tables.heuristic, graph, arrival_cost_s, near_s, states, vertex, target)
    if chosen == NO_SLOT:
        p_occupied = float64_array(tables.p_occupied, (tables.n_slots,))
        write_p_occupied(search, p_occupied)
        chosen = likeliest_target(graph, arrival_cost_s, states, p_occupied, vertex)
    if chosen != target or states[target] == OBSERVED_TAKEN:
        car.target = chosen
        car.n_moves = plan_route(graph, vertex, chosen, uint8_array(car.moves, (tables.n_vertices,)))
    clear_states(search, states)


@inlined
def _graph_of(tables: Any) -> DriveGraph:
    n, n_edges, room = tables.n_vertices, tables.n_edges, len(MOVES) * tables.n_vertices + 1
    return DriveGraph(
        int32_array(tables.neighbors, (n, len(MOVES))),
        float64_array(tables.move_s, (n, len(MOVES))),
        int32_array(tables.in_start, (n + 1,)),
        int32_array(tables.in_source, (n_edges,)),
        float64_array(tables.in_s, (n_edges,)),
        float64_array(tables.seconds, (n,)),
        int32_array(tables.last_edge, (n,)),
        int32_array(tables.reached, (n + 1,)),
        float64_array(tables.keys, (room,)),
        int32_array(tables.vertices, (room,)),
    )


class TargetPolicy(CompiledPolicy):
    """The compiled policy of a `TargetAgent`.

    Args:
        name: for tables.
        heuristic: `GREEDY_GOAL`, `GREEDY_DRIVE` or `FIRST_FREE`.
        within_m: option of `first-free`.
    """

    def __init__(self, name: str, heuristic: int, within_m: float | None = None) -> None:
        super().__init__(name, decide_by_rule)
        self.heuristic, self.within_m = heuristic, within_m

    def data_for(self, problems: Sequence[SearchProblem]) -> PolicyData:
        """Return the policy's tables for a fleet."""
        graph, n_slots = DriveGraph.of(problems[0]), problems[0].lot.n_slots
        arrays: dict[str, NDArray[Any]] = {
            **graph._asdict(),
            "arrival_cost_s": np.array([problem.arrival_cost_s for problem in problems], np.float64),
            "near_s": np.array([near_cost_s(problem, self.within_m) for problem in problems]),
            "states": np.full(n_slots, UNOBSERVED, np.uint8),
            "p_occupied": np.zeros(n_slots),
        }
        tables = np.zeros(1, TABLES)
        tables["heuristic"], tables["n_slots"] = self.heuristic, n_slots
        tables["n_vertices"], tables["n_edges"] = len(graph.neighbors), len(graph.in_s)
        for name, array in arrays.items():
            tables[name] = address_of(array, array.dtype)
        return PolicyData(tables, arrays)

    def __reduce__(self) -> tuple[Any, ...]:
        return TargetPolicy, (self.name, self.heuristic, self.within_m)


@kernel
def decide_random(address: int, number: int) -> int:
    """Choose one of the actions that the graph has, all with equal probability."""
    search = search_of(car_of(address, number))
    count = 0
    for action in range(_N_ACTIONS):
        count += is_allowed(search, action)
    left = int(draw_uniform(search) * count)
    for action in range(_N_ACTIONS):
        if is_allowed(search, action):
            if left == 0:
                return action
            left -= 1
    return 0


POLICIES = {
    policy.name: policy
    for policy in (
        TargetPolicy("greedy-goal", GREEDY_GOAL),
        TargetPolicy("greedy-drive", GREEDY_DRIVE),
        TargetPolicy("first-free", FIRST_FREE),
        CompiledPolicy("random", decide_random),
    )
}
"""The compiled policies of the heuristics without options, by name."""
