"""Types of fields that several kinds of studies have."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    WithJsonSchema,
    model_validator,
)

from parkenv.errors import require
from parkenv.files.file_names import file_name
from parkenv.files.known_names import DETECTOR_SUFFIXES, SCENARIO_NAMES, RigName
from parkenv.files.limited_reading import is_there
from parkenv.files.option import Inside, Option, parse_call, seconds_of_minutes, words_in
from parkenv.files.spec_file import Axis, DetectorName, OrText, Several, Spec, require_together
from parkenv.forecast.event_table import is_counts
from parkenv.scenarios.spec import ScenarioSpec, TrafficSpec, lot_scenario, scenario_spec, scenario_specs
from planners.names import AGENTS, FILE_AGENTS

OptionValue = bool | int | float | str


class AgentSpec(Spec):
    """An agent and its options for `planners.make_agent`: `{ name = "mdp", failure_s = 90 }`."""

    model_config = ConfigDict(extra="allow")

    name: str

    @model_validator(mode="after")
    def _plain_options(self) -> Self:
        for option, value in self.options.items():
            if not isinstance(value, OptionValue) or value != value:
                raise ValueError(f"{option} to be a number, true, false or text, not {value!r}")
        return self

    @classmethod
    def of(cls, text: str) -> Self:
        return cls.parse(parse_call(text), "agent")

    @property
    def options(self) -> dict[str, Any]:
        return dict(self.model_extra or {})

    @property
    def label(self) -> str:
        return label_of(self.name, self.options)


def label_of(name: str, options: dict[str, Any]) -> str:
    """Format an agent with its options, such as `mdp(failure_s=90)`."""
    if not options:
        return name
    return f"{name}({','.join(f'{option}={_text(value)}' for option, value in options.items())})"


def _text(value: OptionValue) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


def split_agents(text: str) -> list[str]:
    """Split a comma-separated list of agents; commas within brackets separate options.

    Examples:
        >>> split_agents("mdp(failure_s=90,gamma=1),oracle")
        ['mdp(failure_s=90,gamma=1)', 'oracle']
    """
    words, depth = [""], 0
    for character in text:
        depth += (character == "(") - (character == ")")
        if character == "," and depth <= 0:
            words.append("")
        else:
            words[-1] += character
    return [word.strip() for word in words if word.strip()]


def classes_in(spec: Spec, without: Collection[str] = ()) -> list[str]:
    """Return the classes `MODULE:CLASS` of a user's own that the fields name: agents, detectors and worlds."""
    classes: list[str] = []
    for field in (name for name in type(spec).model_fields if name not in without):
        value = getattr(spec, field)
        for part in value if isinstance(value, tuple) else (value,):
            is_agent, named = isinstance(part, AgentSpec), field in ("detector", "world")
            name = part.name if is_agent else part if named else None
            if isinstance(name, str) and not name.lower().endswith(DETECTOR_SUFFIXES):
                before, colon, _ = name.partition(":")
                classes += [name] if colon and not (is_agent and before in FILE_AGENTS) else []
            elif isinstance(part, Spec):
                classes += classes_in(part)
    return list(dict.fromkeys(classes))


def _tables(value: object) -> object:
    return parse_call(value) if isinstance(value, str) else value


# An agent in a file: `"mdp"`, `"mdp(failure_s=90)"` or a table.
AgentItem = Annotated[AgentSpec, BeforeValidator(_tables), OrText()]


# Maximum number of episodes of an experiment, over all agents, scenarios and settings.
MAX_EPISODES = 10_000_000
T = TypeVar("T")


def _scenario_tables(value: object, info: ValidationInfo) -> object:
    if not isinstance(value, str | Path):
        return value
    folder = (info.context or {}).get("folder", Path())
    return scenario_spec(value if str(value) in SCENARIO_NAMES else Path(folder) / value)


# A scenario in a file: a name, a file, or an inline table.
ScenarioItem = Annotated[ScenarioSpec, BeforeValidator(_scenario_tables), OrText()]


