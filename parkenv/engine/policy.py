"""Compiled policies: how compiled code decides for a car of a fleet, and what it may know for that.

A compiled policy is a function `(address of the FLEET record, index of the car) -> action`, called by its address.
Actions are those of `parkenv/Search-v2`, and `LEAVE` and `TAKE_SLOT + slot`. The functions below give a policy what an
agent's observation holds: position, actions, the last observation of each slot.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import (
    OBSERVED_FREE,
    OBSERVED_TAKEN,
    UNOBSERVED,
    may_have_decayed,
    observed_state,
)
from parkenv.compiled.jit import inlined
from parkenv.compiled.keyed_random import POLICY_STREAM, keyed_uniform
from parkenv.compiled.memory import address_of, call_address, float64s, int32s, int64s, uint8s
from parkenv.engine.records import (
    BLOCK_BITS,
    BLOCK_SIZE,
    N_ACTIONS,
    SENTINEL,
    UNGUIDED,
    block_at,
    car_at,
    fleet_at,
    scenario_at,
    search_at,
    slot_at,
)
from parkenv.engine.search_belief import belief_now, forecast_of, is_forbidden, parking_cost_s
from parkenv.world.lot import PARK
from parkenv.world.scenario import SearchProblem

LEAVE = -1  # action of compiled policies: give up and park elsewhere
# Action of compiled policies: `TAKE_SLOT + slot` attempts to park there at once, without the drive.
TAKE_SLOT = 16


class PolicyData:
    """The data of a compiled policy for one fleet, its tables: a record of numbers and addresses.

    Attributes:
        record: (1,) of the dtype.
        arrays: arrays whose addresses are the fields of these names.
        address: address of the record.
    """

    def __init__(
        self,
        dtype: np.dtype[Any],
        numbers: Mapping[str, float],
        arrays: Mapping[str, NDArray[Any]],
        kept: Any = None,
    ) -> None:
        self.record, self.arrays, self._kept = np.zeros(1, dtype), arrays, kept
        for name, number in numbers.items():
            self.record[name] = number
        for name, array in arrays.items():
            self.record[name] = address_of(array, array.dtype)
        self.address = address_of(self.record, dtype)

    def __reduce__(self) -> NoReturn:
        raise TypeError("PolicyData holds addresses of this process: copy the CompiledPolicy, or the Fleet")


@dataclass(frozen=True, eq=False)
class CompiledPolicy:
    """A policy that decides for the cars of a fleet without Python.

    Args:
        name: for tables.
        decide: compiled function (int64 address of the FLEET record, int64 index of the car) -> int64 action.
        tables: makes what the policy needs in a fleet, which keeps it, from the problem of each scenario, by
            `scenario_index` of the CAR record; a function that can be pickled. None: nothing.
    """

    name: str
    decide: Callable[[int, int], int]
    tables: Callable[[Sequence[SearchProblem]], PolicyData] | None = None

    @cached_property
    def address(self) -> int:
        """Address of the compiled function; it is compiled when first asked for."""
        return call_address(self.decide)

    def data_for(self, problems: Sequence[SearchProblem]) -> PolicyData | None:
        """Return the `tables` for some problems."""
        return None if self.tables is None else self.tables(problems)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the policy without its address in this process."""
        return type(self), (self.name, self.decide, self.tables)


@inlined
def car_of(address: int, number: int) -> Any:
    """Return a CAR record; a policy may change `target` and `n_moves`, its memory of the search: -1 and 0 at first."""
    return car_at(fleet_at(address, 0).cars, number)


@inlined
def search_of(address: int) -> Any:
    """Return a SEARCH record; a policy may change the array at `moves`, (2 n_vertices,) uint8, anything at first."""
    return search_at(address, 0)


@inlined
def policy_data(address: int, car: Any) -> int:
    return int(int64s(fleet_at(address, 0).policy_data)[car.kind])


@inlined
def is_allowed(search: Any, action: int) -> bool:
    """Return whether the car may take an action where it is: the graph has it, and the driver may park there."""
    masks = uint8s(scenario_at(search.scenario, 0).action_masks)
    if not masks[search.vertex * N_ACTIONS + action]:
        return False
    return bool(action != PARK or search.n_forbidden == 0 or not is_forbidden(search, search.vertex))


