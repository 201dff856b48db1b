"""The options of a fleet, its kinds of drivers, and the cars of its world, as its demand draws them."""

import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import Field, InstanceOf

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.compiled.keyed_random import SLOT_STREAM
from parkenv.engine.policy import CompiledPolicy
from parkenv.engine.records import BACKGROUNDS, CAR, DUE, NO_SLOT
from parkenv.errors import InputError, require_one_of
from parkenv.files.field_types import NotNegative, Validated, Whole
from parkenv.files.known_names import KNOWLEDGE
from parkenv.world.arrivals import uniforms
from parkenv.world.demand import CarPlans, Demand, TownDemand
from parkenv.world.occupancy.process import ArrivalDay
from parkenv.world.scenario import Drivers, Scenario, drive_times, zone_prices
from parkenv.world.week import DAY_S

# Chance that a free slot was taken when a car came that is parked at first: it stands in the first slot that was not.
# A counted facility that has room had room.
_TAKEN_BEFORE = 0.8
_MOST_PASSED = 30
# Options that are times, s, and fields of the FLEET record.
TIMES = ("tick_s", "delay_s", "manoeuvre_s")


@dataclass(frozen=True)
class DriverKind(Validated):
    """A kind of driver in a fleet.

    Args:
        weight: relative number of such drivers. A car's kind follows from its own random number, so with two kinds and
            equal demand, the drivers of the first kind stay the same, and more join them, as its weight grows.
        policy: compiled policy that decides, such as `planners.heuristics.policies.POLICIES["greedy-drive"]`; None:
            Python decides.
        knows: what these drivers know of the slots besides the forecast: `own`, their own observations; `shared`, also
            those on the live map; `reserve`, the slot that a guidance system has reserved for them; `full`, the true
            state of every slot.
        shares: whether they report their observations, and that they park and leave, to the live map.

    Raises:
        InputError: a value out of its range; the message names the field.
    """

    weight: NotNegative = 1.0
    policy: InstanceOf[CompiledPolicy] | None = None
    knows: str = "own"
    shares: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        require_one_of("knows", self.knows, KNOWLEDGE)


@dataclass(frozen=True, kw_only=True)
class FleetOptions(Validated):
    """Options of a fleet; `parkenv.engine.fleet.Fleet` describes what they change.

    Args:
        drivers: the kinds of drivers.
        background: other cars that take slots: `residents`, which are parked when the world begins, drawn from the
            scenario's occupancy, and leave once; `process`, the scenario's occupancy all day; `none`: the lot is
            empty when the world begins. By default residents; none if cars of the demand are parked then.
        max_steps: limit of a car's decisions; by default that of `parkenv/Search-v2`.
        leave_full_lot: whether a car gives up once it knows every slot to be taken; otherwise it searches on until its
            patience is at an end. An informed car knows it at once, so compare kinds of knowledge with False.
        tick_s: durations of steps, and arrivals, are rounded up to multiples of this, s; 0: continuous time.
        delay_s: time after which a report is on the live map, s.
        manoeuvre_s: time for which a car that parks or leaves blocks its lane, s; 0: no car blocks a lane.
        sees_cars: whether observations hold the other cars in view.

    Raises:
        InputError: a value out of its range; the message names the field.
    """

    drivers: Annotated[tuple[InstanceOf[DriverKind], ...], Field(min_length=1)] = (DriverKind(),)
    background: str | None = None
    max_steps: Annotated[Whole, Field(ge=1)] = 2000
    leave_full_lot: bool = True
    tick_s: NotNegative = 0.0
    delay_s: NotNegative = 0.0
    manoeuvre_s: NotNegative = 0.0
    sees_cars: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if not sum(kind.weight for kind in self.drivers) > 0.0:
            raise InputError("drivers: all weights are 0, want one above 0")
        require_one_of("background", self.background, (None, *BACKGROUNDS))


