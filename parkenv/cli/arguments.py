"""Options that several commands share, each described once, and their conversion to objects.

Dataclasses are groups of options: a command that has one as a parameter has all of its options.

Options:
    scenario (NAME|FILE): {scenarios}, a scenario file (.toml), or a lot (.geojson).  [default: campus]
    agents (NAME[,...]): Agents, with any options in brackets, mdp(failure_s=90): {agents}; ALGORITHM:FILE for a
        trained model; MODULE:CLASS for your own. Differences are to the first.  [default: all but exact]
    seed (N >= 0): First seed; episode i uses seed + i.

Code of others:
    trust: Run the classes (MODULE:CLASS), and use the cluster, that the file or the folder of the run names.
    trust_model: Convert archives of stable-baselines3 (ALGORITHM:FILE.zip) to model files; this runs the code in them.

Sensors:
    rig (laser|stereo|both_sides): Observe slots through simulated sensors, detector and all, instead of the sensor
        model: about a second a step. laser: a camera and a 270° laser; stereo: a stereo camera; both_sides: a laser and
        a camera to each side.
    detector (NAME|FILE|MODULE:CLASS): hog: the packaged HOG models; side or front: one of them; net: the packaged
        network; a file of `parkenv train-detector` (.npz) or a network (.onnx); MODULE:CLASS: your own.  [default: the
        scenario's, hog]
    weather (NAME): {weathers}.  [default: drawn each time]

World:
    lot (NAME|FILE[,...]): Instead of a scenario: a week as in busy real car parks on this lot. A packaged lot, GeoJSON,
        or a Dragon Lake map (.yml).

Results:
    rerun (FILE.rrd): Also record images, boxes, scans, grid, slots and path for the Rerun viewer (extra viewer; then:
        rerun FILE.rrd).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from parkenv.errors import InputError
from parkenv.files.file_names import file_name
from parkenv.files.known_names import BackendName, ForecastFrom

if TYPE_CHECKING:
    from parkenv.files.spec_file import Spec
    from parkenv.scenarios.spec import ScenarioSpec, TrafficSpec
    from parkenv.studies.compare.comparison import Grid
    from parkenv.studies.study import ExecutionSpec
    from parkenv.studies.workers import Workers

    SpecT = TypeVar("SpecT", bound=Spec)


@dataclass(frozen=True)
class World:
    """Where and when: changes to the scenarios, which take precedence over scenario files.

    World:
        occupancy (FILE[,FILE...]): Which slots are taken when: recorded logs (.csv, .csv.gz) of the same slots,
            replayed day by day, or a process that `parkenv occupancy fit` wrote (.json).  [default: the scenario's]
        car_park (NAME[,NAME...]|all): --occupancy is a file of hourly counts, car_park,capacity,hour,free; replay the
            days of these car parks on the lot, each as a scenario of its own. all: those that show some use.
        replay_from (DATE): First day of the log or the counts that is replayed.  [default: the scenario's, all]
        forecast_from (past|rolling|others): Days that the forecast is made from. past: those before --replay-from;
            rolling: those before the earliest that a world replays; others: all that it does not replay.  [default: the
            scenario's; others, with counts rolling]
        day_error (X[,Y]): How far whole days differ from the forecast: standard deviations, logits, of their level and
            of their slope to the goal; 0 for days that are as forecast.  [default: the scenario's, 0.8 in the packaged
            ones, 0.7 for a lot alone]
        mapping (FILE): CSV slot_id,log_slot_id that assigns the log's slots to the lot's.  [default: the log's fullest
            slots are nearest to the goal]
        goal (X,Y): Walk to this point, m, or to the lot's goal of this index.  [default: the scenario's]
    """

    lot: str | None = None
    occupancy: str | None = None
    car_park: str | None = None
    replay_from: str | None = None
    forecast_from: ForecastFrom | None = None
    day_error: str | None = None
    mapping: str | None = None
    goal: str | None = None

    def specs(
        self,
        scenario: str | None,
        base: Sequence[ScenarioSpec] | None = None,
        default: str = "campus",
    ) -> list[ScenarioSpec]:
        """Return the scenarios that the options describe.

        Args:
            scenario: names and files, separated by commas.
            base: scenarios to change where neither a scenario nor a lot is given.
            default: scenarios where there is no base either.

        Raises:
            InputError: an unknown name, an unusable file, or options that exclude each other.
        """
        if scenario is not None and self.lot is not None:
            raise InputError("--scenario and --lot exclude each other: a scenario has its lot")
        if self.mapping is not None and self.occupancy is None:
            raise InputError("--mapping goes with --occupancy FILE.csv")
        if base is None or scenario is not None or self.lot is not None:
            base = scenario_specs(scenario or default, self.lot)
        if self.car_park is None:
            return [self._changed(spec) for spec in base]
        return [
            self._changed(spec.changed("--car-park", **counted))
            for spec in base
            for counted in self._counted(spec.title)
        ]

    def spec(self, scenario: str | None) -> ScenarioSpec:
        """Return the one scenario that the options describe; see `specs`."""
        return one_scenario(self.specs(scenario))

    def _counted(self, title: str) -> list[dict[str, Any]]:
        """Return the changes to a scenario for each of the car parks."""
        from parkenv.scenarios.build import car_parks

        if self.occupancy is None or self.replay_from is None:
            raise InputError("--car-park goes with --occupancy FILE.csv and --replay-from DATE")
        given = self.car_park or ""
        names = car_parks(Path(self.occupancy)) if given == "all" else words("--car-park", given)
        return [
            {
                "name": file_name(f"{title} {name}").replace(",", " ")[:80],
                "occupancy": {
                    "counts": {"file": self.occupancy, "car_park": name},
                    "replay_from": self.replay_from,
                },
                "forecast": "own",
            }
            for name in names
        ]

    def _changed(self, spec: ScenarioSpec) -> ScenarioSpec:
        if self.occupancy is not None and self.car_park is None:
            log = {"log": self.occupancy, "mapping": self.mapping} if self.mapping else self.occupancy
            option = "--mapping" if self.mapping else "--occupancy"
            spec = spec.changed(option, occupancy=log, forecast="own")
        replay = not_none(replay_from=self.replay_from, forecast_from=self.forecast_from)
        if replay:
            spec = spec.changed(occupancy=spec.occupancy.changed("--replay-from, --forecast-from", **replay))
        if self.day_error is not None:
            count = self.day_error.count(",") + 1
            sizes = zip(
                ("level", "slope"), numbers("--day-error", self.day_error, min(count, 2)), strict=False
            )
            spec = spec.changed(occupancy=spec.occupancy.changed("--day-error", day_error=dict(sizes)))
        if self.goal is not None:
            index = int(self.goal) if self.goal.isdecimal() else numbers("--goal", self.goal, 2)
            spec = spec.changed("--goal", goal=index)
        return spec


@dataclass(frozen=True)
class Weekdays(World):
    """Where, and on which days of the week.

    World:
        days (DAYS): weekdays, weekend, all, or names such as mon,tue.  [default: the scenario's, weekdays]
    """

    days: str | None = None

    def _changed(self, spec: ScenarioSpec) -> ScenarioSpec:
        spec = super()._changed(spec)
        if self.days is None:
            return spec
        return spec.changed("--days", arrivals={"hours": spec.arrivals.hours, "days": self.days})


@dataclass(frozen=True)
class Hours(World):
    """Where, and at what time of day.

    World:
        hours (HH:MM-HH:MM): Searches begin between these hours.  [default: the scenario's, 08:00-13:00]
    """

    hours: str | None = None

    def _changed(self, spec: ScenarioSpec) -> ScenarioSpec:
        spec = super()._changed(spec)
        if self.hours is None:
            return spec
        return spec.changed("--hours", arrivals={"hours": self.hours, "days": spec.arrivals.days})


@dataclass(frozen=True)
class Observed(World):
    """Where, and how slots are observed.

    Sensors:
        sensor_model (NAME|FILE): How slots are observed. perfect: without error; blind: by attempts alone; laser,
            stereo: as measured with that rig; a file of `parkenv fit-sensor-model`.  [default: the scenario's; with
            --rig, the rig's]
        view_range (M): How far slots are observed from the car, m.  [default: the sensor model's]
    """

    sensor_model: str | None = None
    view_range: float | None = None

    def _changed(self, spec: ScenarioSpec) -> ScenarioSpec:
        spec = super()._changed(spec)
        if self.sensor_model is not None:
            spec = spec.changed("--sensor-model", sensor_model=self.sensor_model)
        if self.view_range is None:
            return spec
        model = spec.sensor_model.changed("--view-range", view_range=self.view_range)
        return spec.changed("--view-range", sensor_model=model)


@dataclass(frozen=True)
class Searches(Hours, Weekdays):
    """Where and when searches take place."""


@dataclass(frozen=True)
class ObservedSearches(Observed, Searches):
    """Where and when searches take place, and how slots are observed."""


@dataclass(frozen=True)
class Traffic:
    """Other road users.

    World:
        cars (N >= 0): Other cars that drive about.  [default: the scenario's]
        pedestrians (N >= 0): Pedestrians.  [default: the scenario's]
    """

    cars: int | None = None
    pedestrians: int | None = None

    def on(self, spec: ScenarioSpec, default: TrafficSpec | None = None) -> ScenarioSpec:
        """Return the scenario with this traffic; the default is that of scenarios that name none."""
        given = not_none(cars=self.cars, pedestrians=self.pedestrians)
        usual = spec.traffic or default
        if not given:
            return spec if usual is None else spec.changed(traffic=usual)
        return spec.changed("--cars, --pedestrians", traffic=(usual.tables() if usual else {}) | given)


@dataclass(frozen=True)
class Costs:
    """Axes of a grid.

    Costs and speeds:
        failure_cost (S[,S...]|sweep): Seconds that the world charges for a failed attempt, and that planners expect
            unless their own options say otherwise. sweep: 0 to 120 s.  [default: the scenario's, 10]
        v_walk_kmh (V[,V...]): Walking speed, km/h.  [default: the scenario's, 4]
        v_drive_kmh (V[,V...]): Driving speed, km/h.  [default: the scenario's, 10]
    """

    failure_cost: str | None = None
    v_walk_kmh: str | None = None
    v_drive_kmh: str | None = None

    def grid(self, base: Grid) -> Grid:
        """Return a grid with the given axes replaced.

        Raises:
            InputError: the text has no numbers, or a number is out of range.
        """
        from parkenv.studies.compare.comparison import FAILURE_COST_SWEEP

        if self.failure_cost == "sweep":
            base = base.changed(failure_s=FAILURE_COST_SWEEP)
        elif self.failure_cost is not None:
            base = changed_axis(base, "failure_s", "--failure-cost", self.failure_cost)
        base = changed_axis(base, "v_walk_kmh", "--v-walk-kmh", self.v_walk_kmh)
        return changed_axis(base, "v_drive_kmh", "--v-drive-kmh", self.v_drive_kmh)


@dataclass(frozen=True)
class RunFolder:
    """What happens to the folder of a run.

    Results:
        resume: Go on with the run in --out. Options that are given change it, such as more --episodes.
        overwrite: Replace the run in --out.
    """

    resume: bool = False
    overwrite: bool = False


@dataclass(frozen=True)
class ReportedRun(RunFolder):
    """A run that writes a report on request.

    Results:
        report: Also write report.html, as `parkenv report` does.
    """

    report: bool = False


@dataclass(frozen=True)
class Machines:
    """Where tasks run; the results do not depend on it.

    Machines:
        jobs, -j (N >= 0): Worker processes, at most one per core and per task.  [default: 0, all cores]
        backend (loky|ray|dask): Run workers on this machine (loky), or on a Ray or Dask cluster (extras ray, dask).
            [default: loky]
        address (HOST:PORT): Of the cluster: Ray's head, HOST:6379 or ray://HOST:10001; Dask's scheduler,
            tcp://HOST:8786.  [default: a cluster on this machine]
    """

    jobs: int | None = None
    backend: BackendName | None = None
    address: str | None = None

    @property
    def given(self) -> dict[str, Any]:
        """The options that are given, as fields of a specification; another backend does not keep a saved address."""
        return not_none(**asdict(self)) | ({"address": self.address} if self.backend else {})

    def workers(self) -> Workers:
        """Return the workers, a context manager; see `workers_of`."""
        return workers_of(self)


def workers_of(place: Machines | ExecutionSpec) -> Workers:
    """Return the workers for tasks, a context manager that connects to clusters.

    Raises:
        InputError: the options are incompatible.
    """
    from parkenv.studies.workers import Workers

    return Workers(place.jobs or None, place.backend or "loky", place.address)


def require_rig(rig: str | None, detector: str | None) -> None:
    """Refuse a detector without sensors.

    Raises:
        InputError: there is a detector, but no rig.
    """
    if detector is not None and rig is None:
        raise InputError(f"--detector {detector}: has no images to look at; add --rig laser")


def not_none(**values: Any) -> dict[str, Any]:
    """Return the values that are given."""
    return {name: value for name, value in values.items() if value is not None}


def numbers(option: str, text: str, count: int | None = None) -> list[float]:
    """Parse comma-separated numbers.

    Raises:
        InputError: the text is something else; the message names the option.
    """
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if not values or (count is not None and (len(values) != count or not all(map(math.isfinite, values)))):
        wanted = "numbers" if count is None else f"{count} numbers"
        raise InputError(f"{option} is {text!r}, want {wanted} separated by commas, e.g. 10,90")
    if count is None and len(set(values)) < len(values):
        raise InputError(f"{option} is {text!r}: a value stands twice")
    return values


def words(option: str, text: str) -> list[str]:
    """Parse comma-separated words: at least one, without duplicates."""
    values = [word.strip() for word in text.split(",") if word.strip()]
    if not values:
        raise InputError(f"{option} is {text!r}, want names separated by commas")
    if len(set(values)) < len(values):
        raise InputError(f"{option} is {text!r}: a name stands twice")
    return values


def changed_axis(grid: Grid, axis: str, option: str, text: str | None) -> Grid:
    """Return the grid with one axis replaced, unless its option is not given."""
    return grid if text is None else grid.changed(option, **{axis: numbers(option, text)})


def scenario_specs(scenario: str, lot: str | None = None) -> list[ScenarioSpec]:
    """Return the scenarios of names, files and folders, or else those of lots alone."""
    from parkenv.scenarios.spec import lot_scenario
    from parkenv.scenarios.spec import scenario_specs as specs_of

    if lot is None:
        return [spec for word in words("--scenario", scenario) for spec in specs_of(word)]
    return [lot_scenario(word, "--lot") for word in words("--lot", lot)]


def one_scenario(specs: list[ScenarioSpec]) -> ScenarioSpec:
    """Return the only scenario.

    Raises:
        InputError: there are several scenarios.
    """
    if len(specs) > 1:
        raise InputError(f"--scenario names {len(specs)} scenarios, want one")
    return specs[0]


def one_agent(agents: str) -> str:
    """Return the only agent.

    Raises:
        InputError: there are several agents, or none.
    """
    from parkenv.studies.agent_spec import split_agents

    names = split_agents(agents)
    if len(names) != 1:
        raise InputError(f"--agents names {len(names)} agents, want one")
    return names[0]


def saved(folder: Path, kind: type[SpecT]) -> SpecT:
    """Read the specification in the folder of a run.

    Raises:
        InputError: there is none.
    """
    from parkenv.studies.results import SPEC_FILE

    file = folder / SPEC_FILE
    if not file.exists():
        raise InputError(f"--resume: {folder} holds no run to resume: no {SPEC_FILE}")
    return kind.read(file)


def iso_date(option: str, text: str) -> date:
    """Parse a date.

    Raises:
        InputError: the text is something else; the message names the option.
    """
    try:
        return date.fromisoformat(text)
    except ValueError:
        raise InputError(f"{option} is {text!r}, want a date such as 2024-01-31") from None
