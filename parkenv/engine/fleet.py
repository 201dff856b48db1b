"""A world in which many cars arrive, search, compete for slots, park, stay and leave."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import dijkstra

from parkenv.compiled.jit import entry_point
from parkenv.compiled.keyed_random import SLOT_STREAM, car_uniforms, world_key
from parkenv.compiled.memory import address_of, sparse_zeros
from parkenv.engine.events import (
    FINISHED,
    NEEDS_FORECAST,
    NEEDS_REPORTS,
    NEEDS_RESERVATIONS,
    NEEDS_SEARCH,
    NEEDS_STEPS,
    PAUSED,
    WRONG_ACTION,
    act_at,
    advance_at,
    begin_world_at,
    init_forecast_at,
    release_at,
)
from parkenv.engine.kernel import (
    read_step,
    shared_slots_taken_at,
    step_result_at,
)
from parkenv.engine.local_observation import FIRST_NEAR, PER_NEAR, Surroundings, observe_surroundings_at
from parkenv.engine.parked import park_at_first
from parkenv.engine.policy import CompiledPolicy
from parkenv.engine.records import (
    BACKGROUNDS,
    CAR,
    COUNTED,
    DUE,
    FLEET,
    LIVE_SLOT,
    NO_CAR,
    NO_SLOT,
    REPORT,
    SEARCH,
    SEARCHING,
    SHARED_SLOT,
    SPARSE_SLOTS,
    STATES,
    STEP,
    UNGUIDED,
    ScenarioRecords,
    Searches,
    most_observed_in,
)
from parkenv.engine.spaces import action_number, space_of
from parkenv.errors import InputError, require_number, require_one_of, require_whole
from parkenv.files.known_names import KNOWLEDGE
from parkenv.scenarios.build import ScenarioSource, make_scenario
from parkenv.world.demand import CarPlans, Demand, TownDemand
from parkenv.world.lot import PARK, ParkingLot
from parkenv.world.occupancy.kernel import LOG_KIND, RECORDED_DAY, SHARED_KIND, draw_arrival
from parkenv.world.occupancy.process import Arrival
from parkenv.world.occupancy.python_functions import raise_error
from parkenv.world.scenario import Drivers, SearchProblem
from parkenv.world.week import DAY_S
from parkenv.world.week_hours import hour_of_week

_FIRST_CHUNK = 16
_UNREACHABLE_S = 1e9
_MOST_SEEN = 127  # cars at a vertex, as observed
MAX_STEPS = 2000
"""Default limit of a car's decisions, as in `parkenv/Search-v2`."""


@dataclass(frozen=True)
class DriverKind:
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

    weight: float = 1.0
    policy: CompiledPolicy | None = None
    knows: str = "own"
    shares: bool = False

    def __post_init__(self) -> None:
        require_number("DriverKind.weight", self.weight, least=0.0)
        if self.policy is not None and not isinstance(self.policy, CompiledPolicy):
            raise InputError(
                f"DriverKind.policy is {self.policy!r:.60}, want a CompiledPolicy, such as POLICIES['greedy-drive'], "
                "or None"
            )
        require_one_of("DriverKind.knows", self.knows, KNOWLEDGE)


class StepOutcome(NamedTuple):
    """What a car's last step brought."""

    begun: bool  # whether there was a step: not before the first decision
    reward: float
    parked: bool
    over: bool  # whether the search is over, but for the limit of steps
    info: dict[str, Any]  # see `parkenv/Search-v2`


class CarPoses(NamedTuple):
    """Where cars are."""

    xy: NDArray[np.float64]  # (k, 2) float64, m, centres
    yaw: NDArray[np.float64]  # (k,) float64, rad, headings


