"""Options shared by several commands, and their conversion to objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from parkenv.errors import InputError
from parkenv.files.spec_file import Spec
from parkenv.scenarios.spec import ScenarioSpec, TrafficSpec, scenario_spec

if TYPE_CHECKING:
    from parkenv.evaluation.experiments.spec import Grid
    from parkenv.evaluation.experiments.workers import Workers

SpecT = TypeVar("SpecT", bound=Spec)

WORLD = "The world"
COSTS = "Costs and speeds"
MACHINES = "Machines"

ScenarioOption = Annotated[
    str | None,
    typer.Option(
        "--scenario",
        metavar="NAME|FILE",
        help="A packaged scenario (campus, jam, street, mini) or a scenario file (.toml).  [default: campus]",
        rich_help_panel=WORLD,
    ),
]
ScenariosOption = Annotated[
    str | None,
    typer.Option(
        "--scenario",
        metavar="NAME|FILE[,...]",
        help="Packaged scenarios (campus, jam, street, mini) or scenario files (.toml).  [default: campus]",
        rich_help_panel=WORLD,
    ),
]
LotOption = Annotated[
    str | None,
    typer.Option(
        "--lot",
        metavar="NAME|FILE[,...]",
        help="Instead of a scenario: a typical week on this lot; a packaged one, native GeoJSON, or a Dragon Lake map "
        "(.yml).",
        rich_help_panel=WORLD,
    ),
]
OccupancyOption = Annotated[
    Path | None,
    typer.Option(
        "--occupancy",
        metavar="FILE",
        help="Which slots are taken when: a recorded log (.csv, .csv.gz; replayed day by day) or a process that "
        "`parkenv occupancy fit` wrote (.json).  [default: the scenario's]",
        rich_help_panel=WORLD,
    ),
]
MappingOption = Annotated[
    Path | None,
    typer.Option(
        "--mapping",
        metavar="FILE",
        help="CSV slot_id,log_slot_id that assigns the log's slots to the lot's. Without it the log's fullest slots "
        "are placed nearest to the goal.",
        rich_help_panel=WORLD,
    ),
]
GoalOption = Annotated[
    str | None,
    typer.Option(
        "--goal",
        metavar="X,Y",
        help="Walk to this point, m, instead of the scenario's goal.",
        rich_help_panel=WORLD,
    ),
]
ArrivalOption = Annotated[
    str | None,
    typer.Option(
        "--arrival",
        metavar="HH:MM-HH:MM",
        help="Searches start between these hours.  [default: the scenario's, 08:00-13:00]",
        rich_help_panel=WORLD,
    ),
]
DaysOption = Annotated[
    str | None,
    typer.Option(
        "--days",
        help="On these days: weekdays, weekend, all, or e.g. mon,tue.  [default: the scenario's, weekdays]",
        rich_help_panel=WORLD,
    ),
]
ViewRangeOption = Annotated[
    float | None,
    typer.Option("--view-range", help="How far slots are observed from the car, m.", rich_help_panel=WORLD),
]
SensorModelOption = Annotated[
    str | None,
    typer.Option(
        "--sensor-model",
        metavar="perfect|laser|stereo|FILE",
        help="How slots are observed: without error within --view-range; as measured with a rig's detection and "
        "mapping stack; or a file of `parkenv fit-sensor-model`.  "
        "[default: the scenario's; with --rig as measured with the rig]",
        rich_help_panel=WORLD,
    ),
]
CarsOption = Annotated[
    int | None,
    typer.Option(
        "--cars", metavar="N", min=0, help="Other cars that drive about.  [default: the scenario's]"
    ),
]
PedestriansOption = Annotated[
    int | None,
    typer.Option("--pedestrians", metavar="N", min=0, help="Pedestrians.  [default: the scenario's]"),
]
WeatherOption = Annotated[
    str | None,
    typer.Option("--weather", help="sunny, overcast, low_sun, dusk or rain.  [default: drawn each time]"),
]
SurveyRigOption = Annotated[
    str | None,
    typer.Option(
        "--rig",
        metavar="laser|stereo|both_sides",
        help="Simulated sensors: laser, a camera and a 270° laser; stereo, a stereo camera alone; both_sides, a laser "
        "and a camera to each side.  [default: the scenario's, laser]",
    ),
]
RigOption = Annotated[
    str | None,
    typer.Option(
        "--rig",
        metavar="laser|stereo|both_sides",
        help="Observe slots through this rig's simulated sensors, detector and all, instead of the sensor model: about "
        "a second a step.",
        rich_help_panel=WORLD,
    ),
]
AgentsOption = Annotated[
    str | None,
    typer.Option(
        "--agents",
        metavar="NAME[,NAME...]",
        help="Agents, with options in brackets: mdp(failure_s=90). A name; ALGORITHM:FILE for a trained model; or "
        "MODULE:CLASS for an agent of your own. Differences are to the first.  [default: all but exact]",
    ),
]
ReportOption = Annotated[
    bool, typer.Option("--report", help="Also write report.html, as `parkenv report` does.")
]
RerunOption = Annotated[
    Path | None,
    typer.Option(
        "--rerun",
        metavar="FILE.rrd",
        help="Also record images, boxes, scans, grid, slots and path on one time line, for the Rerun viewer "
        "(pip install 'parkenv[viewer]'; then: rerun FILE.rrd).",
    ),
]
FailureCostOption = Annotated[
    str | None,
    typer.Option(
        "--failure-cost",
        metavar="S[,S...]",
        help="Seconds that a failed attempt costs.  [default: the scenario's, 10]",
        rich_help_panel=COSTS,
    ),
]
WalkOption = Annotated[
    str | None,
    typer.Option(
        "--v-walk-kmh",
        metavar="V[,V...]",
        help="Walking speed, km/h.  [default: the scenario's, 4]",
        rich_help_panel=COSTS,
    ),
]
DriveOption = Annotated[
    str | None,
    typer.Option(
        "--v-drive-kmh",
        metavar="V[,V...]",
        help="Driving speed, km/h.  [default: the scenario's, 10]",
        rich_help_panel=COSTS,
    ),
]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="First seed; episode i uses seed + i.")]
JobsOption = Annotated[
    int | None,
    typer.Option(
        "--jobs",
        "-j",
        metavar="N",
        min=0,
        help="Worker processes, at most one per core and per task; 0 takes all cores. The result is the same.  "
        "[default: 0; of a saved run or a file, its own]",
        rich_help_panel=MACHINES,
    ),
]
BackendOption = Annotated[
    str | None,
    typer.Option(
        "--backend",
        metavar="loky|ray|dask",
        help="Where workers run: on this machine (loky), or on a Ray or Dask cluster (extras ray, dask). The result is "
        "the same.  [default: loky]",
        rich_help_panel=MACHINES,
    ),
]
AddressOption = Annotated[
    str | None,
    typer.Option(
        "--address",
        metavar="HOST:PORT",
        help="Of the cluster: Ray's head, HOST:6379 or ray://HOST:10001; Dask's scheduler, tcp://HOST:8786. Without "
        "one a cluster is started on this machine.",
        rich_help_panel=MACHINES,
    ),
]


def numbers(option: str, text: str) -> list[float]:
    """Parse comma-separated numbers.

    Raises:
        InputError: the text is something else; the message names the option.
    """
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        raise InputError(f"{option} is {text!r}, want numbers separated by commas, e.g. 10,90") from None
    if len(set(values)) < len(values):
        raise InputError(f"{option} is {text!r}: a value stands twice")
    return values


def changed_axes(grid: Grid, options: Mapping[str, tuple[str, str | None]]) -> Grid:
    """Return a grid with the axes replaced that options give as comma-separated numbers.

    Args:
        grid: the grid.
        options: axis and text by option; the text is None if the option is not given.

    Raises:
        InputError: the text has no numbers, or a number is out of range.
    """
    for option, (axis, text) in options.items():
        if text is not None:
            grid = grid.changed(option, **{axis: numbers(option, text)})
    return grid


def words(option: str, text: str) -> list[str]:
    """Parse comma-separated words: at least one, without duplicates."""
    values = [word.strip() for word in text.split(",") if word.strip()]
    if not values:
        raise InputError(f"{option} is {text!r}, want names separated by commas")
    if len(set(values)) < len(values):
        raise InputError(f"{option} is {text!r}: a name stands twice")
    return values


def workplace(jobs: int | None, backend: str | None = None, address: str | None = None) -> dict[str, Any]:
    """Return the fields of a specification that the options set; a new backend does not keep the saved address."""
    given = {"jobs": jobs, "backend": backend, "address": address}
    return {
        name: value for name, value in given.items() if value is not None or (name == "address" and backend)
    }


def workers_of(jobs: int | None, backend: str | None = None, address: str | None = None) -> Workers:
    """Return the workers for tasks, a context manager that connects to clusters.

    Raises:
        InputError: the options are incompatible.
    """
    from parkenv.evaluation.experiments.workers import Workers

    return Workers(jobs or None, backend or "loky", address)


def scenario_specs(
    scenario: str | None = None,
    *,
    lot: str | None = None,
    occupancy: Path | None = None,
    mapping: Path | None = None,
    goal: str | None = None,
    arrival: str | None = None,
    days: str | None = None,
    sensor_model: str | None = None,
    view_range: float | None = None,
    cars: int | None = None,
    pedestrians: int | None = None,
    traffic: TrafficSpec | None = None,
    base: Sequence[ScenarioSpec] | None = None,
    default: str = "campus",
) -> list[ScenarioSpec]:
    """Return the scenarios that options describe; options override the values of scenario files.

    Args:
        scenario: names of packaged scenarios and scenario files, separated by commas.
        lot: names of packaged lots and lot files, separated by commas, with the occupancy of a typical week.
        occupancy: a log or process file to replace the scenario's occupancy.
        mapping: file that maps the log's slots to the lot's.
        goal: a point, X,Y, or an index.
        arrival: hours, HH:MM-HH:MM.
        days: days, such as weekdays.
        sensor_model: a name or a file.
        view_range: view range, m.
        cars: number of moving cars.
        pedestrians: number of pedestrians.
        traffic: traffic of scenarios that name none.
        base: scenarios to change if neither `scenario` nor `lot` is given.
        default: names used if there is no base either.

    Raises:
        InputError: an unknown name, an unusable file, or options that exclude each other.
    """
    if scenario is not None and lot is not None:
        raise InputError("--scenario and --lot exclude each other: a scenario has its lot")
    if mapping is not None and occupancy is None:
        raise InputError("--mapping goes with --occupancy FILE.csv")
    if lot is not None:
        specs = [
            ScenarioSpec.parse({"name": Path(word).stem, "lot": word}, "--lot")
            for word in words("--lot", lot)
        ]
    elif scenario is None and base is not None:
        specs = list(base)
    else:
        specs = [scenario_spec(word) for word in words("--scenario", scenario or default)]
    return [
        _with_traffic(
            _changed(spec, occupancy, mapping, goal, arrival, days, sensor_model, view_range),
            cars,
            pedestrians,
            traffic or TrafficSpec(),
        )
        for spec in specs
    ]


def _with_traffic(
    spec: ScenarioSpec, cars: int | None, pedestrians: int | None, default: TrafficSpec
) -> ScenarioSpec:
    if cars is None and pedestrians is None:
        return spec
    usual = spec.traffic or default
    return spec.changed(
        "--cars, --pedestrians",
        traffic={
            "cars": usual.cars if cars is None else cars,
            "pedestrians": usual.pedestrians if pedestrians is None else pedestrians,
        },
    )


def _changed(
    spec: ScenarioSpec,
    occupancy: Path | None,
    mapping: Path | None,
    goal: str | None,
    arrival: str | None,
    days: str | None,
    sensor_model: str | None,
    view_range: float | None,
) -> ScenarioSpec:
    if occupancy is not None and mapping is not None:
        spec = spec.changed(
            "--mapping", occupancy={"log": str(occupancy), "mapping": str(mapping)}, forecast="own"
        )
    elif occupancy is not None:
        spec = spec.changed("--occupancy", occupancy=str(occupancy), forecast="own")
    if goal is not None:
        spec = spec.changed("--goal", goal=_point(goal))
    if arrival is not None:
        spec = spec.changed("--arrival", arrivals={"hours": arrival, "days": spec.arrivals.days})
    if days is not None:
        spec = spec.changed("--days", arrivals={"hours": spec.arrivals.hours, "days": days})
    if sensor_model is not None:
        spec = spec.changed("--sensor-model", sensor_model=sensor_model)
    if view_range is not None:
        spec = spec.changed(
            "--view-range", sensor_model=spec.sensor_model.changed("--view-range", view_range=view_range)
        )
    return spec


def _point(goal: str) -> list[float] | int:
    try:
        numbers = [float(word) for word in goal.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) == 1 and goal.isdecimal():
        return int(goal)
    if len(numbers) != 2:
        raise InputError(
            f"--goal is {goal!r}, want X,Y in metres, e.g. 80,-4, or the index of one of the lot's goals"
        )
    return numbers


def one_scenario(specs: list[ScenarioSpec]) -> ScenarioSpec:
    """Return the only scenario.

    Raises:
        InputError: there are several scenarios.
    """
    if len(specs) > 1:
        raise InputError(f"--scenario names {len(specs)} scenarios, want one")
    return specs[0]


DetectorOption = Annotated[
    str,
    typer.Option(
        "--detector",
        help="hog: the packaged models; side or front: one of them; a model file; MODULE:CLASS: your own.",
    ),
]


def rig_of(word: str | None) -> str | None:
    """Check the name of a rig, and return it."""
    from sim_sensors.rig import RIG_NAMES

    if word is not None and word not in RIG_NAMES:
        raise InputError(f"--rig is {word!r}, want one of {', '.join(RIG_NAMES)}")
    return word


def saved(folder: Path, name: str, kind: type[SpecT]) -> SpecT:
    """Read the specification in the folder of a run.

    Raises:
        InputError: there is none.
    """
    file = folder / name
    if not file.exists():
        raise InputError(f"--resume: {folder} holds no run to go on with: no {name}")
    return kind.read(file)
