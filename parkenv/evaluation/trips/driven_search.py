"""The whole trip: an agent decides on the drive graph, and a car drives it, from the entry into the slot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.wrappers import TimeLimit

from parkenv.driving.vehicle import VehicleParameters
from parkenv.envs.perception import OnboardPerception
from parkenv.envs.search import SearchEnv
from parkenv.envs.search_step import (
    DRIVEN_M,
    FAILED_PARKS,
    STEP_DRIVE,
    STEP_FAILED,
    STEP_WALK,
    STEPS,
    TIME,
    drive_or_park,
    learn,
    look,
    renew,
    settle,
    touched,
)
from parkenv.envs.sensor_sampler import Station
from parkenv.errors import InputError
from parkenv.evaluation.simulate import STEP_LIMIT, Observer, adapt_to_agent, simulate
from parkenv.evaluation.trips.driver import Driver, Leg, Try
from parkenv.evaluation.trips.lot_driver import DrivingStyle, LotDriver
from parkenv.world.lot import PARK
from parkenv.world.scenario import Scenario
from planners.agent import Agent, make_agent
from sim_sensors.rig import SensorRig


class DrivenSearchEnv(SearchEnv):
    """`parkenv/Search-v1` in which time passes as it does on the road.

    World, observations and decisions are those of `parkenv/Search-v1`. What an edge, a try and the parking take is
    asked of a driver; a try fails as well where the car does not get into a free slot, which it then holds for taken.
    The time of the manoeuvre into the slot counts as driven.

    Args:
        scenario: the scenario.
        driver: who drives; with a `GraphDriver` this is `parkenv/Search-v1` itself.
        perception: sensors on the car, whose scenario this is: the belief is updated from what they measure on the
            driven path, as in `parkenv/SearchPerception-v1`. None: slots are observed from the vertices, with the
            scenario's sensor model.
    """

    def __init__(
        self, scenario: Scenario, driver: Driver, perception: OnboardPerception | None = None
    ) -> None:
        super().__init__(scenario)
        self.driver, self.perception = driver, perception
        self._refused: set[int] = set()
        self.manoeuvre: Try | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start a search, and the car at the entry."""
        if self.perception is not None:
            self.perception.reset()
        result = super().reset(seed=seed, options=options)
        state = self.state
        self._refused.clear()
        self.manoeuvre = None
        self.driver.begin(state.key, state.world, state.vertex, state.time)
        return result

    def _advance(self, action: int) -> None:
        """Have the action driven, and let as much time pass as that took."""
        state, search = self._state, self.search
        numbers = search.numbers[0]
        vertex, before = state.vertex, state.time
        possible = self.scenario.action_masks[vertex, action] == 1
        if possible and action == PARK:
            self._park(vertex, before)
        elif possible:
            seconds = self.driver.drive(vertex, action)
            drive_or_park(search, 0, action)
            numbers[STEP_DRIVE], numbers[TIME] = seconds, before + seconds
        else:
            self.driver.wait(self.scenario.wait_s)
            drive_or_park(search, 0, action)
        if not state.parked:
            self._see(on_the_way=possible and action != PARK)
            for slot in self._refused:
                # It looks free, and is of no use to this car.
                learn(search, 0, touched(search, 0, slot), True, 1.0)
        settle(search, 0)
        renew(search, 0)
        self._clock[:] = state.time, state.time - state.arrival.time

    def _see(self, *, on_the_way: bool) -> None:
        """Tell the belief what the slots look like from where the car is, and from where it has been on its way."""
        perception = self.perception
        if perception is None:
            look(self.search, 0)
            return
        # After a try, or a wait, the car looks around once more; what it saw from amid the manoeuvre is of no use.
        track = self.driver.track if on_the_way else self.driver.track[-1:]
        stations: list[Station] = []
        if track:
            chosen = perception.sampler.select_stations(np.array([spot.driven_m for spot in track]))
            spots = [track[i] for i in chosen.tolist()]
            stations = [Station(s.time, s.pose, self.driver.movers_at(s)) for s in spots]
        perception.update_belief(self.search, perception.sampler.sample(self._state, stations))

    def _park(self, slot: int, before: float) -> None:
        search, state = self.search, self._state
        numbers, counts = search.numbers[0], search.counts[0]
        taken = bool(state.world.occupied(np.array([slot]), before)[0])
        outcome = self.driver.park(slot, taken)
        if taken or not outcome.reason:
            drive_or_park(search, 0, PARK)
        else:
            self._refused.add(slot)
            counts[FAILED_PARKS] += 1
            counts[STEPS] += 1
            numbers[STEP_WALK] = 0.0
        if not outcome.reason:
            self.manoeuvre = outcome
        lost = outcome.seconds if outcome.reason else 0.0
        numbers[STEP_DRIVE], numbers[STEP_FAILED] = outcome.seconds - lost, lost
        numbers[TIME] = before + outcome.seconds


