"""Options that several commands share, and how their words become objects."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from parkenv.errors import InputError
from parkenv.lots import load_lot
from parkenv.world.lot import ParkingLot
from parkenv.world.occupancy import ArrivalWindow, OccupancyModel, OccupancyProcess
from parkenv.world.scenario import Scenario
from parkenv.world.sensor_model import SENSOR_MODEL_NAMES, SensorModel

if TYPE_CHECKING:
    from parkenv.evaluation.experiments.workers import Workers

WORLD = "The world"
COSTS = "Costs and speeds"
MACHINES = "Machines"

LotOption = Annotated[
    Path | None,
    typer.Option(
        "--lot", help="A lot file: native GeoJSON, or a Dragon Lake map (.yml).", rich_help_panel=WORLD
    ),
]
OccupancyOption = Annotated[
    Path | None,
    typer.Option(
        "--occupancy",
        help="What stands in the slots: a recorded log (.csv, .csv.gz; replayed day by day) or a process "
        "written by `parkenv occupancy fit` (.json). A typical working week where none is given.",
        rich_help_panel=WORLD,
    ),
]
MappingOption = Annotated[
    Path | None,
    typer.Option(
        "--mapping",
        help="CSV slot_id,log_slot_id that puts the log's slots on the lot's. Without it the log's fullest "
        "slots go nearest to the goal.",
        rich_help_panel=WORLD,
    ),
]
GoalOption = Annotated[
    str | None,
    typer.Option(
        "--goal",
        metavar="X,Y",
        help="Walk to this point, m, not to the lot's own goal.",
        rich_help_panel=WORLD,
    ),
]
ArrivalOption = Annotated[
    str,
    typer.Option(
        "--arrival", metavar="HH:MM-HH:MM", help="Searches start between these hours.", rich_help_panel=WORLD
    ),
]
DaysOption = Annotated[
    str,
    typer.Option(
        "--days", help="On these days: weekdays, weekend, all, or e.g. mon,tue.", rich_help_panel=WORLD
    ),
]
ViewRangeOption = Annotated[
    float | None,
    typer.Option("--view-range", help="How far slots are seen from the car, m.", rich_help_panel=WORLD),
]
SightOption = Annotated[
    str | None,
    typer.Option(
        "--sensor-model",
        metavar="perfect|laser|stereo|FILE",
        help="How slots are seen: without error within --view-range; as the detection and mapping stack was "
        "measured to see with a rig; or as a file of `parkenv fit-sensor-model` says.  "
        "[default: perfect; with --sensors as measured of the rig]",
        rich_help_panel=WORLD,
    ),
]
CarsOption = Annotated[int, typer.Option("--cars", metavar="N", min=0, help="Other cars that drive about.")]
PedestriansOption = Annotated[
    int, typer.Option("--pedestrians", metavar="M", min=0, help="People who walk about.")
]
SensorsOption = Annotated[
    str | None,
    typer.Option(
        "--sensors",
        metavar="laser|stereo|both_sides",
        help="Look through this rig's simulated sensors, detector and all, where the sighting model would stand for "
        "them: about a second a step.",
        rich_help_panel=WORLD,
    ),
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
    str,
    typer.Option(
        "--failure-cost",
        metavar="S[,S...]",
        help="Seconds lost by a try at a taken slot.",
        rich_help_panel=COSTS,
    ),
]
WalkOption = Annotated[
    str, typer.Option("--v-walk-kmh", metavar="V[,V...]", help="Walking speed, km/h.", rich_help_panel=COSTS)
]
DriveOption = Annotated[
    str, typer.Option("--v-drive-kmh", metavar="V[,V...]", help="Driving speed, km/h.", rich_help_panel=COSTS)
]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="First seed; episode i uses seed + i.")]
JobsOption = Annotated[
    int,
    typer.Option("--jobs", "-j", min=0, help="Worker processes; 0 takes all cores. The result is the same."),
]


BackendOption = Annotated[
    str,
    typer.Option(
        "--backend",
        metavar="loky|ray|dask",
        help="Where workers run: on this machine (loky), or on a Ray or Dask cluster (extras ray, dask). The result is "
        "the same.",
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
    """Comma-separated numbers.

    Raises:
        InputError: something else; the message names the option.
    """
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        raise InputError(f"{option} is {text!r}, want numbers separated by commas, e.g. 10,90") from None
    if len(set(values)) < len(values):
        raise InputError(f"{option} is {text!r}: a value stands twice")
    return values


SWEEP = (0.0, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0)
"""s, the failure costs of `--failure-cost sweep`."""


def speeds(option: str, text: str) -> list[float]:
    """Comma-separated speeds, km/h, that a person or a car may have."""
    return _between(option, text, 0.1, 300.0, "a speed above 0: 0.1 to 300 km/h")


def costs(option: str, text: str) -> list[float]:
    """Comma-separated costs, s, of at most a day."""
    return _between(option, text, 0.0, 86400.0, "seconds from 0 to 86400")


def _between(option: str, text: str, least: float, most: float, wanted: str) -> list[float]:
    values = numbers(option, text)
    for value in values:
        if not least <= value <= most:
            raise InputError(f"{option} is {value:g}, want {wanted}")
    return values


def words(option: str, text: str) -> list[str]:
    """Comma-separated words, at least one, none twice."""
    values = [word.strip() for word in text.split(",") if word.strip()]
    if not values:
        raise InputError(f"{option} is {text!r}, want names separated by commas")
    if len(set(values)) < len(values):
        raise InputError(f"{option} is {text!r}: a name stands twice")
    return values


def workers_of(jobs: int, backend: str, address: str | None) -> Workers:
    """Where tasks run; with `with`, clusters are connected to, and left again.

    Raises:
        InputError: options that do not go together.
    """
    from parkenv.evaluation.experiments.workers import Workers

    return Workers(jobs or None, backend, address)


def lot_of(path: Path, goal: str | None = None) -> ParkingLot:
    """The lot in a file, with another goal where one is given."""
    lot = load_lot(path)
    if goal is None:
        return lot
    try:
        point = [float(word) for word in goal.split(",")]
    except ValueError:
        point = []
    if len(point) != 2:
        raise InputError(f"--goal is {goal!r}, want X,Y in metres, e.g. 80,-4")
    return dataclasses.replace(lot, goals=np.array([point]))


def occupancy_of(path: Path, lot: ParkingLot, mapping: Path | None) -> OccupancyModel:
    """The recorded log or the process in a file, laid on the lot's slots.

    Raises:
        InputError: the file is neither, or its record cannot be laid on the lot.
    """
    if path.suffix == ".json":
        if mapping is not None:
            raise InputError("--mapping goes with a recorded log, not with a process")
        process = OccupancyProcess.from_file(path)
        # A process carries no slot ids: one of the lot's size is taken to be the lot's own.
        return process if process.n_slots == lot.n_slots else process.mapped_to_lot(lot.walk_m())
    if not path.name.endswith((".csv", ".csv.gz")):
        raise InputError(f"{path}: want a recorded log (.csv or .csv.gz) or a process (.json)")
    from parkenv.world.occupancy_log import OccupancyLog
    from parkenv.world.recorded_occupancy import RecordedOccupancy, read_mapping

    log = OccupancyLog.read(path)
    placed = None if mapping is None else read_mapping(mapping, lot.slot_ids, log)
    return RecordedOccupancy(log, lot.walk_m(), placed)


def sighting_of(word: str) -> SensorModel:
    """The sighting model that a word or a file stands for.

    Raises:
        InputError: neither a known word nor a file.
    """
    if word == "perfect":
        return SensorModel()
    if word in SENSOR_MODEL_NAMES:
        return SensorModel.named(word)
    if not Path(word).exists():
        raise InputError(
            f"--sensor-model is {word!r}, want perfect, {', '.join(SENSOR_MODEL_NAMES)}, or a file that is there"
        )
    return SensorModel.from_file(word)


def rig_of(word: str | None) -> str | None:
    """A rig's name, checked."""
    from sim_sensors.rig import RIG_NAMES

    if word is not None and word not in RIG_NAMES:
        raise InputError(f"--sensors is {word!r}, want one of {', '.join(RIG_NAMES)}")
    return word