class Fleet:
    """Many cars in one lot, driven by compiled policies, by agents in Python, or by both.

    Every car is a search as in `parkenv/Search-v2`, with the same actions, observations and costs; its forecast is that
    of the scenario for its arrival. The slots are shared. Events happen in continuous time: at each moment, first
    parked cars leave, cars arrive, and cars whose step is over observe; then the cars that have to decide do so one
    after another, in the order of these events. Of two cars before the same free slot, the first to decide gets it, and
    the other one has a failed attempt.

    A car's search ends when it parks, when it has observed that every slot is taken (*gave up*), when its patience
    ends (*balked*), or at the limit of steps (*truncated*); the last three cost `give_up_s`. A parked car leaves
    after its stay. The world ends when all searches are over. Patience begins at the entry of a lot; in a town
    (`ParkingLot.is_town`), when the shortest way to the slot nearest to the goal would be over.

    Knowledge reaches a driver through its observations, so every agent uses it. The live map holds the last report of
    each slot. The guidance system knows the true state of every slot, and assigns slots again whenever a car with
    `reserve` decides, with the least total time to drive and walk (`scipy.optimize.linear_sum_assignment`). A car
    with `reserve` observes which slot is its own, and takes no other; others do not know of reservations and may be
    first. A car that knows every slot to be taken, or for which no slot is left, gives up, unless `leave_full_lot` is
    False.

    Cars pass through each other, unless `manoeuvre_s` is above 0. Then a car that parks, or leaves its slot, blocks the
    lane before it for that time, and a car that stands there blocks it, too; cars that reach it wait in a queue, which
    may grow back to the entry. (Residents leave without blocking.) With `leaving_soon_s` above 0, cars of the fleet and
    residents signal for that time that they are about to leave; a car that stands at such a slot, in a failed attempt
    or a wait, holds it until it drives on: attempts of other cars fail. A car observes lights and other cars within
    the view range of its sensor, in further keys of the observation:

    | Key | Space | Meaning | with |
    |-----|-------|---------|------|
    | `reserved` | `Box(-1, 1, (n_slots,), int8)` | 1: reserved for this car; -1: it knows of none | `reserve` |
    | `leaving` | `Box(0, 1, (n_slots,), int8)` | slots in view whose cars leave soon | `leaving_soon_s` |
    | `cars` | `Box(0, 127, (2, n_vertices), int8)` | other cars in view at each vertex; standing | `sees_cars` |
    | `driver` | `Box(0, inf, (6,), float64)` | its `Drivers`, stay first, and the factor of its walk | rules of zones |

    With one car, `Demand(Headways(1))` and the background `process`, the fleet is `parkenv/Search-v2` to the last bit.

    Args:
        scenario: see `parkenv.make_scenario`.
        demand: when cars arrive, how long they stay; by default one car.
        background: other cars that take slots: `residents`, which are parked when the world begins, drawn from the
            scenario's occupancy, and leave once; `process`, the scenario's occupancy all day; `none`: the lot is
            empty when the world begins. By default residents; none if cars of the demand are parked then.
        drivers: the kinds of drivers.
        max_steps: limit of a car's decisions.
        tick_s: durations of steps, and arrivals, are rounded up to multiples of this, s; 0: continuous time.
        delay_s: time after which a report is on the live map, s.
        leave_full_lot: whether a car gives up once it knows every slot to be taken; otherwise it searches on until its
            patience is at an end. An informed car knows it at once, so compare kinds of knowledge with False.
        manoeuvre_s: time for which a car that parks or leaves blocks its lane, s; 0: no car blocks a lane.
        leaving_soon_s: time for which cars signal that they are about to leave, s.
        sees_cars: whether observations hold the other cars in view.

    Attributes:
        scenarios: the scenarios of the cars, one for each goal with a weight; `cars["place"]` are indices into it.
        records: (1,) of the dtype FLEET.
        day: the day of the present world.

    Raises:
        InputError: a value out of its range; the message names the field.

    Examples:
        >>> from planners.heuristics.policies import POLICIES
        >>> from parkenv.world.demand import Demand, Headways
        >>> fleet = Fleet("campus", Demand(Headways(cars=3)), drivers=[DriverKind(policy=POLICIES["greedy-drive"])])
        >>> fleet.reset(seed=1)
        >>> fleet.run()
        >>> fleet.state_names()
        ['parked', 'parked', 'parked']
    """

    def __init__(
        self,
        scenario: ScenarioSource,
        demand: Demand | TownDemand | None = None,
        *,
        background: str | None = None,
        drivers: Sequence[DriverKind] = (DriverKind(),),
        max_steps: int = MAX_STEPS,
        tick_s: float = 0.0,
        delay_s: float = 0.0,
        leave_full_lot: bool = True,
        manoeuvre_s: float = 0.0,
        leaving_soon_s: float = 0.0,
        sees_cars: bool = False,
    ) -> None:
        self.scenario = make_scenario(scenario)
        self.demand = Demand() if demand is None else demand
        self.drivers = tuple(drivers)
        times = {
            "tick_s": tick_s,
            "delay_s": delay_s,
            "manoeuvre_s": manoeuvre_s,
            "leaving_soon_s": leaving_soon_s,
        }
        if background is None and isinstance(self.demand, Demand | TownDemand):
            background = "none" if any(one.parked for one in self.demand.purposes) else "residents"
        background = self._require(background, max_steps, times)
        self._options: dict[str, Any] = {
            "background": background,
            "drivers": self.drivers,
            "max_steps": max_steps,
            "leave_full_lot": leave_full_lot,
            "sees_cars": sees_cars,
            **times,
        }
        goals = self._weighted("goal_weights", self.demand.goal_weights, len(self.scenario.lot.goals))
        self.scenarios = tuple(self.scenario.at_goal(goal) for goal in goals) or (self.scenario,)
        lot = self.scenario.lot
        self._weighted("entry_weights", self.demand.entry_weights, len(lot.entries))
        entry = None if self.demand.entry_weights else self.scenario.entry
        self._entries = lot.entry_vertices if entry is None else lot.entry_vertices[[entry]]
        self.full_belief = any(kind.policy is None for kind in self.drivers)
        self._reserves = any(kind.knows == "reserve" for kind in self.drivers)
        # A car may learn of every slot at once, and attempt one.
        is_told = any(kind.knows in ("shared", "full") for kind in self.drivers)
        self._most_observed = 1 + lot.n_slots if is_told else most_observed_in(self.scenarios)
        self.records = np.zeros(1, FLEET)
        self._record = self.records[0]
        self._address = address_of(self.records, FLEET)
        self._tables = ScenarioRecords(self.scenarios)
        first = self._tables.records[0]
        self._record["world_kind"], self._world = first["world_kind"], int(first["world"])
        self._tables.records["world_kind"], self._tables.records["world"] = SHARED_KIND, self._address
        self._tables.records["leave_full_lot"] = leave_full_lot
        self._pool: list[Searches] = []
        self._moves: list[NDArray[np.uint8]] = []
        self._row: dict[int, tuple[Searches, int]] = {}
        self._copiers: dict[int, tuple[Callable[[], NDArray[Any]], ...]] = {}
        self._copy_masks = [mask.copy for mask in self.scenario.graph_masks]
        self._cars = np.zeros(0, CAR)
        self._record["background"] = BACKGROUNDS.index(background)
        self._record["max_steps"] = max_steps
        for name, value in times.items():
            self._record[name] = value
        self.sees_cars, self.leaving_soon_s = bool(sees_cars), float(leaving_soon_s)
        self._record["n_slots"], self._record["n_vertices"] = lot.n_slots, lot.n_vertices
        self._record["first_counted"] = lot.n_slots - np.count_nonzero(lot.is_counted)
        self._record["scenarios"] = self._tables.records.ctypes.data
        self.slots = np.zeros(lot.n_slots, SHARED_SLOT)
        cost_s = np.array([one.arrival_cost_s for one in self.scenarios])
        work = {
            "slots": self.slots,
            "live_map": np.zeros(lot.n_slots, LIVE_SLOT),
            "blocked_until": np.zeros(lot.n_vertices),
            "blocked_by": np.zeros(lot.n_vertices, np.int64),
            "junction_of_vertex": lot.junction_of_vertex,
            "by_cost": np.argsort(cost_s, axis=1, kind="stable").astype(np.int64),
            "counted": _counted(lot),
        }
        if self.scenario.has_rules:
            # Where a car may park depends on its driver.
            self._masks = np.ascontiguousarray(self.scenario.graph_masks, np.uint8)
            self._tables.records["action_masks"] = address_of(self._masks, self._masks.dtype)
        work["policy_data"] = self._policy_data()
        self._kept: dict[str, NDArray[Any]] = {}
        self._keep(work)
        if delay_s > 0.0:
            self._grow_reports()
        self._memory: dict[int, Any] = {}  # states of the agents of `run`, by car
        self._drive_s: dict[int, NDArray[np.float64]] = {}
        self._surroundings: dict[int, Surroundings] = {}

    def _require(self, background: str | None, max_steps: int, times: Mapping[str, float]) -> str:
        if not isinstance(self.demand, Demand | TownDemand):
            raise InputError(f"demand is a {type(self.demand).__name__}, want a Demand")
        if background not in BACKGROUNDS:
            raise InputError(f"background is {background!r}, want one of {', '.join(BACKGROUNDS)}")
        if not self.drivers or not all(isinstance(kind, DriverKind) for kind in self.drivers):
            raise InputError(f"drivers is {self.drivers!r:.60}, want at least one DriverKind")
        if not sum(kind.weight for kind in self.drivers) > 0.0:
            raise InputError("drivers: all weights are 0, want one above 0")
        require_whole("max_steps", max_steps, least=1)
        for name, value in times.items():
            require_number(name, value, least=0.0)
        return background

    def _weighted(self, name: str, weights: tuple[float, ...], n: int) -> range:
        if weights and len(weights) != n:
            raise InputError(
                f"Demand.{name} has {len(weights)} numbers, lot {self.scenario.lot.name!r} has {n} of these"
            )
        return range(len(weights))

    def _policy_data(self) -> NDArray[np.int64]:
        """Return the address of the data of each kind's compiled policy, 0 for those without."""
        self._data = [
            None if kind.policy is None else kind.policy.data_for(self.scenarios) for kind in self.drivers
        ]
        return np.array([0 if data is None else data.address for data in self._data], np.int64)

    def _keep(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Keep arrays alive, and write their addresses into the fields of the FLEET record."""
        for name, array in arrays.items():
            self._kept[name] = array
            self._record[name] = address_of(array, array.dtype)

    # ---- a world

    def reset(self, seed: int = 0, episode: int = 0) -> None:
        """Begin the world of a seed and an episode: equal numbers give equal arrivals, stays, kinds and residents."""
        record, key = self._record, world_key(seed, episode)
        window, occupancy = self.scenario.arrival, self.scenario.occupancy
        days = occupancy.arrival_days(window)
        day, arrival_s = draw_arrival(key, len(days), float(window.start_s), float(window.end_s))
        self.day, midnight = days[day], days[day].weekday * DAY_S
        begin_s = self.demand.begin_s(arrival_s)
        begin = midnight + begin_s
        _, hour, second = hour_of_week(begin)
        record["key"], record["day"], record["midnight"], record["arrival"] = key, day, midnight, begin
        record["hour"], record["second_of_hour"] = hour, second
        record["world"] = self._world + (day * RECORDED_DAY.itemsize if occupancy.kind == LOG_KIND else 0)
        if not self._world:
            self._made = occupancy.world(key, Arrival(begin, self.day.date))
            record["world"] = self._made.address
        self._write_cars(key, midnight, arrival_s)
        self._memory.clear()
        self._advance, self._act = entry_point(advance_at, 0, 0.0), entry_point(act_at, 0, 0)
        begin_world_at(self._address)
        raise_error()

    def _write_cars(self, key: np.uint64, midnight: float, arrival_s: float) -> None:
        plans = self.demand.draw(key, arrival_s, len(self._entries), self.day)
        n = len(plans.arrival_s)
        cars = np.zeros(n, CAR)
        cars["arrival"] = midnight + plans.arrival_s
        tick_s, begin = float(self._record["tick_s"]), float(self._record["arrival"])
        if tick_s > 0.0:
            cars["arrival"] = begin + np.ceil((cars["arrival"] - begin) / tick_s - 1e-9) * tick_s
        cars["entry"] = self._entries[plans.entry]
        cars["place"] = plans.goal
        cars["stay_s"] = plans.stay_s
        cars["patience_s"] = plans.patience_s + self._way_s[plans.goal, plans.entry]
        shares = np.cumsum([kind.weight for kind in self.drivers])
        cars["kind"] = np.minimum(
            np.searchsorted(shares / shares[-1], plans.kind, side="right"), len(self.drivers) - 1
        )
        policies = [0 if kind.policy is None else kind.policy.address for kind in self.drivers]
        cars["policy"] = np.array(policies, np.int64)[cars["kind"]]
        cars["knows"] = np.array([KNOWLEDGE.index(kind.knows) for kind in self.drivers])[cars["kind"]]
        cars["shares"] = np.array([kind.shares for kind in self.drivers])[cars["kind"]]
        cars["purpose"], cars["parked_at"] = plans.purpose, NO_CAR
        cars["walks"] = 1.0 if self.scenario.walk_back else np.where(plans.walks_back, 2.0, 1.0)
        cars["state"], cars["slot"] = DUE, NO_CAR
        cars["ended_at"] = cars["left_at"] = np.inf
        self._cars = cars
        self._drivers = self._drivers_in(plans)
        # Looking up fields takes a tenth of a decision in Python.
        self._states, self._vertices, self._addresses = cars["state"], cars["vertex"], cars["search"]
        capacity = max(n, sum(len(one.records) for one in self._pool))
        self._record["n_cars"], self._record["n_free"] = n, 0
        zone_cost_s = self._write_zone_costs()
        if plans.parked.any():
            cars["parked_at"][plans.parked] = self._slots_of_parked(plans.parked, zone_cost_s, key)
        self._keep(
            {
                "cars": cars,
                "step_times": np.zeros(n),
                "step_cars": np.zeros(n, np.int32),
                "departure_times": np.zeros(n),
                "departing_cars": np.zeros(n, np.int32),
                "event_ranks": np.zeros(n, np.int64),
                "ready": np.zeros(n, np.int64),
                "free_searches": np.zeros(capacity, np.int64),
            }
        )
        for searches in self._pool:
            self._add_free(searches)

    @cached_property
    def _way_s(self) -> NDArray[np.float64]:
        """Shortest drive by goal and entry, (n_goals, n_entries) s, in a town to the slot nearest to the goal.

        A lot that is no town is where its cars want to be: they search from the entry on.
        """
        lot = self.scenario.lot
        if not lot.is_town:
            return np.zeros((len(self.scenarios), len(self._entries)))
        drive_s = drive_times(self.scenario, self._entries)
        walk_s = np.array([one.walk_s for one in self.scenarios])
        nearest = np.where(np.isfinite(drive_s), walk_s[:, None], np.inf).argmin(axis=2)
        way_s = drive_s[np.arange(len(drive_s)), nearest]
        return np.where(np.isfinite(way_s), way_s, 0.0)

    def _write_zone_costs(self) -> NDArray[np.float64]:
        """Write what parking in each zone costs each car, where that matters; return it, (n_cars, n_zones) s."""
        cars, lot = self._cars, self.scenario.lot
        self._record["zone_cost_s"] = 0
        if not self.scenario.has_rules and (cars["walks"] == 1.0).all():
            return np.zeros((len(cars), len(lot.zones)))
        if not np.isfinite(self.scenario.zone_price(self.drivers_of(slice(None)))).all():
            raise InputError("Demand.stays: a stay is infinite, want finite ones where parking has a price")
        zone_cost_s = self.zone_cost_s()
        self._keep({"zone_cost_s": zone_cost_s})
        self._record["n_zones"] = len(lot.zones)
        slots_in = np.bincount(lot.zone_of_slot, minlength=len(lot.zones))
        cars["n_forbidden"] = np.isinf(zone_cost_s) @ slots_in
        return zone_cost_s

    def _slots_of_parked(
        self, parked: NDArray[np.bool_], zone_cost_s: NDArray[np.float64], key: np.uint64
    ) -> NDArray[np.int64]:
        """Return in which slots cars stand when the world begins; see `parkenv.engine.parked`."""
        cars, lot = self._cars[parked], self.scenario.lot
        slots, u = np.empty(len(cars), np.int64), np.empty(len(cars))
        car_uniforms(key, SLOT_STREAM, 0, u)
        walk_s = np.array([one.walk_s for one in self.scenarios])
        by_walk = np.argsort(walk_s, axis=1, kind="stable").astype(np.int64)
        place, walks = cars["place"].astype(np.int64), cars["walks"].astype(np.float64)
        cost = zone_cost_s[parked], walk_s, by_walk, lot.zone_of_slot
        first_counted = int(self._record["first_counted"])
        park_at_first(place, walks, u, *cost, lot.capacity.copy(), first_counted, slots)
        if lost := np.count_nonzero(slots < 0):
            purpose = self.demand.purposes[cars["purpose"][np.argmin(slots)]]
            raise InputError(
                f"demand.{purpose.name}.parked is {purpose.parked}, want no more cars than find room where they may "
                f"park when the hours begin: {lost} do not"
            )
        return slots

    def _drivers_in(self, plans: CarPlans) -> Drivers:
        """Return what decides where the cars may park and what it costs them."""
        usual, classes = self.scenario.driver, np.zeros(len(self._cars), np.int64)
        for bit, name in enumerate(self.demand.class_names):
            classes |= (plans.classes >> bit & 1) * self.scenario.class_bits((name,))
        value_of_time = np.where(np.isnan(plans.value_of_time), usual.value_of_time, plans.value_of_time)
        return Drivers(
            self._cars["stay_s"],
            self._cars["arrival"],
            value_of_time,
            classes | np.int64(self.scenario.class_bits(self.scenario.classes)),
            plans.kwh,
        )

    def _add_free(self, searches: Searches) -> None:
        """Add SEARCH records to those that are free."""
        first, n = int(self._record["n_free"]), len(searches.records)
        addresses = searches.address + np.arange(n)[::-1] * SEARCH.itemsize
        self._kept["free_searches"][first : first + n] = addresses
        self._record["n_free"] = first + n

    def _grow_pool(self) -> None:
        """Make more SEARCH records, so that more cars can search at a time."""
        size = sum(len(one.records) for one in self._pool)
        n = min(max(_FIRST_CHUNK, size), max(len(self._cars) - size, 1))
        sparse = self.scenario.lot.n_slots >= SPARSE_SLOTS
        most_observed = self._most_observed if self.full_belief else 0
        searches = Searches(self._tables, n, self.full_belief, most_observed, sparse)
        # A route may pass the street where it begins once more.
        moves = sparse_zeros((n, 2 * self.scenario.lot.n_vertices), np.uint8)
        searches.records["moves"] = address_of(moves, np.uint8) + np.arange(n) * moves.shape[1]
        self._pool.append(searches)
        self._moves.append(moves)
        rows = {searches.address + row * SEARCH.itemsize: (searches, row) for row in range(n)}
        self._row |= rows
        if self.full_belief:
            self._copiers |= {address: searches.copiers(row) for address, (_, row) in rows.items()}
        self._add_free(searches)

    def keep_steps(self) -> None:
        """From now on, keep the steps of all cars; `steps` returns those of the present world."""
        if not self._record["step_capacity"]:
            self._grow_steps()

    @property
    def steps(self) -> NDArray[np.void]:
        """Steps of all cars since `keep_steps`, (n,) of the dtype STEP, in order of their beginning."""
        return self._kept.get("steps", np.zeros(0, STEP))[: int(self._record["n_kept_steps"])].copy()

    def take_steps(self) -> NDArray[np.void]:
        """Return the kept steps, and keep only later ones: a day with many cars has more than fit into memory."""
        steps = self.steps
        self._record["n_kept_steps"] = 0
        return steps

    # ---- decisions

    def run(self, agents: Sequence[Any] | None = None, until: float = math.inf) -> None:
        """Run the world until all searches are over, or until a time; a later call goes on from there.

        Args:
            agents: for each kind of driver without a policy an agent with `predict(observation, state)`, None for the
                others; not needed if all have policies.
            until: s since Monday 00:00; parked cars leave until then, also after the last search.

        Raises:
            InputError: a kind of driver has neither a policy nor an agent, or an agent raised an error (the cause of
                this one) or chose an action that does not exist: the message names car and time, and the world stays as
                it was before that decision.
        """
        agents = tuple(agents or ())
        for kind, driver in enumerate(self.drivers):
            if driver.policy is None and (kind >= len(agents) or agents[kind] is None):
                raise InputError(f"drivers[{kind}] has no policy, want an agent for it in `agents`")
        memory = self._memory
        while (car := self.next_decision(until)) is not None:
            agent = agents[int(self._cars["kind"][car])]
            try:
                k = getattr(agent, "local_k", None)  # models observe `local`
                observation = self.observation(car) if k is None else self.local_observation(car, k)
                action, memory[car] = agent.predict(observation, memory.get(car))
            except (Exception, SystemExit) as error:
                raise InputError(
                    f"car {car}: its agent raised {type(error).__name__} at {self.time - self.begin:.1f} s: {error}"
                ) from error
            try:
                self.act(action)
            except InputError as error:
                raise InputError(
                    f"car {car}: its agent at {self.time - self.begin:.1f} s: {error}"
                ) from error
            if self._states[car] != SEARCHING:
                memory.pop(car, None)

    def next_decision(self, until: float = math.inf) -> int | None:
        """Return the car that must decide next, in Python; None if there is no such decision before the end.

        Compiled policies decide in between.
        """
        while (car := self.next_car(until)) is not None and self._states[car] != SEARCHING:
            self.release()
        return car

    def next_car(self, until: float = math.inf) -> int | None:
        """As `next_decision`, but return also cars whose search is over, once each; then call `release`."""
        if not len(self._cars):
            raise ResetNeeded("the fleet has no world yet: call reset() first")
        while True:
            status: int = self._advance(self._address, until)
            if not self._world:
                raise_error()
            if status >= 0:
                return status
            if status in (FINISHED, PAUSED):
                return None
            self.help(status)

    def help(self, status: int) -> None:
        """Handle a request of the compiled engine, a negative status of `advance_at`; then call that again."""
        if status == WRONG_ACTION:
            raise InputError("a compiled policy chose an action that does not exist")
        {
            NEEDS_SEARCH: self._grow_pool,
            NEEDS_FORECAST: self._compute_forecast,
            NEEDS_REPORTS: self._grow_reports,
            NEEDS_RESERVATIONS: self._reserve_slots,
            NEEDS_STEPS: self._grow_steps,
        }[status]()

    def ready_cars(self) -> list[int]:
        """Return the cars that are to decide, or whose end Python has not handled yet, now, in their order."""
        first, n = int(self._record["first_ready"]), int(self._record["n_ready"])
        places = (first + np.arange(n)) % max(len(self._cars), 1)
        return [int(car) for car in self._kept["ready"][places]]

    def act(self, action: Any) -> None:
        """Carry out the decision of the car from `next_decision`.

        Raises:
            InputError: an action that is none of the five.
        """
        self._act(self._address, action_number(action))

    def release(self) -> None:
        """Drop the car from `next_car` whose search is over; its observation is gone."""
        release_at(self._address)

    def _compute_forecast(self) -> None:
        """Compute the external forecast of the car that has just arrived."""
        searches, row = self._row[int(self._cars["search"][self._record["pending"]])]
        searches.complete_arrival(row)
        init_forecast_at(self._address)

    def _grow_reports(self) -> None:
        """Make room for more reports that are not on the live map yet."""
        first, n = int(self._record["first_report"]), int(self._record["n_reports"])
        old = self._kept.get("reports", np.zeros(0, REPORT))
        reports = np.zeros(2 * max(len(old), 2 * len(self.slots), 1024), REPORT)
        reports[:n] = np.roll(old, -first)[:n]
        self._keep({"reports": reports})
        self._record["first_report"], self._record["report_capacity"] = 0, len(reports)

    def _grow_steps(self) -> None:
        """Make room for more steps that are kept."""
        old = self._kept.get("steps", np.zeros(0, STEP))
        steps = np.zeros(max(2 * len(old), 4096), STEP)
        steps[: len(old)] = old
        self._keep({"steps": steps})
        self._record["step_capacity"] = len(steps)

    def _reserve_slots(self) -> None:
        """Assign free slots to the searching cars of the guidance system, at the least total time."""
        cars = self._cars
        members = np.flatnonzero((cars["state"] == SEARCHING) & (cars["knows"] == KNOWLEDGE.index("reserve")))
        room = np.minimum(self.scenario.lot.capacity - self.counts(), len(members))
        free = np.repeat(np.arange(len(room)), np.maximum(room, 0))
        reserved = np.full(len(members), NO_SLOT)
        if len(free):
            cost_s = np.array([self._time_to_slots(int(car))[free] for car in members])
            rows, columns = linear_sum_assignment(np.minimum(cost_s, _UNREACHABLE_S))
            reached = cost_s[rows, columns] < _UNREACHABLE_S
            reserved[rows[reached]] = free[columns[reached]]
        for car, slot in zip(members, reserved, strict=True):
            searches, row = self._row[int(cars["search"][car])]
            searches.records["reserved"][row] = slot
        self._record["reservations_stale"] = False

    def _time_to_slots(self, car: int) -> NDArray[np.float64]:
        """Return how long a searching car takes via each slot: step under way, drive, walk and cost, (n_slots,) s."""
        searches, row = self._row[int(self._cars["search"][car])]
        record = searches.records[row]
        vertex = int(record["vertex"])
        if vertex not in self._drive_s:
            self._drive_s[vertex] = drive_times(self.scenario, vertex)
        return np.asarray(record["time"] - self.time + self._drive_s[vertex] + self.arrival_cost_s(car))

    def arrival_cost_s(self, car: int) -> NDArray[np.float64]:
        """Return what arriving in each slot costs a car, (n_slots,) s: walk, and parking for its own stay."""
        problem, walks = self.scenarios[self._cars["place"][car]], self._cars["walks"][car]
        # Computed for all cars at once; for one at a time, tariffs take a millisecond each.
        known = self._record["zone_cost_s"]
        zone_cost_s = self._kept["zone_cost_s"][car] if known else problem.zone_cost_s(self.drivers_of(car))
        parking_s = problem.lot.slot_parking_cost_s + zone_cost_s[problem.lot.zone_of_slot]
        return np.asarray(problem.walk_s * walks + parking_s + problem.enter_s)

    def zone_cost_s(self) -> NDArray[np.float64]:
        """Return what parking in each zone costs each car, (n_cars, n_zones) s; see `SearchProblem.zone_cost_s`."""
        return self.scenario.zone_cost_s(self.drivers_of(slice(None)))

    def drivers_of(self, cars: Any) -> Drivers:
        """Return what decides where some cars, an index of `cars`, may park and what it costs them."""
        return Drivers(*(np.asarray(values)[cars] for values in self._drivers))

    # ---- what is known of cars and slots

    @property
    def observation_space(self) -> spaces.Dict:
        """The space of a car's observations: that of `parkenv/Search-v2`, and further keys; see the class."""
        space, lot = space_of(self.scenarios, self._most_observed), self.scenario.lot
        further: dict[str, spaces.Space[Any]] = {}
        if self._reserves:
            further["reserved"] = spaces.Box(-1, 1, (lot.n_slots,), np.int8)
        if self.leaving_soon_s > 0.0:
            further["leaving"] = spaces.Box(0, 1, (lot.n_slots,), np.int8)
        if self.scenario.has_rules:
            further["driver"] = spaces.Box(0.0, np.inf, (6,), np.float64)
        if self.sees_cars:
            further["cars"] = spaces.Box(0, _MOST_SEEN, (2, lot.n_vertices), np.int8)
        return spaces.Dict(dict(space.items()) | further)

    def observation(self, car: int) -> dict[str, Any]:
        """Return what a searching car observed last, as in `parkenv/Search-v2`."""
        address, vertex = self._search_of(car), self._vertices[car]
        time, p_occupied, belief, step_observed, day_error = self._copiers[address]
        observation = {
            "vertex": vertex,
            "time": time(),
            "p_occupied": p_occupied(),
            "belief": belief(),
            "step_observed": step_observed(),
            "day_error": day_error(),
            "action_mask": self._mask(car, vertex),
        }
        if self._reserves:
            searches, row = self._row[address]
            reserved = searches.records["reserved"][row]
            mine = np.arange(len(self.slots)) == reserved
            observation["reserved"] = mine.astype(np.int8) - np.int8(reserved == UNGUIDED)
        if self.leaving_soon_s > 0.0:
            observation["leaving"] = self._leaving_in_view(int(vertex))
        if self.scenario.has_rules:
            observation["driver"] = np.array([*self.drivers_of(car), self._cars["walks"][car]], np.float64)
        if self.sees_cars:
            observation["cars"] = self._cars_in_view(car, int(vertex))
        return observation

    def local_observation(self, car: int, k: int = 5) -> dict[str, Any]:
        """Return the `local` observation of a searching car, with k slots; to be called once at each of its decisions.

        `parkenv.engine.local_observation` describes it.
        """
        address = self._search_of(car)
        if k not in self._surroundings:
            self._surroundings[k] = Surroundings.of(self.scenarios, k)
        around = self._surroundings[k]
        local = np.empty(FIRST_NEAR + PER_NEAR * k, np.float32)
        observe_surroundings_at(address, around, local)
        return {"local": local, "action_mask": self._mask(car, self._vertices[car])}

    def _mask(self, car: int, vertex: int) -> NDArray[np.int8]:
        """Return the actions that a car has at a vertex, (5,): those of the graph, and parking where it may."""
        mask: NDArray[np.int8] = self._copy_masks[vertex]()
        if mask[PARK] and self.scenario.has_rules:
            mask[PARK] = np.isfinite(self._kept["zone_cost_s"][car, self.scenario.lot.zone_of_slot[vertex]])
        return mask

    def _leaving_in_view(self, vertex: int) -> NDArray[np.int8]:
        """Return which slots in view of a vertex hold a car that shows that it leaves, (n_slots,)."""
        leaving = np.zeros(len(self.slots), np.int8)
        viewed = self.scenario.in_view(vertex)
        left_s = self.slots["leaves_at"][viewed] - self.time
        leaving[viewed] = (left_s > 0.0) & (left_s <= self.leaving_soon_s)
        return leaving

    def _cars_in_view(self, car: int, vertex: int) -> NDArray[np.int8]:
        """Return the numbers of other searching cars by vertex, and of those that stand, (2, n_vertices)."""
        seen = np.zeros((2, self.scenario.lot.n_vertices), np.int8)
        others = self._cars["state"] == SEARCHING
        others[car] = False
        at, stands = self._cars["vertex"][others], self._cars["stands"][others]
        xy = self.scenario.lot.vertex_xy
        near = np.hypot(*(xy[at] - xy[vertex]).T) <= self.scenario.sensor_model.view_range
        for row, which in enumerate((near, near & stands)):
            count = np.bincount(at[which], minlength=seen.shape[1])
            seen[row] = np.minimum(count, _MOST_SEEN)
        return seen

    def outcome(self, car: int) -> StepOutcome:
        """Return the result of a car's last step."""
        address = self._search_of(car)
        place = self.scenarios[self._cars["place"][car]].name
        reward, over, _, info = read_step(place, step_result_at(address))
        searches, row = self._row[address]
        begun = bool(searches.records["n_steps"][row])
        return StepOutcome(begun, reward, info["parked"], over, info)

    def _search_of(self, car: int) -> int:
        """Return the address of the SEARCH record of a car that searches."""
        address = int(self._addresses[car])
        if address == 0:
            raise InputError(f"car {car} is {self.state_names()[car]}, want one that searches")
        if not self.full_belief:
            raise InputError("observations are kept only if a kind of driver has no policy")
        return address

    @property
    def cars(self) -> NDArray[np.void]:
        """The cars, (n_cars,) of the dtype CAR, in order of arrival; a live view."""
        return self._cars

    def state_names(self) -> list[str]:
        """Return the state of each car by name; see `parkenv.engine.records.STATES`."""
        return [STATES[state] for state in self._cars["state"]]

    def poses(self) -> CarPoses:
        """Return where the searching cars are now; a car under way is between two vertices."""
        cars = self._cars[self._cars["state"] == SEARCHING]
        records = np.array(
            [self._row[int(address)][0].records[self._row[int(address)][1]] for address in cars["search"]]
        )
        if not len(cars):
            return CarPoses(np.zeros((0, 2)), np.zeros(0))
        xy, ahead = self.scenario.lot.vertex_xy, records["vertex"]
        behind, left = records["previous_vertex"], records["time"] - self.time
        share = np.clip(left / np.maximum(records["step_drive_s"], 1e-9), 0.0, 1.0)
        # A failed attempt, a wait or a queue: the car stands.
        share[(records["step_failed_s"] > 0.0) | (cars["queues_since"] <= self.time)] = 0.0
        step = xy[behind] - xy[ahead]
        yaw = np.where(
            behind == ahead, self.scenario.lot.vertex_yaw[ahead], np.arctan2(-step[:, 1], -step[:, 0])
        )
        return CarPoses(xy[ahead] + share[:, None] * step, yaw)

    def counts(self) -> NDArray[np.int64]:
        """Return how many cars are in each slot now, (n_slots,): at most 1, but for counted facilities."""
        counts, counted = self.taken().astype(np.int64), self._kept["counted"]["n_cars"]
        counts[len(counts) - len(counted) :] = counted
        return counts

    def taken(self) -> NDArray[np.bool_]:
        """Return whether each slot is taken now, (n_slots,)."""
        taken = np.zeros(len(self.slots), np.bool_)
        shared_slots_taken_at(self._address, self.time, taken)
        return taken

    @property
    def address(self) -> int:
        """Address of the FLEET record, for compiled code; valid while this object lives."""
        return self._address

    @property
    def begin(self) -> float:
        """When the world began, s since Monday 00:00."""
        return float(self._record["arrival"])

    @property
    def time(self) -> float:
        """The time now, s since Monday 00:00."""
        return float(self._record["time"])

    @property
    def totals(self) -> dict[str, float]:
        """Numbers of cars now: due, searching, parked, gone; decisions so far; integrals of cars over time, s."""
        record = self._record
        counts = {name: float(record[f"n_{name}"]) for name in ("searching", "parked", "gone", "decisions")}
        sums = {name: float(record[name]) for name in ("searching_s", "parked_s")}
        return {"due": float(record["n_cars"] - record["next_car"])} | counts | sums

    @property
    def n_bytes(self) -> int:
        """Memory of cars, slots and searches, bytes, without the tables of the scenario."""
        arrays = [*self._kept.values(), *self._moves]
        return sum(array.nbytes for array in arrays) + sum(one.n_bytes for one in self._pool)

    def __reduce__(self) -> tuple[Callable[..., Fleet], tuple[Any, ...]]:
        """Copies and pickles are fleets before their first reset: records hold addresses of this process."""
        return partial(Fleet, **self._options), (self.scenario, self.demand)


def _counted(lot: ParkingLot) -> NDArray[Any]:
    """Return the COUNTED records of a lot's counted facilities."""
    facilities = [facility for facility in lot.facilities if facility.is_counted]
    counted = np.zeros(len(facilities), COUNTED)
    for record, facility in zip(counted, facilities, strict=True):
        for name in ("capacity", "gate_s", "inside_s", "delay_s"):
            record[name] = getattr(facility, name)
    return counted


def drive_times(problem: SearchProblem, vertex: int | NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the shortest drive time from a vertex, or several, to each slot's stop position, (..., n_slots) s.

    It is infinite where there is no way.
    """
    return drive_metres(problem.lot, vertex, timed=True) / problem.v_drive


def drive_metres(
    lot: ParkingLot, vertex: int | NDArray[np.int64], *, timed: bool = False
) -> NDArray[np.float64]:
    """Return the shortest drive from a vertex, or several, to each slot, (..., n_slots) m; see `drive_matrix`."""
    metres = dijkstra(lot.drive_matrix(timed), indices=np.asarray(vertex))
    return np.asarray(metres[..., : lot.n_slots])