@inlined
def draw_uniform(search: Any) -> float:
    """Return a random number from [0, 1) that depends on the world, the car and its step alone."""
    return float(keyed_uniform(search.key, POLICY_STREAM, 0, search.n_steps))


@inlined
def draw_action(search: Any, n_actions: int) -> int:
    """Return one of the first actions that the graph has where the car is, all with equal probability; -1 if none."""
    count = 0
    for action in range(n_actions):
        count += is_allowed(search, action)
    left = int(draw_uniform(search) * count)
    for action in range(n_actions):
        if is_allowed(search, action):
            if left == 0:
                return action
            left -= 1
    return -1


@inlined
def has_own_price(search: Any) -> bool:
    """Return whether arriving costs the car something else than the scenario's driver: zones have rules."""
    return bool(search.zone_cost_s != 0)


@inlined
def arrival_cost_s(search: Any, slot: int) -> float:
    """Return what arriving in a slot costs the car, s, as `FleetCars.arrival_cost_s`: time inside, walk, own stay."""
    scenario = scenario_at(search.scenario, 0)
    cost_s = float64s(scenario.walk_s)[slot] * search.walks + parking_cost_s(search, slot)
    if scenario.enter_s != 0:
        cost_s += float64s(scenario.enter_s)[slot]
    return float(cost_s)


@inlined
def least_zone_cost_s(search: Any, n_zones: int) -> float:
    """Return the least that the car's own stay costs in any zone, s, where slots have prices."""
    least_s, zone_cost_s = np.inf, float64s(search.zone_cost_s)
    for zone in range(n_zones):
        least_s = min(least_s, zone_cost_s[zone])
    return least_s


@inlined
def forecast(search: Any, slot: int) -> float:
    """Return the forecast P(taken) of a slot, rounded as in the observation."""
    return float(np.float32(forecast_of(search, slot)[0]))


# ---- what was observed


@inlined
def known_slot(search: Any, i: int) -> int:
    """Return the i-th of the `n_columns` slots of which something may have been observed."""
    return int(slot_at(search.slots, SENTINEL + 1 + i).slot)


@inlined
def observed_column(search: Any, i: int) -> tuple[Any, float, Any]:
    """Return the i-th of these slots, -1 if it was not observed; 1 if it was last observed free; its forecast.

    The forecast is rounded as in the observation. What a reservation says of a slot is no observation.
    """
    column = SENTINEL + 1 + i
    record = slot_at(search.slots, column)
    block, k = block_at(search.blocks, column >> BLOCK_BITS), column & (BLOCK_SIZE - 1)
    prior, p_observed = np.float32(block.prior[k]), np.float32(block.p_observed[k])
    is_free = p_observed < prior or p_observed == 0.0
    is_seen = record.observed and (is_free or p_observed != prior)
    return np.int64(record.slot if is_seen else -1), 1.0 if is_free else 0.0, np.float64(prior)


@inlined
def p_occupied(search: Any, slot: int) -> float:
    """Return P(taken) of an observed slot, rounded as in the observation; as `SlotBelief.with_reservation`."""
    if search.reserved != UNGUIDED:
        return 0.0 if slot == search.reserved else 1.0
    return float(np.float32(belief_now(search, np.int64(int32s(search.columns)[slot]))))


@inlined
def recent_state(search: Any, slot: int) -> int:
    """Return the state of a slot as in `SlotBelief.recent_state`, from numbers rounded as in the observation."""
    if search.reserved != UNGUIDED:
        return OBSERVED_FREE if slot == search.reserved else OBSERVED_TAKEN
    column = np.int64(int32s(search.columns)[slot])
    if column == SENTINEL or not slot_at(search.slots, column).observed:
        return UNOBSERVED
    block, i = block_at(search.blocks, column >> BLOCK_BITS), column & (BLOCK_SIZE - 1)
    state, p_observed = OBSERVED_TAKEN, block.p_observed[i]
    if p_observed < 1.0:
        state = observed_state(np.float32(block.prior[i]), np.float32(p_observed))
    if state == OBSERVED_TAKEN:
        observed_at = np.float32(block.observed_at[i] - search.arrival)
        is_old = may_have_decayed(np.float32(block.decay_rate[i]), search.clock[1], observed_at)
        if is_old and np.float32(belief_now(search, column)) == np.float32(block.prior[i]):
            return UNOBSERVED
    return int(state)