class FleetCars:
    """The cars of the present world, of a scenario with the demand's weights of entries and goals.

    Attributes:
        scenarios: one for each goal with a weight.
        records: (n_cars,) of the dtype CAR, in order of arrival.
        drivers: what decides where the cars may park and what it costs them.
        zone_cost_s: what parking in each zone costs each car, (n_cars, n_zones) s; None where it costs nothing.
    """

    def __init__(self, scenario: Scenario, demand: Demand | TownDemand, options: FleetOptions) -> None:
        lot = scenario.lot
        for name, places in (("goal_weights", lot.goals), ("entry_weights", lot.entries)):
            if (weights := getattr(demand, name)) and len(weights) != len(places):
                raise InputError(
                    f"Demand.{name} has {len(weights)} numbers, lot {lot.name!r} has {len(places)} of these"
                )
        self.scenarios = tuple(scenario.at_goal(goal) for goal in range(len(demand.goal_weights))) or (
            scenario,
        )
        entry = None if demand.entry_weights else scenario.entry
        self._entries = lot.entry_vertices if entry is None else lot.entry_vertices[[entry]]
        self._scenario, self._options = scenario, options
        self._walk_s = np.array([problem.walk_s for problem in self.scenarios])
        self._way_s = self._ways_s()
        self.records, self.midnight = np.zeros(0, CAR), 0.0
        self.drivers = Drivers(0.0, 0.0, 0.0, 0)
        self.zone_cost_s: FloatArray | None = None

    def _ways_s(self) -> FloatArray:
        """Return the shortest drives by goal and entry, (n_goals, n_entries) s, to the slot nearest to the goal.

        In a lot that is no town, cars search from the entry on: 0.
        """
        if not self._scenario.lot.is_town:
            return np.zeros((len(self.scenarios), len(self._entries)))
        drive_s = drive_times(self._scenario, self._entries)
        nearest = np.where(np.isfinite(drive_s), self._walk_s[:, None], np.inf).argmin(axis=2)
        way_s = drive_s[np.arange(len(drive_s)), nearest]
        return np.where(np.isfinite(way_s), way_s, 0.0)

    def draw(self, demand: Demand | TownDemand, key: np.uint64, arrival_s: float, day: ArrivalDay) -> float:
        plans, options = demand.draw(key, arrival_s, len(self._entries), day), self._options
        self.midnight = midnight = day.weekday * DAY_S
        begin = midnight + demand.begin_s(arrival_s)
        cars = self.records = np.zeros(len(plans.arrival_s), CAR)
        cars["arrival"] = midnight + plans.arrival_s
        if options.tick_s > 0.0:
            ticks = np.ceil((cars["arrival"] - begin) / options.tick_s - 1e-9)
            cars["arrival"] = begin + ticks * options.tick_s
        cars["entry"], cars["scenario_index"] = self._entries[plans.entry], plans.goal
        cars["stay_s"] = plans.stay_s
        cars["patience_s"] = plans.patience_s + self._way_s[plans.goal, plans.entry]
        shares = np.cumsum([kind.weight for kind in options.drivers])
        number = np.searchsorted(shares / shares[-1], plans.kind, side="right")
        cars["kind"] = kind = np.minimum(number, len(options.drivers) - 1)
        policies = [0 if driver.policy is None else driver.policy.address for driver in options.drivers]
        cars["policy"] = np.array(policies, np.int64)[kind]
        cars["knows"] = np.array([KNOWLEDGE.index(driver.knows) for driver in options.drivers])[kind]
        cars["shares"] = np.array([driver.shares for driver in options.drivers])[kind]
        cars["purpose"], cars["parked_at"] = plans.purpose, NO_SLOT
        cars["walks"] = 1.0 if self._scenario.walk_back else np.where(plans.walks_back, 2.0, 1.0)
        cars["state"], cars["slot"] = DUE, NO_SLOT
        cars["ended_at"] = cars["left_at"] = np.inf
        self.drivers = self._drivers_in(plans, demand.class_names)
        self.zone_cost_s = self._zone_costs_by_rules()
        if plans.parked.any():
            cars["parked_at"][plans.parked] = self._slots_of_parked(plans.parked, demand, key)
        return begin

    def _drivers_in(self, plans: CarPlans, class_names: tuple[str, ...]) -> Drivers:
        scenario, cars = self._scenario, self.records
        classes = np.full(len(cars), scenario.class_bits(scenario.classes), np.int64)
        for bit, name in enumerate(class_names):
            classes |= (plans.classes >> bit & 1) * scenario.class_bits((name,))
        value_of_time = np.where(
            np.isnan(plans.value_of_time), scenario.driver.value_of_time, plans.value_of_time
        )
        return Drivers(cars["stay_s"], cars["arrival"], value_of_time, classes, plans.kwh)

    def zone_costs(self) -> FloatArray:
        return self._scenario.zone_cost_s(self.drivers)

    def drivers_of(self, cars: Any) -> Drivers:
        return Drivers(*(np.asarray(values)[cars] for values in self.drivers))

    def _zone_costs_by_rules(self) -> FloatArray | None:
        scenario, cars, lot = self._scenario, self.records, self._scenario.lot
        if not scenario.has_rules and (cars["walks"] == 1.0).all():
            return None
        if not np.isfinite(zone_prices(scenario.zone_rules, self.drivers)).all():
            raise InputError("Demand.stays: a stay is infinite, want finite ones where parking has a price")
        zone_cost_s = self.zone_costs()
        cars["n_forbidden"] = np.isinf(zone_cost_s) @ np.bincount(lot.zone_of_slot, minlength=len(lot.zones))
        return zone_cost_s

    def arrival_cost_s(self, car: int) -> FloatArray:
        """Return what arriving in each slot costs a car, (n_slots,) s: walk, and parking for its own stay."""
        problem, walks = self.scenarios[self.records["scenario_index"][car]], self.records["walks"][car]
        # Computed for all cars at once; for one at a time, tariffs take a millisecond each.
        known = self.zone_cost_s
        zone_cost_s = problem.zone_cost_s(self.drivers_of(car)) if known is None else known[car]
        parking_s = problem.lot.slot_parking_cost_s + zone_cost_s[problem.lot.zone_of_slot]
        return np.asarray(problem.walk_s * walks + parking_s + problem.enter_s)

    def _slots_of_parked(self, parked: BoolArray, demand: Demand | TownDemand, key: np.uint64) -> IntArray:
        cars, lot = self.records[parked], self._scenario.lot
        slots, u = np.empty(len(cars), np.int64), uniforms(key, SLOT_STREAM, len(cars))
        costs = (
            np.zeros((len(self.records), len(lot.zones))) if self.zone_cost_s is None else self.zone_cost_s
        )
        by_walk = np.argsort(self._walk_s, axis=1, kind="stable").astype(np.int64)
        place, walks = cars["scenario_index"].astype(np.int64), cars["walks"].astype(np.float64)
        first_counted = lot.n_slots - np.count_nonzero(lot.is_counted)
        of_lot = self._walk_s, by_walk, lot.zone_of_slot, lot.capacity.copy(), int(first_counted)
        _park_at_first(place, walks, u, costs[parked], *of_lot, slots)
        if lost := np.count_nonzero(slots < 0):
            purpose = demand.purposes[cars["purpose"][np.argmin(slots)]]
            raise InputError(
                f"demand.{purpose.name}.parked is {purpose.parked}, want no more cars than find room where they may "
                f"park when the hours begin: {lost} do not"
            )
        return slots


