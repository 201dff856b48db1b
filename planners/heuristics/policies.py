"""The heuristics as compiled policies, which drive the cars of a fleet without Python."""

from functools import partial

import numpy as np

from parkenv.belief.slot_belief import OBSERVED_TAKEN, UNOBSERVED
from parkenv.compiled.jit import kernel
from parkenv.compiled.memory import uint8_array, uint8s
from parkenv.engine.policy import (
    LEAVE,
    CompiledPolicy,
    car_of,
    draw_action,
    policy_data,
    recent_state,
    search_of,
)
from parkenv.world.lot import PARK
from planners.heuristics.rules import (
    FIRST_FREE,
    GREEDY_DRIVE,
    GREEDY_GOAL,
    GREEDY_TOTAL,
    NO_SLOT,
    choose_route,
    heuristic_tables,
    keeps_target,
    still_leads,
    tables_at,
)
from planners.heuristics.streets import choose_place, street_tables, streets_at, takes_slot

_N_ACTIONS = PARK + 1


@kernel
def decide_by_rule(address: int, number: int) -> int:
    car = car_of(address, number)
    data, search, target = policy_data(address, car), search_of(car.search), car.target
    tables = tables_at(data, 0)
    moves = uint8_array(search.moves, (tables.n_vertices,))
    state = UNOBSERVED if target == NO_SLOT else recent_state(search, target)
    if keeps_target(tables.heuristic, target, state):
        car.settled = False
    elif not (
        car.settled
        and state == UNOBSERVED
        and still_leads(data, car.scenario_index, car.search, search.vertex, target, moves, car.n_moves)
    ):
        car.target, car.n_moves = choose_route(
            data, car.scenario_index, car.search, search.vertex, target, moves, car.n_moves
        )
        if car.target == NO_SLOT:
            return LEAVE
        car.settled = tables.heuristic == GREEDY_TOTAL and recent_state(search, car.target) == UNOBSERVED
    if car.n_moves == 0:
        return PARK
    car.n_moves -= 1
    return int(moves[car.n_moves])


@kernel
def decide_usual(address: int, number: int) -> int:
    car = car_of(address, number)
    data, search, target = policy_data(address, car), search_of(car.search), car.target
    time = np.float64(search.clock[1])
    if target == NO_SLOT or recent_state(search, target) == OBSERVED_TAKEN:
        n_vertices = streets_at(data, 0).n_slots + streets_at(data, 0).n_junctions
        moves = uint8_array(search.moves, (2 * n_vertices,))
        car.target, car.n_moves, index_s = choose_place(
            data, car.scenario_index, car.search, search.vertex, target, moves, car.n_moves
        )
        car.expected_s = time + index_s
        if car.target == NO_SLOT:
            return LEAVE
    if car.n_moves == 0 or takes_slot(
        data, car.scenario_index, car.search, search.vertex, car.expected_s - time
    ):
        return PARK
    car.n_moves -= 1
    return int(uint8s(search.moves)[car.n_moves])


def target_policy(name: str, heuristic: int, within_m: float | None = None) -> CompiledPolicy:
    """Return the compiled policy of a `TargetAgent` by its rule, such as `GREEDY_GOAL`, and `first-free`'s option."""
    return CompiledPolicy(name, decide_by_rule, partial(heuristic_tables, heuristic, within_m=within_m))


@kernel
def decide_random(address: int, number: int) -> int:
    return int(max(draw_action(search_of(car_of(address, number).search), _N_ACTIONS), 0))


# The compiled policies of the heuristics without options, by name.
POLICIES = {
    policy.name: policy
    for policy in (
        target_policy("greedy-goal", GREEDY_GOAL),
        target_policy("greedy-drive", GREEDY_DRIVE),
        target_policy("greedy-total", GREEDY_TOTAL),
        target_policy("first-free", FIRST_FREE),
        CompiledPolicy("usual", decide_usual, street_tables),
        CompiledPolicy("random", decide_random),
    )
}
