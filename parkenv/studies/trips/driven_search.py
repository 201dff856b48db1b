"""Whole trips: an agent decides on the drive graph, and a simulated car drives from the entry into the slot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.wrappers import TimeLimit

from parkenv.driving.vehicle import VehicleParameters
from parkenv.engine import kernel as kernel
from parkenv.engine.sensor_sampler import Station
from parkenv.envs.perception import OnboardPerception
from parkenv.envs.search import SearchEnv
from parkenv.errors import require_whole
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.simulate import STEP_LIMIT, Observer, adapt_to_agent, simulate
from parkenv.studies.trips.driven_car import DrivingStyle, Leg, ParkingAttempt
from parkenv.studies.trips.vehicle_controller import VehicleController
from parkenv.world.cost_terms import COST_FIELDS
from parkenv.world.lot import PARK
from parkenv.world.scenario import Scenario
from planners.agent import Agent, make_agent
from sim_sensors.rig import SensorRig


class DrivenSearchEnv(SearchEnv):
    """`parkenv/Search-v2` with continuous driving: edges, waits and attempts take as long as a simulated car needs.

    World, observations and decisions are those of `parkenv/Search-v2`. An attempt also fails if the car does not fit
    into a free slot, which then counts as taken. The manoeuvre into the slot counts as driving time.

    Args:
        scenario: the scenario.
        executor: executes the decisions.
        perception: simulated sensors on the car, made for this scenario: the belief is updated from their measurements
            along the driven path, as in `parkenv/SearchPerception-v2`. If None, slots are observed from the vertices
            with the scenario's sensor model.
    """

    def __init__(
        self, scenario: Scenario, executor: VehicleController, perception: OnboardPerception | None = None
    ) -> None:
        super().__init__(scenario)
        self.executor, self.perception = executor, perception
        self._refused: set[int] = set()
        self.manoeuvre: ParkingAttempt | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        if self.perception is not None:
            self.perception.reset()
        result = super().reset(seed=seed, options=options)
        state = self.state
        self._refused.clear()
        self.manoeuvre = None
        self.executor.begin(state.key, state.world, state.vertex, state.time)
        return result

    def _stepper(self) -> Callable[[int, int], tuple[Any, ...]]:
        return self._drive_step

    def _drive_step(self, address: int, action: int) -> tuple[Any, ...]:
        state = self._state
        vertex, begin = state.vertex, state.time
        possible = self.scenario.action_masks[vertex, action] == 1
        if possible and action == PARK:
            self._park(vertex, begin)
        elif possible:
            seconds = self.executor.drive(vertex, action)
            kernel.act_at(address, action)
            kernel.set_step_time_at(address, begin, seconds, 0.0)
        else:
            self.executor.wait(self.scenario.wait_s)
            kernel.act_at(address, action)
        if not state.parked:
            self._observe(moved=possible and action != PARK)
            for slot in self._refused:
                # The slot looks free, but this car does not fit.
                kernel.set_taken_at(address, slot)
        result: tuple[Any, ...] = kernel.finish_step_at(address)
        return result

    def _observe(self, *, moved: bool) -> None:
        perception = self.perception
        if perception is None:
            kernel.observe_at(self._address)
            return
        # After an attempt or a wait, the car observes once; captures within a manoeuvre are useless.
        track = self.executor.car.track if moved else self.executor.car.track[-1:]
        stations: list[Station] = []
        if track:
            chosen = perception.sampler.select_stations(np.array([point.driven_m for point in track]))
            points = [track[i] for i in chosen.tolist()]
            stations = [Station(s.time, s.pose, self.executor.car.movers_at(s)) for s in points]
        captures = perception.sampler.sample(self._state, stations)
        perception.update_belief(self._address, self._state.vertex, captures)

    def _park(self, slot: int, begin: float) -> None:
        taken = bool(self._state.world.occupied(np.array([slot]), begin)[0])
        outcome = self.executor.park(slot, taken)
        if taken or not outcome.reason:
            kernel.act_at(self._address, PARK)
        else:
            self._refused.add(slot)
            kernel.fail_attempt_at(self._address)
        if not outcome.reason:
            self.manoeuvre = outcome
        lost = outcome.seconds if outcome.reason else 0.0
        kernel.set_step_time_at(self._address, begin, outcome.seconds - lost, lost)


@dataclass(frozen=True)
class Trip:
    """One trip from the entry to the goal."""

    seed: int  # seed of the world
    agent: str
    total_s: float  # sum of the next two and of `costs`
    lanes_s: float  # driving on the lanes, waiting included
    manoeuvre_s: float  # from the decision to park until the car stood in the slot
    costs: dict[str, float]  # the terms but `drive_s`: `failed_s`, `walk_s`, ...; see `COST_TERMS`
    parked: bool  # whether the car was parked
    slot: str  # name of the slot; empty if not parked
    slot_kind: str  # orientation of the slot to the lane
    graph_m: float  # length of the driven edges in the graph, m
    driven_m: float  # distance driven, forward and backward, m
    contacts: int  # number of collisions
    strays: int  # how often the car left its path
    rescues: int  # how often the car was stuck and was put back on the lane
    waited_s: float  # time spent braking and standing for other road users, s
    legs: tuple[Leg, ...]  # the driven edges, in order
    attempts: tuple[ParkingAttempt, ...]  # the parking attempts, in order


class DrivenSearch:
    """Drives trips in one scenario.

    Args:
        scenario: the scenario with its traffic.
        agent: name of an agent, with its options in brackets; see `make_agent` and `AgentSpec`.
        vehicle: the car.
        style: driving style.
        rig: simulated sensors that observe the slots: laser, stereo, both_sides, or a `sim_sensors.rig.SensorRig`;
            None to use the scenario's sensor model.
        weather: as in `parkenv/SearchPerception-v2`.
        captures: maximum number of captures per edge.
        detector: the rig's detector, as in `parkenv/SearchPerception-v2`.

    Example:
        >>> import math
        >>> from parkenv import make_scenario
        >>> trip = DrivenSearch(make_scenario("mini")).run(seed=1)
        >>> parts = trip.lanes_s + trip.manoeuvre_s + sum(trip.costs.values())
        >>> trip.parked, math.isclose(trip.total_s, parts)
        (True, True)
    """

    def __init__(
        self,
        scenario: Scenario,
        agent: str | AgentSpec = "mdp",
        vehicle: VehicleParameters | None = None,
        style: DrivingStyle | None = None,
        rig: str | SensorRig | None = None,
        weather: str | None = None,
        captures: int = 2,
        detector: str | None = None,
    ) -> None:
        perception = (
            None if rig is None else OnboardPerception(scenario, rig, weather, captures, detector=detector)
        )
        self.scenario = scenario if perception is None else perception.scenario
        spec = AgentSpec.of(agent) if isinstance(agent, str) else agent
        self.agent = spec.label
        self._agent: Agent = make_agent(spec.name, self.scenario, **spec.options)
        self.driver = VehicleController(self.scenario, vehicle, style)
        self.env = DrivenSearchEnv(self.scenario, self.driver, perception)
        self._limited = adapt_to_agent(TimeLimit(self.env, STEP_LIMIT), self._agent)

    def run(self, seed: int, observers: Sequence[Observer] = ()) -> Trip:
        require_whole("seed", seed)
        env, driver = self.env, self.driver
        result = simulate(self._limited, self._agent, int(seed), observers)
        info = result.info
        parked = env.manoeuvre
        manoeuvre_s = parked.seconds if parked else 0.0
        lanes_s = float(info["drive_s"]) - manoeuvre_s
        costs = {name: float(info[name]) for name in COST_FIELDS if name != "drive_s"}
        log = driver.car.log
        return Trip(
            seed=int(seed),
            agent=self.agent,
            total_s=sum((lanes_s, manoeuvre_s, *costs.values())),
            lanes_s=lanes_s,
            manoeuvre_s=manoeuvre_s,
            costs=costs,
            parked=bool(info["parked"]),
            slot=parked.slot if parked else "",
            slot_kind=parked.kind if parked else "",
            graph_m=env.state.driven_m,
            driven_m=log.driven_m,
            contacts=len(log.contacts),
            strays=log.strays,
            rescues=log.rescues,
            waited_s=log.waited_s,
            legs=tuple(log.legs),
            attempts=tuple(log.attempts),
        )
