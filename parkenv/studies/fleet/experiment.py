"""An experiment with many cars: agents, knowledge, shares and demand, all on the same days."""

from __future__ import annotations

import itertools
import math
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from parkenv import __version__
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.errors import InputError
from parkenv.files.typed_csv import NUMBER_OR_NAN, TEXT, WHOLE
from parkenv.scenarios.build import build
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.experiment import agent_fingerprints, fingerprints, flat_tables
from parkenv.studies.fleet.clairvoyant_bound import clairvoyant_bound_s
from parkenv.studies.fleet.decision_limit import LimitedAgent
from parkenv.studies.fleet.drivers import demand_in, driver_of
from parkenv.studies.fleet.measures import MEANS, Roads, day_measures
from parkenv.studies.results import EpisodeTable, ResultFolder, Row
from parkenv.studies.spec import SPEC_FILE, FleetSpec
from parkenv.studies.statistics import mean_interval
from parkenv.studies.trips.calibration import Calibration
from parkenv.studies.workers import HERE, Workers
from parkenv.world.demand import Demand
from parkenv.world.scenario import Scenario

OWN, ASSIGNED = "own", "reserve"
SAMPLE_S = 300.0  # time between two samples of the occupancy, s
SETTING_COLUMNS = ("scenario", "agents", "knows", "share", "arrivals_per_hour")
TABLE = EpisodeTable(
    "days.csv",
    keys=(*SETTING_COLUMNS, "day"),
    columns=("cars", *MEANS),
    kinds=dict.fromkeys(("scenario", "agents", "knows"), TEXT)
    | dict.fromkeys(("day", "cars"), WHOLE)
    | dict.fromkeys(("members_s", "others_s"), NUMBER_OR_NAN),
    timings=None,
)
WITH_INTERVAL = ("total_s", "search_s", "members_s", "others_s")
"""Measures whose summary has a 95 % interval over days."""
DIFFERENCES = {
    "difference_s": "total_s",
    "members_difference_s": "members_s",
    "others_difference_s": "others_s",
}
"""Columns of paired differences, and the measures that are compared."""
OPTIONS = ("stay_s", "patience_s", "delay_s", "leaving_soon_s", "sees_cars")
"""Fields of the specification that all settings have in common."""
SYNC_S = 1.0  # least time between two flushes of finished days to disk, s
_RESAMPLES = 9999

Pairs = list[tuple[Row, Row]]
"""The same days in two settings."""


@dataclass(frozen=True)
class Setting:
    """What a row of the summary is about.

    Args:
        agent: agent that drives every car.
        knows: what members know, one of `KNOWLEDGE`.
        share: share of the cars that are members; the others know their own observations.
        arrivals_per_hour: cars an hour.
    """

    agent: AgentSpec
    knows: str
    share: float
    arrivals_per_hour: float

    @property
    def columns(self) -> Row:
        """The columns that identify the row, but for the scenario."""
        return {
            "agents": self.agent.label, "knows": self.knows, "share": self.share,
            "arrivals_per_hour": self.arrivals_per_hour,
        }  # fmt: skip

    def __str__(self) -> str:
        agent, knows, share, per_hour = self.columns.values()
        return f"{agent}, {knows}, share {share:g}, {per_hour:g} cars an hour"