@compiled
def _park_at_first(
    place: IntArray, walks: FloatArray, u: FloatArray, zone_cost_s: FloatArray, walk_s: FloatArray, by_walk: IntArray,
    zone_of_slot: IntArray, left: IntArray, first_counted: int, slots: IntArray,
) -> None:  # fmt: skip
    """Choose slots for cars, one after another: the cheapest one by walk and price that is free and was so before.

    Cars are places that people walk to, factors of the walk and uniform numbers, (n,) each. `by_walk` are slots by
    `walk_s`, (n_places, n_slots); `left` are cars that still fit, counted down; counted facilities are the last slots,
    from `first_counted` on. The result is `slots`, (n,): -1 if none is left where the car may park.
    """
    cost_s, chosen = np.empty(_MOST_PASSED), np.empty(_MOST_PASSED, np.int64)
    for car in range(len(place)):
        wanted = 1 + min(int(math.log(u[car]) / math.log(_TAKEN_BEFORE)), _MOST_PASSED - 1)
        n = 0
        for slot in by_walk[place[car]]:
            walk = walks[car] * walk_s[place[car], slot]
            if n == wanted and walk >= cost_s[n - 1]:
                break
            cost = walk + zone_cost_s[car, zone_of_slot[slot]]
            if left[slot] == 0 or cost == np.inf or (n == wanted and cost >= cost_s[n - 1]):
                continue
            n = min(n + 1, wanted)
            at = n - 1
            while at > 0 and cost_s[at - 1] > cost:
                cost_s[at], chosen[at] = cost_s[at - 1], chosen[at - 1]
                at -= 1
            cost_s[at], chosen[at] = cost, slot
            if slot >= first_counted:
                n = wanted = at + 1
        slots[car] = chosen[n - 1] if n else -1
        if n:
            left[chosen[n - 1]] -= 1