def _with_folders(value: object, info: ValidationInfo) -> object:
    if not isinstance(value, list | tuple):
        return value
    folder = Path((info.context or {}).get("folder", Path()))
    listed: list[object] = []
    for item in value:
        at = folder / item if isinstance(item, str | Path) and str(item) not in SCENARIO_NAMES else None
        listed += scenario_specs(at) if at is not None and is_there(at) and at.is_dir() else [item]
    return listed


def _by_car_park(scenarios: tuple[ScenarioSpec, ...]) -> tuple[ScenarioSpec, ...]:
    """Replace scenarios that replay a file of counts by one for each of its car parks that are named."""
    listed: list[ScenarioSpec] = []
    for scenario in scenarios:
        recorded = scenario.occupancy
        names, files = recorded.car_parks, recorded.log or ()
        if len(files) != 1 or (names is None and not is_counts(files[0], recorded.columns)):
            listed.append(scenario)
            continue
        if names == ("all",) and recorded.mapping is None:
            from parkenv.scenarios.build import car_parks

            counts = recorded.as_counts(None).counts
            assert counts is not None
            names = tuple(car_parks(counts))
        if recorded.mapping is not None:  # each car park on its own slots
            names = None
        for name in names or (None,):
            title = (
                scenario.title
                if name is None
                else file_name(f"{scenario.title} {name}").replace(",", " ")[:80]
            )
            occupancy = recorded.as_counts(name)
            listed.append(scenario.changed("--car-park", name=title, occupancy=occupancy, forecast="own"))
    return tuple(listed)


def _only(items: Sequence[T], what: str) -> T:
    require(len(items) == 1, f"names {len(items)} {what}, want one")
    return items[0]


def _one_car_park(scenario: ScenarioSpec) -> ScenarioSpec:
    return _only(_by_car_park((scenario,)), "scenarios by --car-park")


def one_word(text: str) -> str:
    return _only(words_in(text), "scenarios")


def _lots(text: str) -> list[ScenarioSpec]:
    return [lot_scenario(word, "--lot") for word in words_in(text)]


_LOT_ALONE = (
    "Instead of a scenario: a week as in busy real car parks on this lot. A packaged lot, GeoJSON, or a Dragon Lake "
    "map (.yml)."
)


# Options of what parking costs, which only matters where slots are chosen.
PRICES = ("--price", "--value-of-time", "--stay-min")
# Options of other road users, whom only simulated sensors and driven cars meet.
TRAFFIC = ("--cars", "--pedestrians")
_NAMES = ", ".join(SCENARIO_NAMES)
SCENARIOS_HELP = f"{_NAMES}; scenario files (.toml), lots (.geojson), or folders."
ScenarioList = Annotated[
    Several[ScenarioItem],
    BeforeValidator(_with_folders),
    AfterValidator(_by_car_park),
    Field(min_length=1, max_length=1_000, description=SCENARIOS_HELP),
]
SCENARIOS_TAKE = "NAME|FILE|DIR[,...]"
Scenarios = Annotated[
    ScenarioList,
    Option("--scenario", takes=SCENARIOS_TAKE, parse=words_in),
    Option("--lot", takes="NAME|FILE[,...]", panel="World", parse=_lots, description=_LOT_ALONE),
    Inside(without=TRAFFIC),
]
OneScenario = Annotated[
    ScenarioItem,
    AfterValidator(_one_car_park),
    Field(description=f"{_NAMES}, a scenario file (.toml), or a lot (.geojson)."),
    Option("--scenario", takes="NAME|FILE", parse=one_word),
    Option(
        "--lot",
        takes="NAME|FILE",
        panel="World",
        parse=lambda text: _lots(one_word(text))[0],
        description=_LOT_ALONE,
    ),
]
AGENTS_HELP = (
    f"Agents, with any options in brackets, mdp(failure_s=90): {', '.join(AGENTS)}; ALGORITHM:FILE for a trained "
    "model; human:FILE for the scores of a game; MODULE:CLASS for your own."
)
Agents = Annotated[
    Several[AgentItem],
    Field(min_length=1, max_length=1_000, description=AGENTS_HELP),
    Option(takes="NAME[,...]", parse=split_agents),
]