@dataclass(frozen=True, eq=False)
class FleetExperiment:
    """The settings of an experiment, with its scenario made.

    Args:
        spec: specification of the experiment.

    Raises:
        InputError: the scenario cannot be made, or the calibration is of another one.
    """

    spec: FleetSpec

    @cached_property
    def scenario(self) -> Scenario:
        """Lot, residents, hours of arrival, speeds and costs."""
        scenario = build(self.spec.scenario)
        return scenario if self.calibration is None else self.calibration.applied(scenario)

    @cached_property
    def calibration(self) -> Calibration | None:
        """The measured speed, failure cost and manoeuvre, if any."""
        if (path := self.spec.calibrated) is None:
            return None
        measured = Calibration.from_file(path)
        if measured.scenario != (name := build(self.spec.scenario).name):
            raise InputError(f"{path} was measured on {measured.scenario!r}, the fleet drives on {name!r}")
        return measured

    @property
    def manoeuvre_s(self) -> float:
        """Time for which a car that parks or leaves blocks its lane, s."""
        if self.spec.manoeuvre_s is not None:
            return self.spec.manoeuvre_s
        return 0.0 if self.calibration is None else self.calibration.manoeuvre_s

    @cached_property
    def _roads(self) -> Roads:
        return Roads(self.scenario)

    def __getstate__(self) -> dict[str, Any]:
        """Workers make the scenario themselves."""
        return {"spec": self.spec}

    @cached_property
    def settings(self) -> list[Setting]:
        """All settings. Without members only `own` is left: it is not repeated for each share."""
        spec = self.spec
        # Agents have no hash: their options may be lists.
        made = dict.fromkeys(
            (per_hour, number, OWN if share == 0.0 else knows, 0.0 if knows == OWN else share)
            for per_hour, number, knows, share in itertools.product(
                spec.arrivals_per_hour, range(len(spec.agents)), spec.knows, spec.shares
            )
        )
        return [
            Setting(spec.agents[number], knows, share, per_hour) for per_hour, number, knows, share in made
        ]

    def demand(self, per_hour: float) -> Demand:
        """Return the demand of a number of arrivals an hour in the hours of the scenario."""
        return demand_in(self.scenario, per_hour, self.spec.stay_s, self.spec.patience_s)

    def fleet(self, setting: Setting) -> tuple[Fleet, list[Any]]:
        """Return the fleet of a setting, and for each kind of driver its agent, or None if it is compiled.

        Raises:
            InputError: the demand is out of range, or the agent cannot be made or drives no fleet.
        """
        rule, agent = driver_of(setting.agent, self.scenario, setting.arrivals_per_hour)
        kinds = [
            DriverKind(setting.share, rule, setting.knows, shares=setting.knows == "shared"),
            DriverKind(1.0 - setting.share, rule, OWN),
        ]
        fleet = Fleet(
            self.scenario,
            self.demand(setting.arrivals_per_hour),
            background="residents",
            drivers=kinds,
            leave_full_lot=False,
            manoeuvre_s=self.manoeuvre_s,
            **{name: getattr(self.spec, name) for name in ("delay_s", "leaving_soon_s", "sees_cars")},
        )
        if agent is not None and self.spec.decision_limit_s is not None:
            agent = LimitedAgent(agent, self.spec.decision_limit_s)
        return fleet, [agent, agent]

    def run_day(self, setting: Setting, day: int) -> tuple[Row, list[str]]:
        """Run a day of a setting; return its row of `days.csv`, and the warnings of its agent.

        Raises:
            InputError: an agent raised an error or took too long; the message names setting, day, car and time.
        """
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("default")
            fleet, agents = self.fleet(setting)
            fleet.reset(self.spec.seed, day)
            bound_s = clairvoyant_bound_s(self._roads.parking_day(fleet))
            window = self.scenario.arrival
            taken = []
            try:
                for second in np.arange(0.0, window.end_s - window.start_s, SAMPLE_S):
                    fleet.run(agents, until=fleet.begin + second)
                    taken.append(fleet.taken().mean())
                fleet.run(agents)
            except InputError as error:
                raise InputError(f"{setting}, day {day}, {error}") from error
        members = fleet.cars["kind"] == 0
        measured = day_measures(fleet, self._roads, members, float(np.mean(taken)), bound_s)
        row = {"scenario": self.scenario.name, **setting.columns, "day": day, **measured}
        return row, [f"{setting.agent.label}: {w.message}" for w in caught]

    def key(self, setting: Setting, day: int) -> tuple[Any, ...]:
        """Return the key of a day in `days.csv`."""
        return TABLE.key({"scenario": self.scenario.name, **setting.columns, "day": day})

    def fingerprint(self) -> Row:
        """Return everything that affects the outcome of a day; a resumed run must have the same settings."""
        spec = self.spec
        return {
            "version": __version__,
            "scenario": {spec.scenario.title: flat_tables(spec.scenario.model_dump(mode="json"))},
            "files": fingerprints(spec.files()),
            "agent files": agent_fingerprints(agent.name for agent in spec.agents),
            "manoeuvre_s": self.manoeuvre_s,
            **{name: getattr(spec, name) for name in (*OPTIONS, "seed")},
        }


@dataclass(frozen=True, eq=False)
class FleetResult:
    """Result of an experiment."""

    experiment: FleetExperiment
    rows: list[Row]  # one row per setting with finished days, as in `summary.json`
    complete: bool  # whether all days are finished


