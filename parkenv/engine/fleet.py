"""A world in which many cars arrive, search, compete for slots, park, stay and leave."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from parkenv.compiled.jit import entry_point
from parkenv.compiled.keyed_random import world_key
from parkenv.engine import events
from parkenv.engine.fleet_cars import DriverKind, FleetCars, FleetOptions
from parkenv.engine.fleet_memory import FleetMemory
from parkenv.engine.records import NO_SLOT, RESERVE_KNOWLEDGE, SEARCH, SEARCHING, STATES
from parkenv.engine.spaces import action_number
from parkenv.errors import InputError
from parkenv.scenarios.build import ScenarioSource, make_scenario
from parkenv.world.demand import Demand, TownDemand
from parkenv.world.occupancy.kernel import LOG_KIND, RECORDED_DAY, draw_arrival, hour_of_week
from parkenv.world.occupancy.process import Arrival, raise_error
from parkenv.world.scenario import drive_times

__all__ = ["DriverKind", "Fleet", "FleetOptions"]

_UNREACHABLE_S = 1e9
_RELEASED = -100.0  # in the course of a world, beside the times of `next_car`, and -1 - action of `act`


class Fleet(FleetMemory):
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
    may grow back to the entry. (Residents leave without blocking.) In a scenario with `cues`, a car that stands at a
    slot whose car is about to leave, in a failed attempt or a wait, holds it until it drives on: attempts of other
    cars fail. A car observes cues and other cars within the view range of its sensor, in further keys of the
    observation:

    | Key | Space | Meaning | with |
    |-----|-------|---------|------|
    | `reserved` | `Box(-1, 1, (n_slots,), int8)` | 1: reserved for this car; -1: it knows of none | `reserve` |
    | `cues` | `Box((3 * n_slots,), float32)` | as in `parkenv/Search-v2` | `scenario.cues` |
    | `cars` | `Box(0, 127, (2, n_vertices), int8)` | other cars in view at each vertex; standing | `sees_cars` |
    | `driver` | `Box(0, inf, (6,), float64)` | its `Drivers`, stay first, and the factor of its walk | rules of zones |

    With one car, `Demand(Headways(1))` and the background `process`, the fleet is `parkenv/Search-v2` to the last bit.

    Args:
        scenario: see `parkenv.make_scenario`.
        demand: when cars arrive, how long they stay; by default one car.
        options: the options.
        changes: fields of the options to replace.

    Attributes:
        scenario, demand, options, drawn, scenarios, cars, slots, address: see `FleetMemory`.
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
        options: FleetOptions = FleetOptions(),  # noqa: B008 - it is frozen
        **changes: Any,
    ) -> None:
        self.scenario = make_scenario(scenario)
        self.demand = Demand() if demand is None else demand
        if not isinstance(self.demand, Demand | TownDemand):
            raise InputError(f"demand is a {type(self.demand).__name__}, want a Demand")
        options = replace(options, **changes)
        if options.background is None:
            stand = any(purpose.parked for purpose in self.demand.purposes)
            options = replace(options, background="none" if stand else "residents")
        super().__init__(FleetCars(self.scenario, self.demand, options), options)
        self._agent_states: dict[int, Any] = {}  # of the agents of `run`, by car
        self._drive_s: dict[int, NDArray[np.float64]] = {}  # to all slots, by vertex
        self._began = (0, 0)  # seed and episode
        self._past = array("d")  # what was called since

    # ---- a world

    def reset(self, seed: int = 0, episode: int = 0) -> None:
        """Begin the world of a seed and an episode: equal numbers give equal arrivals, stays, kinds and residents."""
        self._began, self._past = (seed, episode), array("d")
        record, key = self.record, world_key(seed, episode)
        window, occupancy = self.scenario.arrival, self.scenario.occupancy
        days = occupancy.arrival_days(window)
        day, arrival_s = draw_arrival(key, len(days), float(window.start_s), float(window.end_s))
        self.day = days[day]
        begin = self.drawn.draw(self.demand, key, arrival_s, self.day)
        _, hour, second = hour_of_week(begin)
        record["key"], record["day"], record["arrival"] = key, day, begin
        record["midnight"], record["hour"], record["second_of_hour"] = self.drawn.midnight, hour, second
        record["world"] = self.world + (day * RECORDED_DAY.itemsize if occupancy.kind == LOG_KIND else 0)
        if not self.world:
            self._made_world = occupancy.world(key, Arrival(begin, self.day.date))
            record["world"] = self._made_world.address
        self.hold_cars(self.drawn.records, self.drawn.zone_cost_s)
        self._agent_states.clear()
        self._advance, self._act = entry_point(events.advance_at, 0, 0.0), entry_point(events.act_at, 0, 0)
        events.begin_world_at(self.address)
        raise_error()

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
        states = self._agent_states
        while (car := self.next_decision(until)) is not None:
            agent = agents[int(self.cars["kind"][car])]
            try:
                k = getattr(agent, "local_k", None)  # models observe `local`
                observation = self.observation(car) if k is None else self.local_observation(car, k)
                action, states[car] = agent.predict(observation, states.get(car))
                self.act(action)
            except (Exception, SystemExit) as error:
                raise InputError(
                    f"car {car}: its agent raised {type(error).__name__} at {self.time - self.begin:.1f} s: {error}"
                ) from error
            if self._states[car] != SEARCHING:
                states.pop(car, None)

    def next_decision(self, until: float = math.inf) -> int | None:
        """Return the car that must decide next, in Python; None if there is no such decision before the end.

        Compiled policies decide in between.
        """
        while (car := self.next_car(until)) is not None and self._states[car] != SEARCHING:
            self.release()
        return car

    def next_car(self, until: float = math.inf) -> int | None:
        """As `next_decision`, but return also cars whose search is over, once each; then call `release`."""
        if not len(self.cars):
            raise ResetNeeded("the fleet has no world yet: call reset() first")
        self._past.append(until)
        while True:
            status: int = self._advance(self.address, until)
            if not self.world:
                raise_error()
            if status >= 0:
                return status
            if status in (events.FINISHED, events.PAUSED):
                return None
            if status == events.WRONG_ACTION:
                raise InputError("a compiled policy chose an action that does not exist")
            if status == events.NEEDS_RESERVATIONS:
                self._reserve_slots()
            else:
                self._requests[status]()

    def ready_cars(self) -> list[int]:
        """Return the cars that are to decide, or whose end Python has not handled yet, now, in their order."""
        first, n = int(self.record["first_ready"]), int(self.record["n_ready"])
        ready = self.arrays["ready"]
        return [int(car) for car in ready[(first + np.arange(n)) % max(len(ready), 1)]]

    def act(self, action: Any) -> None:
        """Carry out the decision of the car from `next_decision`.

        Raises:
            InputError: an action that is none of the five.
        """
        number = action_number(action)
        self._act(self.address, number)
        self._past.append(-1.0 - number)

    def release(self) -> None:
        """Drop the car from `next_car` whose search is over; its observation is gone."""
        events.release_at(self.address)
        self._past.append(_RELEASED)

    def _reserve_slots(self) -> None:
        cars = self.cars
        members = np.flatnonzero((cars["state"] == SEARCHING) & (cars["knows"] == RESERVE_KNOWLEDGE))
        room = np.clip(self.scenario.lot.capacity - self.counts(), 0, len(members))
        free, reserved = np.repeat(np.arange(len(room)), room), np.full(len(members), NO_SLOT)
        if len(free):
            time_s = np.array([self.time_to_slots(int(car))[free] for car in members])
            rows, columns = linear_sum_assignment(np.minimum(time_s, _UNREACHABLE_S))
            reached = time_s[rows, columns] < _UNREACHABLE_S
            reserved[rows[reached]] = free[columns[reached]]
        for car, slot in zip(members, reserved, strict=True):
            self.search_of(cars["search"][car])["reserved"] = slot
        self.record["reservations_stale"] = False

    def time_to_slots(self, car: int) -> NDArray[np.float64]:
        """Return how long a searching car takes via each slot: step under way, drive, walk and cost, (n_slots,) s."""
        search = self.search_of(self.cars["search"][car])
        vertex = int(search["vertex"])
        if vertex not in self._drive_s:
            self._drive_s[vertex] = drive_times(self.scenario, vertex)
        return np.asarray(search["time"] - self.time + self._drive_s[vertex] + self.drawn.arrival_cost_s(car))

    # ---- cars and slots

    def state_names(self) -> list[str]:
        """Return the state of each car by name; see `parkenv.engine.records.STATES`."""
        return [STATES[state] for state in self.cars["state"]]

    def poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return centres, (k, 2) m, and headings, (k,) rad, of the cars that search now; most are between vertices."""
        cars, lot = self.cars[self.cars["state"] == SEARCHING], self.scenario.lot
        searches = np.array([self.search_of(address) for address in cars["search"]], SEARCH)
        ahead, behind = searches["vertex"], searches["previous_vertex"]
        left_s = searches["time"] - self.time
        share = np.clip(left_s / np.maximum(searches["step_drive_s"], 1e-9), 0.0, 1.0)
        # A failed attempt, a wait or a queue: the car stands.
        share[(searches["step_failed_s"] > 0.0) | (cars["queues_since"] <= self.time)] = 0.0
        step = lot.vertex_xy[behind] - lot.vertex_xy[ahead]
        yaw = np.where(behind == ahead, lot.vertex_yaw[ahead], np.arctan2(-step[:, 1], -step[:, 0]))
        return lot.vertex_xy[ahead] + share[:, None] * step, yaw

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles repeat the world from its beginning: records hold addresses of this process."""
        made = Fleet, (self.scenario, self.demand, self.options)
        return (*made, (self._began, self._past, dict(self._agent_states))) if len(self.cars) else made

    def __setstate__(self, course: tuple[tuple[int, int], array[float], dict[int, Any]]) -> None:
        began, past, agent_states = course
        self.reset(*began)
        for called in past:
            if called == _RELEASED:
                self.release()
            elif called < 0.0:
                self.act(int(-1.0 - called))
            else:
                self.next_car(called)
        self._agent_states = agent_states