OneAgent = Annotated[
    AgentItem,
    Field(description="The agent that searches, with any options in brackets: mdp(failure_s=90)."),
    Option("--agents", takes="NAME", parse=lambda text: _only(split_agents(text), "agents")),
]
Seed = Annotated[int, Field(ge=0, lt=2**31, description="First seed; episode i uses seed + i."), Option()]


def _vehicle(value: object, info: ValidationInfo) -> object:
    if value is None:
        return None
    from parkenv.driving.scene_files import vehicle_of

    return vehicle_of(value, (info.context or {}).get("folder", "."))


Vehicle = Annotated[
    Any,
    BeforeValidator(_vehicle),
    WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "object"}, {"type": "null"}]}),
    Field(description="The car: golf, tpcap, parkbench, a file (.toml, .json), or a table."),
    Option(takes="NAME|FILE", parse=str, default="golf, or that of a scene"),
]  # A `VehicleParameters`, or None for the default


def listed(value: object) -> object:
    return value if isinstance(value, list | tuple) else [value]


Level = Annotated[float, Field(gt=0.0, lt=1.0)]
Values = Annotated[Axis[T], BeforeValidator(listed)]  # an axis of the grid; a single value needs no list
Rig = Annotated[
    RigName | None,
    Field(
        description="Observe slots with simulated sensors and a detector instead of the sensor model: about a "
        "second per step. laser: a camera and a 270° laser; stereo: a stereo camera; both_sides: "
        "a laser and a camera to each side; camera: a camera alone."
    ),
    Option(panel="Sensors"),
]
Detector = Annotated[
    DetectorName | None,
    Field(
        description="hog: the packaged HOG models; side or front: one of them; net: the packaged network; a file of "
        "`parkenv train-detector` (.npz) or a network (.onnx); MODULE:CLASS: your own."
    ),
    Option(takes="NAME|FILE|MODULE:CLASS", panel="Sensors", default="the scenario's, hog"),
]
Figures = Annotated[bool, Field(description="Draw figures."), Option(panel="Results")]


_Stay = Annotated[float, Field(ge=1.0, le=1e7)]  # s
MeanStay = Annotated[
    _Stay,
    Field(description="Mean of the exponentially distributed stays, s."),
    Option(
        "--stay-min",
        takes="MINUTES",
        default="60",
        panel="Demand",
        parse=seconds_of_minutes,
        description="Mean of the exponentially distributed stays, minutes.",
    ),
]
Patience = Annotated[
    _Stay,
    Field(description="Search time after which a car goes elsewhere, s."),
    Option(
        "--patience-min",
        takes="MINUTES",
        default="10",
        panel="Demand",
        parse=seconds_of_minutes,
        description="Minutes after which a searching car goes elsewhere, at the give-up penalty; in a town, "
        "the drive to the goal does not count.",
    ),
]
BUSY = TrafficSpec(cars=3, pedestrians=5)  # default traffic of runs with simulated sensors


def with_traffic(scenario: ScenarioSpec) -> ScenarioSpec:
    """Return the scenario with some traffic if it has none of its own, not even zero."""
    return scenario if scenario.traffic else scenario.changed(traffic=BUSY)


CaptureDistance = Annotated[float, Field(ge=0.1, le=1_000.0)]  # distance between captures, m


def require_distinct_names(agents: tuple[AgentSpec, ...], scenarios: tuple[ScenarioSpec, ...] = ()) -> None:
    for what, names in (
        ("agents", [agent.label for agent in agents]),
        ("scenarios", [scenario.title for scenario in scenarios]),
    ):
        repeated = [name for i, name in enumerate(names) if name in names[:i]]
        require_together(not repeated, f"{what} has {next(iter(repeated), '')!r} twice")


def require_agents(agents: Sequence[AgentSpec], scenarios: Sequence[Any]) -> None:
    """Check that each agent can be made in each scenario."""
    from planners.agent import make_agent

    for scenario in scenarios:
        for agent in agents:
            make_agent(agent.name, scenario, **agent.options)


def require_at_most(count: int, what: str, unit: str, most: int = MAX_EPISODES) -> None:
    require_together(count <= most, f"{what} is {count} {unit}, want at most {most}")


def require_rig(rig: str | None, detector: str | None) -> None:
    require_together(detector is None or rig is not None, "detector requires a rig, such as laser")