def run_fleets(
    spec: FleetSpec,
    out: Path,
    *,
    command: Iterable[str] = (),
    resume: bool = False,
    overwrite: bool = False,
    workers: Workers = HERE,
    on_start: Callable[[int], None] = lambda _: None,
    on_progress: Callable[[int], None] = lambda _: None,
) -> FleetResult:
    """Run an experiment with many cars, and write its results; skip days that the folder already holds.

    The folder gets the specification (`experiment.json`), every day (`days.csv`), and the table (`summary.json`).
    Ctrl-C stops the run; finished days stay in the folder.

    Args:
        spec: specification of the experiment.
        out: result folder.
        command: command line to record in the summary.
        resume: continue an earlier run.
        overwrite: replace the results of another run.
        workers: where days run; results do not depend on it.
        on_start: called with the number of days before the first one starts.
        on_progress: called with the number of days just finished.

    Raises:
        InputError: a setting cannot be run, an agent raises an error or exceeds its time limit, or the folder cannot be
            used.
    """
    experiment = FleetExperiment(spec)
    for setting in experiment.settings:
        experiment.fleet(setting)  # raises an error before anything is run
    tasks = {
        experiment.key(setting, day): partial(experiment.run_day, setting, day)
        for setting in experiment.settings
        for day in range(spec.days)
    }
    with workers:
        folder = ResultFolder(
            out, experiment.fingerprint(), table=TABLE, kind="fleet", resume=resume, overwrite=overwrite
        )
        spec.write(out / SPEC_FILE)
        missing = [task for key, task in tasks.items() if key not in folder.episodes]
        on_start(len(tasks))
        on_progress(len(tasks) - len(missing))
        try:
            _run_days(missing, folder, workers, on_progress)
            complete = True
        except KeyboardInterrupt:
            complete = False
    by_setting: dict[tuple[Any, ...], list[Row]] = {}
    for key in tasks:
        if key in folder.episodes:
            by_setting.setdefault(key[:-1], []).append(folder.episodes[key])
    result = FleetResult(experiment, summarize_days(list(by_setting.values())), complete)
    summary = {
        "command": list(command),
        "version": __version__,
        "seed": spec.seed,
        "complete": complete,
        "manoeuvre_s": experiment.manoeuvre_s,
        **{name: getattr(spec, name) for name in OPTIONS},
        "rows": result.rows,
    }
    folder.finish(tasks, summary, complete=complete)
    return result


def _run_days(
    tasks: Sequence[Callable[[], tuple[Row, list[str]]]],
    folder: ResultFolder,
    workers: Workers,
    on_progress: Callable[[int], None],
) -> None:
    told = set()
    synced = -math.inf
    for _, (row, messages) in workers.results(tasks):
        # A day may take a millisecond, and a flush to disk a second.
        sync = time.monotonic() >= synced + SYNC_S
        folder.add([row], sync=sync)
        synced = time.monotonic() if sync else synced
        on_progress(1)
        for message in messages:
            if message not in told:
                told.add(message)
                warnings.warn(message, stacklevel=2)


def summarize_days(settings: Sequence[list[Row]]) -> list[Row]:
    """Return the summary, a row for each setting, from the days of each, at least one.

    The *price of anarchy* of a row is the ratio of its mean total time to that of `reserve` for all cars, with the same
    agents and demand; its interval is a bootstrap over days. The *price over the bound* is the ratio to the clairvoyant
    lower bound of the same days, likewise. Differences are paired: to the mean total time of all cars
    on the same days if nobody knows more than what it observes. Both are over the days that both settings have; null if
    there are none.
    """
    by_setting = {tuple(days[0][name] for name in SETTING_COLUMNS): days for days in settings}

    def paired(days: list[Row], knows: str, share: float) -> Pairs:
        first = days[0]
        key = (first["scenario"], first["agents"], knows, share, first["arrivals_per_hour"])
        others = {day["day"]: day for day in by_setting.get(key, ())}
        return [(day, others[day["day"]]) for day in days if day["day"] in others]

    return [
        {
            **{name: days[0][name] for name in SETTING_COLUMNS},
            "days": len(days),
            "cars": sum(day["cars"] for day in days),
            **_means(days),
            **_differences(paired(days, OWN, 0.0)),
            **_price(paired(days, ASSIGNED, 1.0)),
            **_ratio("price_over_bound", days, days, "clairvoyant_s"),
        }
        for days in settings
    ]


def _differences(pairs: Pairs) -> Row:
    row: Row = {}
    for name, column in DIFFERENCES.items():
        values = [one[column] - other["total_s"] for one, other in pairs]
        row[name], low, high = mean_interval([value for value in values if not math.isnan(value)])
        row[f"{name}_ci95"] = [low, high]
    return row


def _means(days: list[Row]) -> Row:
    row: Row = {}
    for name in MEANS:
        # On a day without members, or without others, there is no mean of theirs.
        values = [day[name] for day in days if not math.isnan(day[name])]
        if name in WITH_INTERVAL:
            row[name], low, high = mean_interval(values)
            row[f"{name}_ci95"] = [low, high]
        else:
            row[name] = float(np.mean(values))
    return row


def _price(pairs: Pairs) -> Row:
    mine, theirs = zip(*pairs, strict=True) if pairs else ((), ())
    return _ratio("price_of_anarchy", mine, theirs, "total_s")


def _ratio(name: str, days: Sequence[Row], others: Sequence[Row], column: str) -> Row:
    """Return the ratio of the total time of all cars to a column of the same days, with a bootstrap over days."""
    if not days:
        return {name: float("nan"), f"{name}_ci95": [float("nan")] * 2}
    mine = np.array([day["total_s"] * day["cars"] for day in days])
    theirs = np.array([day[column] * day["cars"] for day in others])
    drawn = np.random.default_rng(0).integers(0, len(mine), (_RESAMPLES, len(mine)))
    ratios = mine[drawn].sum(axis=1) / theirs[drawn].sum(axis=1)
    low, high = np.percentile(ratios, [2.5, 97.5])
    return {name: float(mine.sum() / theirs.sum()), f"{name}_ci95": [float(low), float(high)]}