def scenarios_of(
    scenario: str | None,
    lot: Path | None,
    occupancy: Path | None,
    mapping: Path | None,
    goal: str | None,
    arrival: str,
    days: str,
    view_range: float | None,
    sight: str = "perfect",
) -> list[Scenario]:
    """What the options of the world describe: packaged scenarios, or one on a lot file."""
    if lot is None:
        for option, value in (("--occupancy", occupancy), ("--mapping", mapping), ("--goal", goal)):
            if value is not None:
                raise InputError(f"{option} goes with --lot; packaged scenarios have their own")
        made = [Scenario.named(name) for name in words("--scenario", scenario or "campus")]
    else:
        if scenario is not None:
            raise InputError(
                "--scenario and --lot exclude each other: name a packaged scenario or give a file"
            )
        if mapping is not None and occupancy is None:
            raise InputError("--mapping goes with --occupancy")
        its_lot = lot_of(lot, goal)
        made = [
            Scenario.on_lot(its_lot, None if occupancy is None else occupancy_of(occupancy, its_lot, mapping))
        ]
    try:
        window = ArrivalWindow.parse(arrival, days)
    except InputError as error:
        raise InputError(
            f"--arrival {arrival} --days {days}: {error}; a window lies within one day"
        ) from error
    changes: dict[str, Any] = {"arrival": window}
    seeing = sighting_of(sight)
    changes["sensor_model"] = (
        seeing if view_range is None else dataclasses.replace(seeing, view_range=view_range)
    )
    return [s.replace(**changes) for s in made]


def fingerprint(path: Path | None) -> str | None:
    """A short hash of a file's content, so that a resumed run notices a changed file."""
    return None if path is None else hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def agent_fingerprints(names: Iterable[str]) -> dict[str, str]:
    """Fingerprints, by name, of those agents that are read from files: trained models and agents of one's own."""
    from planners.agent import agent_file

    prints = {name: fingerprint(agent_file(name)) for name in dict.fromkeys(names)}
    return {name: its for name, its in prints.items() if its is not None}
