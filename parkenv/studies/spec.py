"""Specification of an experiment file: agents, scenarios, a grid of settings, episodes, seed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, model_validator
from pydantic_core import PydanticCustomError

from parkenv.errors import InputError
from parkenv.files.known_names import (
    KNOWLEDGE,
    SCENARIO_NAMES,
    BackendName,
    KnowledgeName,
    LocaliserName,
    MapName,
    RigName,
    WeatherName,
)
from parkenv.files.limited_reading import is_there
from parkenv.files.option import Option, numbers_in, words_in
from parkenv.files.spec_file import Axis, DetectorName, FilePath, OrText, Several, Spec
from parkenv.scenarios.spec import (
    Cost,
    Hours,
    Probability,
    ScenarioSpec,
    Speed,
    TrafficSpec,
    lot_scenario,
    scenario_spec,
    scenario_specs,
)
from parkenv.studies.agent_spec import AgentItem, AgentSpec, split_agents
from planners.names import AGENTS

MAX_EPISODES = 10_000_000
"""Maximum number of episodes of an experiment, over all agents, scenarios and settings."""
MAX_DAYS = 3_650
"""Maximum number of days of a commute."""
MAX_SETTINGS = 10_000
"""Maximum number of settings of an experiment with many cars."""
SPEC_FILE = "experiment.json"  # file in a run folder with the specification of its experiment
DEFAULT_AGENTS = (
    "mdp", "mdp-static", "mdp-tuned", "belief", "greedy-goal", "greedy-drive", "first-free", "random", "oracle",
)  # fmt: skip
FAILURE_COST_SWEEP = (0.0, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0)
"""Failure costs of `--failure-cost sweep`, s."""

T = TypeVar("T")


def _scenario_tables(value: object, info: ValidationInfo) -> object:
    """Resolve the name of a packaged scenario, or a file relative to the one that names it."""
    if not isinstance(value, str | Path):
        return value
    folder = (info.context or {}).get("folder", Path())
    return scenario_spec(value if str(value) in SCENARIO_NAMES else Path(folder) / value)


ScenarioItem = Annotated[ScenarioSpec, BeforeValidator(_scenario_tables), OrText()]
"""A scenario in a file: a name, a file, or an inline table."""


def _with_folders(value: object, info: ValidationInfo) -> object:
    """Replace folders in a list of scenarios by the scenarios in them."""
    if not isinstance(value, list | tuple):
        return value
    folder = Path((info.context or {}).get("folder", Path()))
    listed: list[object] = []
    for one in value:
        at = folder / one if isinstance(one, str | Path) and str(one) not in SCENARIO_NAMES else None
        listed += scenario_specs(at) if at is not None and is_there(at) and at.is_dir() else [one]
    return listed


def _one_word(text: str) -> str:
    words = words_in(text)
    if len(words) > 1:
        raise InputError(f"names {len(words)} scenarios, want one")
    return words[0]


def _lots(text: str) -> list[ScenarioSpec]:
    return [lot_scenario(word, "--lot") for word in words_in(text)]


_LOT_ALONE = (
    "Instead of a scenario: a week as in busy real car parks on this lot. A packaged lot, GeoJSON, or a Dragon Lake "
    "map (.yml)."
)
_NAMES = ", ".join(SCENARIO_NAMES)
Scenarios = Annotated[
    Several[ScenarioItem],
    BeforeValidator(_with_folders),
    Field(
        min_length=1,
        max_length=1_000,
        description=f"{_NAMES}; scenario files (.toml), lots (.geojson), or folders.",
    ),
    Option("--scenario", takes="NAME|FILE|DIR[,...]", parse=words_in),
    Option("--lot", takes="NAME|FILE[,...]", panel="World", parse=_lots, description=_LOT_ALONE),
]
"""Scenarios in a file: names, files, folders of scenario and lot files, or inline tables."""
OneScenario = Annotated[
    ScenarioItem,
    Field(description=f"{_NAMES}, a scenario file (.toml), or a lot (.geojson)."),
    Option("--scenario", takes="NAME|FILE", parse=_one_word),
    Option(
        "--lot",
        takes="NAME|FILE",
        panel="World",
        parse=lambda text: _lots(_one_word(text))[0],
        description=_LOT_ALONE,
    ),
]
"""The one scenario of a file."""
_AGENTS = (
    f"Agents, with any options in brackets, mdp(failure_s=90): {', '.join(AGENTS)}; ALGORITHM:FILE for a trained "
    "model; MODULE:CLASS for your own."
)
Agents = Annotated[
    Several[AgentItem],
    Field(min_length=1, max_length=1_000, description=_AGENTS),
    Option(takes="NAME[,...]", parse=split_agents),
]
"""Agents in a file: names, or tables with a name and options."""
Seed = Annotated[
    int, Field(ge=0, lt=2**31, description="First seed; episode i uses seed + i."), Option(takes="N >= 0")
]


def _listed(value: object) -> object:
    return value if isinstance(value, list | tuple) else [value]


Level = Annotated[float, Field(gt=0.0, lt=1.0)]
Values = Annotated[Axis[T], BeforeValidator(_listed)]  # an axis of the grid; a single value needs no list


def _failure_costs(text: str) -> object:
    return FAILURE_COST_SWEEP if text == "sweep" else numbers_in(text)


_COSTS = "Costs and speeds"


class Grid(Spec):
    """Settings to vary; every combination is run. Scenarios keep their own values for missing axes."""

    failure_s: Annotated[
        Values[Cost] | None,
        Option(
            "--failure-cost",
            takes="S[,S...]|sweep",
            default="the scenario's, 10",
            panel=_COSTS,
            parse=_failure_costs,
        ),
    ] = Field(
        None,
        description="Seconds that the world charges for a failed attempt, and that planners expect unless their own "
        "options say otherwise. sweep: 0 to 120 s.",
    )
    v_walk_kmh: Annotated[
        Values[Speed] | None, Option(takes="V[,V...]", default="the scenario's, 4", panel=_COSTS)
    ] = Field(None, description="Walking speed, km/h.")
    v_drive_kmh: Annotated[
        Values[Speed] | None, Option(takes="V[,V...]", default="the scenario's, 10", panel=_COSTS)
    ] = Field(None, description="Driving speed, km/h.")
    occupancy_levels: Annotated[
        tuple[Level, ...],
        AfterValidator(lambda v: tuple(sorted(set(v)))),
        Option(
            takes="P[,...]|none",
            default="0.5,0.7,0.8,0.9,0.95,0.99; none with --failure-cost sweep",
            panel="World",
        ),
    ] = Field(
        (),
        strict=False,
        max_length=100,
        description="Also set the lot's mean occupancy to these values, with a third of the episodes each, for the "
        "figure of time against occupancy. Searches in a recorded log are binned instead.",
    )
    map_says: Annotated[
        tuple[Probability, ...],
        AfterValidator(lambda v: tuple(sorted(set(v)))),
        Option(takes="P[,...]", panel="World", default="none"),
    ] = Field(
        (),
        strict=False,
        max_length=100,
        description="Also with wrong maps that give every slot this probability of being taken; draws total time "
        "against it.",
    )
    blind: bool = Field(
        False,
        description="Also without observations of slots before an attempt, for agents that can do without.",
    )
    calibrated: Annotated[FilePath | None, Option(panel=_COSTS)] = Field(
        None,
        description="Also compare at the failure cost and driving speed in a calibrated.json of `parkenv calibrate`, "
        "in the same worlds.",
    )


_MACHINES = "Machines"


class Workplace(Spec):
    """Where tasks run; the results do not depend on it."""

    jobs: Annotated[int, Option(short="-j", takes="N >= 0", panel=_MACHINES, default="0, all cores")] = Field(
        0, ge=0, le=10_000, description="Worker processes, at most one per core and per task."
    )
    backend: Annotated[BackendName, Option(panel=_MACHINES)] = Field(
        "loky",
        description="Run workers on this machine (loky), or on a Ray or Dask cluster (extras ray, dask).",
    )
    address: Annotated[
        str | None, Option(takes="HOST:PORT", panel=_MACHINES, default="a cluster on this machine")
    ] = Field(
        None,
        description="Of the cluster: Ray's head, HOST:6379 or ray://HOST:10001; Dask's scheduler, tcp://HOST:8786.",
    )


Detector = Annotated[
    DetectorName | None,
    Field(
        description="hog: the packaged HOG models; side or front: one of them; net: the packaged network; a file of "
        "`parkenv train-detector` (.npz) or a network (.onnx); MODULE:CLASS: your own."
    ),
    Option(takes="NAME|FILE|MODULE:CLASS", panel="Sensors", default="the scenario's, hog"),
]
Figures = Annotated[bool, Field(description="Draw figures."), Option(panel="Results")]


def _require_distinct(agents: tuple[AgentSpec, ...], scenarios: tuple[ScenarioSpec, ...]) -> None:
    for what, names in (
        ("agents", [agent.label for agent in agents]),
        ("scenarios", [scenario.title for scenario in scenarios]),
    ):
        repeated = [name for i, name in enumerate(names) if name in names[:i]]
        if repeated:
            raise PydanticCustomError("whole", f"{what} has {{name}} twice", {"name": repr(repeated[0])})


class ExperimentSpec(Workplace):
    """An experiment file: all agents search in the same worlds, in every scenario and setting."""

    kind: Literal["compare"] = "compare"
    agents: Annotated[Agents, Option(takes="NAME[,...]", parse=split_agents, default="all but exact")] = (
        Field(
            tuple(AgentSpec(name=name) for name in DEFAULT_AGENTS),
            description=f"{_AGENTS} Differences are to the first.",
        )
    )
    scenarios: Scenarios = (scenario_spec("campus"),)
    grid: Grid = Grid()
    episodes: Annotated[int, Option(short="-n", takes="N >= 1")] = Field(
        200, ge=1, le=MAX_EPISODES, description="Episodes of each agent in each setting."
    )
    seed: Seed = 0
    rig: Annotated[RigName | None, Option(panel="Sensors")] = Field(
        None,
        description="Observe slots through simulated sensors, detector and all, instead of the sensor model: about a "
        "second a step. laser: a camera and a 270° laser; stereo: a stereo camera; both_sides: a laser and a camera to "
        "each side.",
    )
    detector: Detector = None
    figures: Figures = True

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        _require_distinct(self.agents, self.scenarios)
        if self.detector is not None and self.rig is None:
            raise PydanticCustomError("whole", "detector goes with a rig, such as laser")
        if (count := self.episode_count) > MAX_EPISODES:
            raise PydanticCustomError(
                "whole",
                "agents x scenarios x grid x episodes is {count} searches, want at most {most}",
                {"count": count, "most": MAX_EPISODES},
            )
        return self

    @property
    def episode_count(self) -> int:
        """Upper bound on the episodes of all agents, scenarios and settings."""
        grid = self.grid
        failure, walk, drive = (
            len(axis) if axis is not None else 1
            for axis in (grid.failure_s, grid.v_walk_kmh, grid.v_drive_kmh)
        )
        worlds = len(self.scenarios) * (1 + len(grid.map_says)) * (1 + grid.blind)
        settings = (
            failure * walk * drive + (walk if grid.calibrated else 0) + failure * len(grid.occupancy_levels)
        )
        return len(self.agents) * worlds * settings * self.episodes


class CommuteSpec(Workplace):
    """Drivers who come day after day, with a map that learns from their trips."""

    kind: Literal["commute"] = "commute"
    agents: Several[AgentItem] = Field(
        tuple(AgentSpec(name=name) for name in ("belief", "mdp", "first-free", "greedy-drive")),
        min_length=1,
        max_length=1_000,
    )
    scenarios: Scenarios = (scenario_spec("campus"),)
    maps: Annotated[Axis[MapName], BeforeValidator(_listed)] = Field(
        ("empty",), description="Maps to start from: empty, right or wrong."
    )
    days: int = Field(30, ge=1, le=MAX_DAYS, description="Days on which each driver comes.")
    drivers: int = Field(40, ge=1, le=100_000, description="Repetitions, each with a map of its own.")
    fleet: int = Field(1, ge=1, le=1_000, description="Drivers who share a map.")
    seed: int = Field(0, ge=0, lt=2**31)
    figures: bool = True

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        _require_distinct(self.agents, self.scenarios)
        count = (
            len(self.agents)
            * len(self.scenarios)
            * (len(self.maps) + 1)
            * self.days
            * self.drivers
            * self.fleet
        )
        if count > MAX_EPISODES:
            raise PydanticCustomError(
                "whole",
                "agents x scenarios x maps x days x drivers is {count} searches, want at most {most}",
                {"count": count, "most": MAX_EPISODES},
            )
        return self


ArrivalRate = Annotated[float, Field(gt=0.0, le=1e6)]
Stay = Annotated[float, Field(ge=1.0, le=1e7)]  # s


class FleetSpec(Workplace):
    """Days on which many cars search one lot, and what they know."""

    kind: Literal["fleet"] = "fleet"
    agents: Several[AgentItem] = Field(
        (AgentSpec(name="greedy-drive"),), min_length=1, max_length=1_000,
        description="Each drives all cars in turn.",
    )  # fmt: skip
    scenario: ScenarioItem = scenario_spec("campus")
    knows: Annotated[Axis[KnowledgeName], BeforeValidator(_listed)] = Field(
        KNOWLEDGE, description="What members know: own, shared, reserve or full."
    )
    shares: Values[Probability] = Field((1.0,), description="Shares of the cars that are members.")
    arrivals_per_hour: Values[ArrivalRate] = Field((60.0, 120.0, 240.0), description="Cars.")
    days: int = Field(10, ge=1, le=100_000, description="Days of each setting.")
    stay_s: Stay = Field(3600.0, description="Mean of the exponentially distributed stays, s.")
    patience_s: Stay = Field(600.0, description="Search time after which a car goes elsewhere, s.")
    delay_s: float = Field(0.0, ge=0.0, le=1e5, description="Age of the live map, s.")
    manoeuvre_s: float | None = Field(
        None, ge=0.0, le=3600.0,
        description="Time for which a car that parks or leaves blocks its lane, s; if absent, as calibrated, or 0.",
    )  # fmt: skip
    leaving_soon_s: float = Field(
        0.0,
        ge=0.0,
        le=3600.0,
        description="Time for which a car shows that it leaves, s; who waits has the slot.",
    )
    sees_cars: bool = Field(False, description="Whether agents observe the other cars in view.")
    calibrated: FilePath | None = Field(
        None, description="Speed, failure cost and manoeuvre from a calibrated.json of `parkenv calibrate`."
    )
    decision_limit_s: float | None = Field(
        None, ge=0.01, le=1e5, description="Wall time after which a decision in Python stops the run, s."
    )
    seed: int = Field(0, ge=0, lt=2**31)
    figures: bool = True

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        _require_distinct(self.agents, ())
        if self.decision_limit_s is not None and self.backend == "dask":
            raise PydanticCustomError(
                "whole",
                "decision_limit_s goes with the backends loky and ray; threads of Dask get no timer signal",
            )
        settings = len(self.agents) * len(self.knows) * len(self.shares) * len(self.arrivals_per_hour)
        if settings > MAX_SETTINGS:
            raise PydanticCustomError(
                "whole",
                "agents x knows x shares x arrivals_per_hour is {count} settings, want at most {most}",
                {"count": settings, "most": MAX_SETTINGS},
            )
        if (count := settings * self.days) > MAX_EPISODES:
            raise PydanticCustomError(
                "whole",
                "agents x knows x shares x arrivals_per_hour x days is {count} days, want at most {most}",
                {"count": count, "most": MAX_EPISODES},
            )
        return self


class BenchmarkSpec(Workplace):
    """A run of a benchmark suite, which defines scenarios, costs, speeds and seeds."""

    kind: Literal["benchmark"] = "benchmark"
    suite: str = "v2"
    by: str = Field("", max_length=200, description="Who submits the result.")
    agents: Several[AgentItem] = Field(
        tuple(
            AgentSpec(name=name)
            for name in ("belief", "mdp-tuned", "mdp", "first-free", "greedy-drive", "greedy-goal")
        ),
        min_length=1,
        max_length=1_000,
    )


BUSY = TrafficSpec(cars=3, pedestrians=5)
"""Default traffic of runs with simulated sensors."""
CaptureDistance = Annotated[float, Field(ge=0.1, le=1_000.0)]
"""Distance between captures, m."""


class SurveySpec(Workplace):
    """A survey: drives past every slot with simulated sensors, recorded in a map file."""

    kind: Literal["survey"] = "survey"
    scenario: ScenarioItem = scenario_spec("campus")
    sessions: int = Field(6, ge=1, le=100_000)
    rig: RigName | None = Field(None, description="The scenario's if absent.")
    detector: DetectorName | None = Field(
        None, description="hog, side, front, a file (.npz, .onnx) or MODULE:CLASS; the scenario's if absent."
    )
    hours: Several[Hours] = Field(
        ("08:00-10:00", "11:00-14:00", "16:00-18:00"), min_length=1, max_length=1_000,
        description="When drives begin, one window after the other, on the scenario's days.",
    )  # fmt: skip
    weather: WeatherName | None = Field(None, description="Drawn for each session if absent.")
    every: CaptureDistance = 1.25
    pose_noise: float = Field(0.0, ge=0.0, le=100.0, description="Localisation error of the car, m.")
    odometry_drift: float = Field(
        0.0,
        ge=0.0,
        le=0.5,
        description="Error of the car's odometry after 100 m, as a share of the distance.",
    )
    localise: LocaliserName = Field("none", description="What corrects the odometry.")
    picture_width: int | None = Field(
        None, ge=64, le=4_096, description="Width of the cameras' pictures, px; 640 if absent."
    )
    seed: int = Field(0, ge=0, lt=2**31)


class DemoSpec(Workplace):
    """A survey, and searches on other days with its map."""

    kind: Literal["demo"] = "demo"
    scenario: ScenarioItem = scenario_spec("campus")
    sessions: int = Field(4, ge=1, le=100_000)
    episodes: int = Field(6, ge=2, le=MAX_EPISODES, description="Searches of each agent.")
    every: CaptureDistance = Field(2.5, description="Between captures, m, in the survey and in the searches.")
    detector: DetectorName | None = Field(
        None, description="hog, side, front, a file (.npz, .onnx) or MODULE:CLASS; the scenario's if absent."
    )
    seed: int = Field(0, ge=0, lt=2**31)
