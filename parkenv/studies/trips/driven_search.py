"""Whole trips: an agent decides on the drive graph, a simulated car drives into the slot; costs measured on trips."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.wrappers import TimeLimit
from scipy import stats

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.parking_task import KINDS
from parkenv.driving.vehicle import VehicleParameters
from parkenv.engine import kernel as kernel
from parkenv.engine.sensor_sampler import Station
from parkenv.envs.perception import OnboardPerception
from parkenv.envs.search import SearchEnv
from parkenv.errors import require, require_whole
from parkenv.files.known_names import OBSERVED
from parkenv.scenarios.calibration import Calibration
from parkenv.studies.fields import AgentSpec
from parkenv.studies.results import Row
from parkenv.studies.simulate import STEP_LIMIT, Observer, adapt_to_agent, simulate
from parkenv.studies.statistics import columns_of, mean_interval
from parkenv.studies.trips.driven_car import EDGE_KINDS, DrivingStyle, Leg, ParkingAttempt
from parkenv.studies.trips.vehicle_controller import VehicleController
from parkenv.world.cost_terms import COST_FIELDS
from parkenv.world.lot import PARK
from parkenv.world.scenario import KMH, Scenario
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


def trip_row(trip: Trip) -> Row:
    lists = {"legs": list(map(list, trip.legs)), "attempts": list(map(list, trip.attempts))}
    return dataclasses.asdict(trip) | lists


def samples(rows: Sequence[Row], speed: float) -> dict[str, FloatArray]:
    """Return the samples of each measured quantity, in trips with observations but for failed attempts.

    `failed_s` is the time of a failed attempt until the car is back on the lane, `lost_s` the same less the time of the
    onward distance at `speed`, m/s.
    """
    observed = [row for row in rows if row["slots"] == OBSERVED]
    attempts = [ParkingAttempt(*t) for row in rows for t in row["attempts"]]
    failed = [t for t in attempts if t.reason]
    done = [ParkingAttempt(*t) for row in observed for t in row["attempts"] if not t[4]]
    legs = [Leg(*leg) for row in observed for leg in row["legs"]]
    lists: dict[str, list[float]] = {
        "speed_kmh": [
            r["graph_m"] / r["lanes_s"] / KMH
            for r in observed
            if r["lanes_s"] > 0.0 and not r["costs"]["failed_s"]
        ],
        "manoeuvre_s": [t.seconds for t in done],
        **{f"manoeuvre_s.{kind}": [t.seconds for t in done if t.kind == kind] for kind in KINDS},
        "failed_s": [t.seconds for t in failed],
        "lost_s": [t.seconds - t.onward_m / speed for t in failed],
        **{f"failed_s.{kind}": [t.seconds for t in failed if t.kind == kind] for kind in KINDS},
        **{
            f"s_per_m.{kind}": [leg.seconds / leg.graph_m for leg in legs if leg.kind == kind]
            for kind in EDGE_KINDS
        },
    }
    return {name: np.array(values) for name, values in lists.items() if values}


def summary_of(values: FloatArray) -> Row:
    return {
        "n": len(values),
        "median": float(np.median(values)),
        **columns_of("mean", mean_interval(values)),
        "p95": float(np.quantile(values, 0.95)),
    }


def calibrate(rows: Sequence[Row], scenario: Scenario, speed_limit: float) -> tuple[Calibration, list[Row]]:
    """Compute the calibration and one row per distribution.

    The speed is the total distance of trips with observations over their total time, so that drive times on the graph
    are right on average.
    """
    observed = [row for row in rows if row["slots"] == OBSERVED]
    metres = np.array([row["graph_m"] for row in observed])
    seconds = np.array([row["lanes_s"] for row in observed])
    known = samples(rows, speed_limit)
    for name, event in (("manoeuvre_s", "trip has parked"), ("lost_s", "attempt has failed")):
        require(name in known, f"of {len(rows)} trips in {scenario.name!r} no {event}: drive more trips")
    speed = float(metres.sum() / seconds.sum())
    table = [{"what": name, **summary_of(values)} for name, values in known.items()]
    ratio = [speed / KMH, speed / KMH]
    if len(observed) > 1 and np.ptp(metres / seconds) > 0.0:
        interval = stats.bootstrap(
            (metres, seconds),
            lambda m, s, axis: m.sum(axis=axis) / s.sum(axis=axis) / KMH,
            paired=True,
            n_resamples=9999,
            vectorized=True,
            method="percentile",
            rng=np.random.default_rng(0),
        ).confidence_interval
        ratio = [float(interval.low), float(interval.high)]
    table.insert(0, {"what": "v_drive_kmh", "n": len(observed), "mean": speed / KMH, "mean_ci95": ratio})
    calibration = Calibration(
        scenario=scenario.name,
        v_drive=speed,
        failure_s=float(known["lost_s"].mean()),
        manoeuvre_s=float(known["manoeuvre_s"].mean()),
        trips=len(observed),
        speed_limit=speed_limit,
    )
    return calibration, table


def save_distributions(rows: Sequence[Row], speed_limit: float, title: str, path: Path) -> None:
    from parkenv.show.figures.picture_files import INK, picture  # loads Matplotlib

    known = samples(rows, speed_limit)
    with picture(path, (10.0, 6.4)) as figure:
        figure.suptitle(title, x=0.02, ha="left", weight="bold")
        axes = figure.subplots(2, 2).ravel()
        panels = (
            ("speed on the lanes, per trip (km/h)", ["speed_kmh"], [""]),
            ("manoeuvre into the slot (s)", [f"manoeuvre_s.{k}" for k in KINDS], list(KINDS)),
            ("failed attempt, until back on the lane (s)", [f"failed_s.{k}" for k in KINDS], list(KINDS)),
        )
        colors = ("#0072b2", "#d55e00", "#009e73")
        for ax, (heading, names, labels) in zip(axes, panels, strict=False):
            shown = [
                (known[n], label, c) for n, label, c in zip(names, labels, colors, strict=False) if n in known
            ]
            ax.set_title(heading)
            if not shown:
                continue
            everything = np.concatenate([values for values, _, _ in shown])
            low, high = float(everything.min()), float(everything.max())
            bins = np.linspace(low - 0.02 * (high - low) - 0.05, high + 0.02 * (high - low) + 0.05, 31)
            for values, label, color in shown:
                ax.hist(values, bins=bins.tolist(), color=color, alpha=0.55, label=label or None)
                ax.axvline(float(values.mean()), color=color, lw=1.4)
                ax.text(
                    float(values.mean()), 1.0, f" {values.mean():.1f}", color=INK, fontsize=8,
                    transform=ax.get_xaxis_transform(), va="top",
                )  # fmt: skip
            ax.set_ylabel("trips" if names == ["speed_kmh"] else "attempts")
            if labels != [""]:
                ax.legend()
        ax = axes[3]
        kinds = [k for k in EDGE_KINDS if f"s_per_m.{k}" in known]
        ax.boxplot([known[f"s_per_m.{k}"] for k in kinds], tick_labels=kinds, whis=(5, 95), showfliers=False)
        ax.axhline(1.0 / speed_limit, color="#d55e00", lw=1.0, ls="--")
        ax.set_title("edges (s/m; dashed: speed limit)")