@dataclass(frozen=True)
class Trip:
    """One trip, driven from the entry to the goal.

    Attributes:
        seed: of the world.
        agent: who decided.
        total_s: all of it, the sum of the next five.
        lanes_s: along the lanes, waiting included.
        manoeuvre_s: from the decision to park until the car stood in the slot.
        failed_s: of tries that failed.
        walk_s: to the goal.
        gave_up_s: of going elsewhere.
        parked: whether the car was parked.
        slot: where, by name.
        slot_kind: how that slot lies to its lane.
        graph_m: m of the graph's edges.
        driven_m: m that the car drove, in either direction.
        contacts: how often it touched something.
        strays: how often it was off its way.
        rescues: how often it was stuck and put back on the lane.
        waited_s: s of braking and standing for others who were in the way.
        legs: the edges, in order.
        tries: the tries to park, in order.
    """

    seed: int
    agent: str
    total_s: float
    lanes_s: float
    manoeuvre_s: float
    failed_s: float
    walk_s: float
    gave_up_s: float
    parked: bool
    slot: str
    slot_kind: str
    graph_m: float
    driven_m: float
    contacts: int
    strays: int
    rescues: int
    waited_s: float
    legs: tuple[Leg, ...]
    tries: tuple[Try, ...]

    @property
    def failed(self) -> list[Try]:
        """The tries that failed."""
        return [t for t in self.tries if t.reason]


class DrivenSearch:
    """Drives trips in one scenario.

    Args:
        scenario: the scenario, whose traffic moves through the lot.
        agent: who decides: a name that `make_agent` knows.
        vehicle: the car.
        style: how it is driven.
        rig: sensors that ride along and tell the car which slots are taken: laser, stereo, both_sides, or a
            `sim_sensors.rig.SensorRig`; None where the scenario's sighting model stands for them.
        weather: as of `parkenv/SearchPerception-v1`.
        captures: how many there are at most on an edge.

    Raises:
        InputError: an unknown agent, rig or weather; a speed that the car does not have; or a lot in which the car fits
            nowhere.

    Example:
        >>> import math
        >>> trip = DrivenSearch(make_scenario("mini")).run(seed=1)
        >>> parts = trip.lanes_s + trip.manoeuvre_s + trip.failed_s + trip.walk_s + trip.gave_up_s
        >>> trip.parked, math.isclose(trip.total_s, parts)
        (True, True)
    """

    def __init__(
        self,
        scenario: Scenario,
        agent: str = "mdp",
        vehicle: VehicleParameters | None = None,
        style: DrivingStyle | None = None,
        rig: str | SensorRig | None = None,
        weather: str | None = None,
        captures: int = 2,
    ) -> None:
        perception = None if rig is None else OnboardPerception(scenario, rig, weather, captures)
        self.scenario = scenario if perception is None else perception.scenario
        self.agent = agent
        self._agent: Agent = make_agent(agent, self.scenario)
        self.driver = LotDriver(self.scenario, vehicle, style)
        self.env = DrivenSearchEnv(self.scenario, self.driver, perception)
        self._limited = adapt_to_agent(TimeLimit(self.env, STEP_LIMIT), self._agent)

    def run(
        self, seed: int, observers: Sequence[Observer] = (), on_control: Callable[[], None] = lambda: None
    ) -> Trip:
        """Drive the trip in the world of a seed.

        Args:
            seed: 0 or more.
            observers: of the decisions.
            on_control: called after every 0.1 s of driving; `driver` and `env` hold the current state.

        Raises:
            InputError: a seed that is not a whole number of at least 0.
        """
        if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or seed < 0:
            raise InputError(f"seed is {seed!r}, want a whole number of at least 0")
        env, driver = self.env, self.driver
        driver.watch = on_control
        result = simulate(self._limited, self._agent, int(seed), observers)
        info = result.info
        parked = env.manoeuvre
        manoeuvre_s = parked.seconds if parked else 0.0
        lanes_s = float(info["drive_s"]) - manoeuvre_s
        failed_s, walk_s, gave_up_s = (float(info[name]) for name in ("failed_s", "walk_s", "gave_up_s"))
        log = driver.log
        return Trip(
            seed=int(seed),
            agent=self.agent,
            total_s=lanes_s + manoeuvre_s + failed_s + walk_s + gave_up_s,
            lanes_s=lanes_s,
            manoeuvre_s=manoeuvre_s,
            failed_s=failed_s,
            walk_s=walk_s,
            gave_up_s=gave_up_s,
            parked=bool(info["parked"]),
            slot=parked.slot if parked else "",
            slot_kind=parked.kind if parked else "",
            graph_m=float(env.search.numbers[0, DRIVEN_M]),
            driven_m=log.driven_m,
            contacts=len(log.contacts),
            strays=log.strays,
            rescues=log.rescues,
            waited_s=log.waited_s,
            legs=tuple(log.legs),
            tries=tuple(log.tries),
        )
