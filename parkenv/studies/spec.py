"""Specification of an experiment file: agents, scenarios, a grid of settings, episodes, seed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, model_validator
from pydantic_core import PydanticCustomError

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
from parkenv.files.spec_file import Axis, DetectorName, FilePath, OrText, Several, Spec
from parkenv.scenarios.spec import (
    Cost,
    Hours,
    Probability,
    ScenarioSpec,
    Speed,
    TrafficSpec,
    scenario_spec,
    scenario_specs,
)
from parkenv.studies.agent_spec import AgentItem, AgentSpec

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


Scenarios = Annotated[
    Several[ScenarioItem], BeforeValidator(_with_folders), Field(min_length=1, max_length=1_000)
]
"""Scenarios in a file: names, files, folders of scenario and lot files, or inline tables."""


def _listed(value: object) -> object:
    return value if isinstance(value, list | tuple) else [value]


Level = Annotated[float, Field(gt=0.0, lt=1.0)]
Values = Annotated[Axis[T], BeforeValidator(_listed)]  # an axis of the grid; a single value needs no list


class Grid(Spec):
    """Settings to vary; every combination is run. Scenarios keep their own values for missing axes."""

    failure_s: Values[Cost] | None = Field(
        None,
        description="Cost of a failed attempt, s: what the world charges, and what planners assume of it.",
    )
    v_walk_kmh: Values[Speed] | None = None
    v_drive_kmh: Values[Speed] | None = None
    occupancy_levels: Annotated[tuple[Level, ...], AfterValidator(lambda v: tuple(sorted(set(v))))] = Field(
        (),
        strict=False,
        max_length=100,
        description="Also set the mean occupancy to these, a third as many episodes.",
    )
    map_says: Annotated[tuple[Probability, ...], AfterValidator(lambda v: tuple(sorted(set(v))))] = Field(
        (), strict=False, max_length=100, description="Also with wrong maps: this probability for every slot."
    )
    blind: bool = Field(
        False,
        description="Also without observations of slots before an attempt, for agents that can do without.",
    )
    calibrated: FilePath | None = Field(
        None, description="Also at the failure cost and speed in a calibrated.json of `parkenv calibrate`."
    )


class Workplace(Spec):
    """Where tasks run; the results do not depend on it."""

    jobs: int = Field(0, ge=0, le=10_000, description="Worker processes; 0 for all cores.")
    backend: BackendName = "loky"
    address: str | None = Field(None, description="Of a Ray or Dask cluster.")


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
    agents: Several[AgentItem] = Field(
        tuple(AgentSpec(name=name) for name in DEFAULT_AGENTS), min_length=1, max_length=1_000,
        description="Differences are to the first.",
    )  # fmt: skip
    scenarios: Scenarios = (scenario_spec("campus"),)
    grid: Grid = Grid()
    episodes: int = Field(200, ge=1, le=MAX_EPISODES, description="Searches of each agent in each setting.")
    seed: int = Field(0, ge=0, lt=2**31, description="Episode i has the seed `seed` + i.")
    rig: RigName | None = Field(None, description="Observe slots through this rig's simulated sensors.")
    detector: DetectorName | None = Field(
        None, description="hog, side, front, a file (.npz, .onnx) or MODULE:CLASS; the scenario's if absent."
    )
    figures: bool = True

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
