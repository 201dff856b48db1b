"""Specifications of trainings, one for each kind: of search agents, of `network`, in fleets, and to drive."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple, Self, get_args

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticCustomError

from parkenv.files.atomic_write import atomic_write
from parkenv.files.csv_tables import WHOLE
from parkenv.files.known_names import SCENE_LEVELS, KnowledgeName
from parkenv.files.limited_reading import read_json
from parkenv.files.option import Inside, Option, option, words_in
from parkenv.files.spec_file import Several, Spec
from parkenv.scenarios.spec import scenario_spec
from parkenv.studies.agent_spec import AgentItem, AgentSpec, split_agents
from parkenv.studies.fields import (
    MAX_EPISODES,
    SCENARIOS_TAKE,
    ArrivalRate,
    Level,
    MeanStay,
    Patience,
    ScenarioList,
    Scenarios,
    SceneLevels,
    Seed,
    levels_in,
)
from parkenv.studies.results import PAGE, SUMMARY, CsvTable, Row, without_nan
from parkenv.studies.study import Cell, Stage, Study
from parkenv.studies.training.curve_file import CURVE, read_curve
from parkenv.version import __version__
from planners.names import PARKING_PLANNER

if TYPE_CHECKING:
    from parkenv.show.report.page import Page
    from parkenv.studies.report import Replay
    from parkenv.studies.results import Results
    from parkenv.studies.training.training import Training

Steps = Annotated[int, Field(ge=1, le=10**12, description="Decisions of a training.")]
EvaluateEvery = Annotated[int, Field(ge=1, le=10**12)]
Episodes = Annotated[
    int,
    Field(ge=2, le=1_000_000),
    Option(
        panel="Evaluation",
        default="256; to drive, 64; in a fleet, 8",
        description="Episodes of an evaluation, in held-out worlds; to drive, on each lot for each kind of slot; in a "
        "fleet, days.",
    ),
]
ObservedSlots = Annotated[
    int,
    Field(ge=1, le=1_000, description="Slots in an observation (search, fleet)."),
    Option(panel="Learning"),
]
TensorBoard = Annotated[
    bool, Field(description="Write logs for TensorBoard to the folder."), Option(panel="Results")
]
_DAYS = Inside(only=("--day-error",))
TrainedOn = Annotated[
    Scenarios,
    Option(
        "--scenario",
        takes=SCENARIOS_TAKE,
        parse=words_in,
        default="campus; to drive, campus,street; for network, synthetic lots only",
    ),
    _DAYS,
]


def agents_or_none(text: str) -> list[str]:
    """Split agents at commas; none for `none`."""
    return [] if text == "none" else split_agents(text)


_COMPARED = Option(
    takes="NAME[,...]|none",
    panel="Evaluation",
    parse=agents_or_none,
    default="belief, mdp-tuned, mdp, first-free, greedy-drive, greedy-goal; with held-out places, belief, mdp, "
    "first-free, greedy-drive; in a fleet, greedy-drive, first-free; to drive, planner",
)


FILES = "files"
"""Key of the files of a training in its row."""


class _Seeds(NamedTuple):
    """The trainings of a study, by seed.

    Attributes:
        folder: that of the run; a training keeps its checkpoint there.
        shared: see `Training`.
        command: command line of the run.
    """

    folder: Path = Path()
    shared: Any = None
    command: tuple[str, ...] = ()
    columns: Row = {}  # noqa: RUF012 - never changed


class TrainingSpec(Study):
    """Training by reinforcement learning, one model per seed: what all kinds of training have.

    `TrainingSpec.parse` and `read` return the specification of the kind that `env` and `algorithm`
    choose.
    """

    chosen_by: ClassVar[str] = ""
    """What chooses this kind of training, for messages."""
    trained_by: ClassVar[str] = ""
    """`MODULE:CLASS` of the training, in this package; importing it loads torch."""
    table: ClassVar = CsvTable(
        "trainings.csv", ("seed",), ("steps", "wall_s"), {"seed": WHOLE, "steps": WHOLE}, lists=None
    )
    block: ClassVar = 1
    doing: ClassVar = "Training"
    table_titles: ClassVar = {
        "rows": "Trained models",
        "transfer": "Test in held-out worlds",
        "planners": "Planners in the same worlds",
    }
    unit: ClassVar = ""

    kind: Literal["train"] = "train"
    env: Literal["search", "fleet", "drive", "scenes"] = "search"
    algorithm: str
    scenarios: TrainedOn | None = None
    trainings: int = option(5, "Number of trainings, one for each seed.", ge=1, le=10_000)
    seed: Seed = Field(0, description="First seed of the trainings.")
    evaluation_episodes: Episodes
    agents: Annotated[Several[AgentItem] | None, _COMPARED] = Field(
        None, max_length=1_000, description="Agents to draw for comparison."
    )
    beside: Several[str] = option(
        (),
        "Folders of other trainings with the same evaluations, drawn in the same figure.",
        takes="DIR[,...]",
        panel="Evaluation",
        max_length=100,
    )

    @classmethod
    def variants(cls) -> tuple[type[Spec], ...]:
        """See `Spec`."""
        return KINDS if cls is TrainingSpec else ()

    @classmethod
    def parse(
        cls, tables: Mapping[str, Any], source: str | Mapping[str, str], folder: str | Path = "."
    ) -> Self:
        """See `Spec.parse`."""
        if cls is not TrainingSpec:
            return super().parse(tables, source, folder)
        chosen: Any = kind_of(tables)
        made: Self = chosen.parse(tables, source, folder)
        return made

    @model_validator(mode="before")
    @classmethod
    def _of_this_kind(cls, tables: Any) -> Any:
        """Refuse a field of another kind of training by naming the kinds that have it."""
        for name in tables if isinstance(tables, Mapping) else ():
            kinds = [kind.chosen_by for kind in KINDS if name in kind.model_fields]
            if kinds and name not in cls.model_fields:
                raise PydanticCustomError(
                    "whole",
                    "{name} requires {kinds}, not {own}",
                    {"name": str(name), "kinds": " or ".join(kinds), "own": cls.chosen_by},
                )
        return tables

    @field_validator("env", "algorithm", mode="before", check_fields=False)
    @classmethod
    def _known_choice(cls, value: object, info: ValidationInfo) -> object:
        name = str(info.field_name)
        if value in _choices(cls, name):
            return value
        kinds = (cls,) if name == "algorithm" else KINDS
        known = dict.fromkeys(choice for kind in kinds for choice in _choices(kind, name))
        raise PydanticCustomError(
            "whole",
            "{name} is {value}, want one of {known}{own}",
            {
                "name": name,
                "value": repr(value),
                "known": ", ".join(known),
                "own": f" with {cls.chosen_by}" if name == "algorithm" else "",
            },
        )

    @cached_property
    def training(self) -> Training:
        """What trains, evaluates and tests; it loads torch."""
        from parkenv.studies.training.training import training_of

        return training_of(self)

    def check(self) -> None:
        """See `Study`."""
        self.training.check()

    def settings(self) -> Row:
        """See `Study`."""
        return {"version": __version__, **self.training.settings()}

    def prepare(self, results: Results, *, continues: bool) -> None:
        """See `Study`."""
        from parkenv.studies.training.training import FIGURE, curves_beside

        results.kept["beside"] = curves_beside(self.beside, results.path, self.training)
        for outcome in (PAGE, FIGURE):
            (results.path / outcome).unlink(missing_ok=True)
        if not continues:
            for folder in results.path.glob("seed_*"):
                shutil.rmtree(folder)
        short = [key for key, row in results.rows(self.table).items() if row["steps"] < self.training.steps]
        results.drop(short, self.table)

    def cells(self) -> list[Cell]:
        """See `Study`."""
        return [Cell(_Seeds(), range(self.seed, self.seed + self.trainings))]

    def stages(self, results: Results) -> Iterator[Stage]:
        """See `Study`; the bars of the trainings follow the curves that they write."""
        self.training.begin(results.progress)
        with self.training.watched(results.path, self.cells()[0].items, results.progress):
            yield Stage(self.doing, self, self.cells())

    def input_of(self, work: _Seeds, items: Sequence[int], results: Results) -> _Seeds:
        """See `Study`."""
        del items
        return work._replace(folder=results.path, shared=self.training.shared, command=tuple(results.command))

    def run(self, work: _Seeds, items: Sequence[int]) -> list[Row]:
        """See `Study`; a training goes on from its checkpoint."""
        from parkenv.studies.training.training import MODEL, use_one_thread

        use_one_thread()
        self.training.command, self.training.shared = work.command, work.shared
        rows: list[Row] = []
        for seed in items:
            folder = work.folder / f"seed_{seed}"
            last = self.training.train(seed, folder)[-1]
            # As bytes, so that a worker on another machine can return them.
            files = {name: (folder / name).read_bytes() for name in (CURVE, MODEL)}
            rows.append({"seed": seed, "steps": int(last["steps"]), "wall_s": last["wall_s"], FILES: files})
        return rows

    def keep(self, work: _Seeds, rows: Sequence[Row], results: Results) -> None:
        """See `Study`: the model and the curve."""
        del work
        for row in rows:
            folder = results.path / f"seed_{row['seed']}"
            folder.mkdir(exist_ok=True)
            for name, content in row.pop(FILES).items():
                with atomic_write(folder / name) as beside:
                    beside.write_bytes(content)

    def summarise(self, results: Results) -> Row:
        """See `Study`; the models are tested once all are trained."""
        from parkenv.studies.training.training import FIGURE, MODEL, Trained

        (seeds,) = self.cells()
        if len(results.of(self, seeds)) < self.trainings:
            return {"rows": []}
        folders = {seed: results.path / f"seed_{seed}" for seed in seeds.items}
        curves = [read_curve(folder / CURVE, self.training.columns) for folder in folders.values()]
        models = {seed: folder / MODEL for seed, folder in folders.items()}
        trained = Trained(curves, models, results.kept["beside"])
        summary = self.training.report(results.progress, results.workers, trained, results.path / FIGURE)
        return {"settings": self.settings(), **summary}

    @classmethod
    def findings(cls, summary: Row) -> list[str]:
        """See `Study`: the test, if the models search."""
        rows = [row for row in summary["rows"] if isinstance(row.get("total_s"), float)]
        if not rows:
            return []
        best, worst = min(row["total_s"] for row in rows), max(row["total_s"] for row in rows)
        return [f"Models tested on {rows[0]['scenario']} in held-out worlds: {best:.1f} to {worst:.1f} s."]

    @classmethod
    def page(cls, summary: Row, folder: Path) -> Page:
        """See `Study`."""
        from parkenv.show.report.learning import learning_panels
        from parkenv.show.report.page import listed, on_scenarios

        rows = summary["rows"]
        agents = list(dict.fromkeys(str(row.get("agent", "agent")) for row in rows))
        curves = [without_nan(read_curve(folder / f"seed_{row['seed']}" / CURVE)) for row in rows]
        title, panels = f"{listed(agents)} trained{on_scenarios(rows)}", learning_panels(summary, curves)
        return super().page(summary, folder)._replace(title=title, learning=panels)

    def replays(self, folder: Path) -> Sequence[Replay]:
        """See `Study`."""
        return self.training.replays(read_json(folder / SUMMARY), folder)

    @property
    def tested(self) -> Scenarios | None:
        """Scenarios of the tests in the end; None for made ones."""
        return self.scenarios


class TestedTrainingSpec(TrainingSpec):
    """A training whose models may be tested in other scenarios."""

    test_on: Annotated[ScenarioList | None, _DAYS] = option(
        None,
        "Scenarios to test in at the end.",
        takes=SCENARIOS_TAKE,
        panel="Evaluation",
        parse=words_in,
        default="those of the training; with held-out places, all of either side together",
    )

    @property
    def tested(self) -> Scenarios | None:
        """See `TrainingSpec`."""
        return self.test_on or super().tested


class PlacesTrainingSpec(TestedTrainingSpec):
    """A training that can hold out places."""

    held_out: Level | None = option(
        None,
        "Hold out this share of the scenarios for evaluation, by a hash of each lot, independent "
        "of the other lots (search).",
        takes="0 < X < 1",
        panel="Evaluation",
        default="none",
    )
    evaluate_on: Annotated[ScenarioList | None, _DAYS] = option(
        None,
        "Hold out these places instead: evaluate on them during and after training (search).",
        takes=SCENARIOS_TAKE,
        panel="Evaluation",
        parse=words_in,
        default="none",
    )
    evaluation_episodes: Episodes = Field(
        256, description="Episodes of an evaluation; the test in the end has twice as many."
    )

    @model_validator(mode="after")
    def _held_out_once(self) -> Self:
        if self.held_out is not None and self.evaluate_on is not None:
            raise PydanticCustomError("whole", "at most one of held_out, evaluate_on")
        return self

    @property
    def tested(self) -> Scenarios | None:
        """See `TrainingSpec`."""
        return self.test_on or self.evaluate_on or self.scenarios


class SearchTrainingSpec(PlacesTrainingSpec):
    """Training to search, from what is near the car, of belief and forecast."""

    chosen_by: ClassVar[str] = "env search"
    trained_by: ClassVar[str] = "search:SearchTraining"

    env: Literal["search"] = option(
        "search",
        "Learn to search (parkenv/Search-v2), to search as all cars of a fleet, to drive into slots "
        "(parkenv/Drive-v1), or to plan manoeuvres in drawn scenes.",
        takes="search|fleet|drive|scenes",
        default="search",
    )
    algorithm: Literal["ppo", "maskable-ppo", "recurrent-ppo", "dqn"] = option(
        "maskable-ppo",
        "To search: dqn, ppo, maskable-ppo, recurrent-ppo, network. In a fleet: ppo, maskable-ppo. To "
        "drive: sac, tqc, ppo. In scenes: maskable-ppo.",
        argument=True,
        default="maskable-ppo; to drive, ppo",
    )
    scenarios: TrainedOn = (scenario_spec("campus"),)
    k: ObservedSlots = 5
    curriculum: Literal["size"] | None = option(
        None,
        "size: start with the smallest tenth of the places, and add larger ones evenly until half "
        "of the steps (search).",
        panel="Learning",
        default="all places from the start",
    )
    clone: str | None = option(
        None,
        "Start with behaviour cloning of this planner (search; ppo, maskable-ppo).",
        takes="AGENT",
        panel="Learning",
    )
    demonstrations: int | None = option(
        None, "Episodes of the planner to clone.", panel="Learning", default="2000", ge=1, le=MAX_EPISODES
    )
    steps: Annotated[
        Steps,
        Option(
            default="2000000; in a fleet, 500000; for network, 10000; to drive, the training config's",
            description="Decisions of a training; for network, decisions labelled by belief.",
        ),
    ] = 2_000_000
    evaluate_every: EvaluateEvery | None = option(
        None,
        "Decisions between evaluations.",
        panel="Evaluation",
        default="a tenth of --steps, to search at most 100000; to drive, a twentieth",
    )
    tensorboard: TensorBoard = False

    @model_validator(mode="after")
    def _cloned(self) -> Self:
        if self.demonstrations is not None and self.clone is None:
            raise PydanticCustomError("whole", "demonstrations requires clone")
        return self


class NetworkTrainingSpec(PlacesTrainingSpec):
    """Training of `network`, which clones `belief`, observes its own features and is evaluated after each stage."""

    chosen_by: ClassVar[str] = "algorithm network"
    trained_by: ClassVar[str] = "network.training:NetworkTraining"
    # What other trainings to search may choose.
    clone: ClassVar[None] = None

    env: Literal["search"] = "search"
    algorithm: Literal["network"] = "network"
    scenarios: Annotated[TrainedOn | None, _DAYS] = Field(
        None,
        description="Scenarios to train on in addition to synthetic lots; synthetic lots only if absent.",
    )
    steps: Annotated[int, Field(ge=1, le=10**12, description="Decisions labelled by belief.")] = 10_000
    without: Several[Literal["lookahead", "tokens", "day", "memory"]] = option(
        (),
        "Parts of network to leave out: lookahead, tokens, day, memory.",
        takes="PART[,...]",
        panel="Learning",
        default="none",
    )


class FleetTrainingSpec(TrainingSpec):
    """Training of one network for all cars of a fleet, or a share of them."""

    chosen_by: ClassVar[str] = "env fleet"
    trained_by: ClassVar[str] = "fleet:FleetTraining"

    env: Literal["fleet"] = "fleet"
    algorithm: Literal["ppo", "maskable-ppo"] = "maskable-ppo"
    scenarios: TrainedOn = (scenario_spec("campus"),)
    arrivals_per_hour: ArrivalRate = option(
        120.0, "Cars that arrive in the hours of the scenario (fleet).", panel="Demand"
    )
    stay_s: MeanStay = 3600.0
    patience_s: Patience = 600.0
    knows: KnowledgeName = option(
        "own", "Information of the learning cars, as in parkenv fleet.", panel="Knowledge"
    )
    among: AgentItem | None = option(
        None,
        "Driver of the other cars: greedy-drive, first-free, random or a model.",
        takes="AGENT",
        panel="Knowledge",
        default="none, every car learns",
    )
    learners: Level | None = option(
        None,
        "Share of the cars that learn, with --among.",
        takes="0 < X < 1",
        panel="Knowledge",
        default="0.1",
    )
    k: ObservedSlots = 5
    steps: Steps = 600_000
    evaluate_every: EvaluateEvery | None = Field(None, description="A tenth of the steps if absent.")
    evaluation_episodes: Episodes = Field(
        8, description="Days of an evaluation; the test in the end has twice as many."
    )
    agents: Several[AgentItem] = Field(
        (AgentSpec(name="greedy-drive"), AgentSpec(name="first-free")),
        max_length=1_000,
        description="Agents to draw for comparison.",
    )
    test_among: Several[AgentItem] = option(
        (AgentSpec(name="greedy-drive"),),
        "Also test the model as each tenth car among these (fleet).",
        takes="NAME[,...]|none",
        panel="Evaluation",
        parse=agents_or_none,
        max_length=100,
    )
    tensorboard: TensorBoard = False

    @model_validator(mode="after")
    def _among_others(self) -> Self:
        if self.learners is not None and self.among is None:
            raise PydanticCustomError("whole", "learners requires among")
        return self


def _planner(value: AgentSpec) -> AgentSpec:
    if value.label != PARKING_PLANNER:
        raise PydanticCustomError(
            "whole",
            "agents has {name}, want planner or none with env drive or scenes",
            {"name": repr(value.label)},
        )
    return value


class DriveTrainingSpec(TestedTrainingSpec):
    """Training to drive into slots."""

    chosen_by: ClassVar[str] = "env drive"
    trained_by: ClassVar[str] = "drive.training:DriveTraining"

    env: Literal["drive"] = "drive"
    algorithm: Literal["ppo", "sac", "tqc"] = "ppo"
    scenarios: TrainedOn = Field(
        (scenario_spec("campus"), scenario_spec("street")),
        description="Scenarios whose lots are used for training.",
    )
    steps: Steps | None = Field(None, description="The algorithm's own number if absent.")
    evaluate_every: EvaluateEvery | None = Field(None, description="A twentieth of the steps if absent.")
    evaluation_episodes: Episodes = Field(
        64,
        description="Parkings of an evaluation, on each lot for each kind of slot; the test in the end has twice as "
        "many.",
    )
    agents: Several[Annotated[AgentItem, AfterValidator(_planner)]] = Field(
        (AgentSpec(name=PARKING_PLANNER),),
        max_length=1,
        description="Agents to draw for comparison: planner, or none.",
    )
    tensorboard: TensorBoard = False


class ScenesTrainingSpec(TrainingSpec):
    """Training to plan manoeuvres in drawn scenes."""

    chosen_by: ClassVar[str] = "env scenes"
    trained_by: ClassVar[str] = "scenes:ScenesTraining"

    env: Literal["scenes"] = "scenes"
    algorithm: Literal["maskable-ppo"] = "maskable-ppo"
    levels: SceneLevels = option(
        tuple(level for level in SCENE_LEVELS if not level.endswith("moving")),
        "Levels of the drawn scenes, as in parkenv park (scenes).",
        takes="NAME[,...]|all",
        panel="Learning",
        default="all but moving",
        parse=levels_in,
    )
    steps: Steps = 600_000
    evaluate_every: EvaluateEvery | None = Field(None, description="A tenth of the steps if absent.")
    evaluation_episodes: Episodes = Field(
        16, description="Scenes of an evaluation, of each level; the test in the end has twice as many."
    )
    agents: Several[Annotated[AgentItem, AfterValidator(_planner)]] = Field(
        (AgentSpec(name=PARKING_PLANNER),),
        max_length=1,
        description="Agents to draw for comparison: planner, or none.",
    )
    tensorboard: TensorBoard = False


RLTrainingSpec = SearchTrainingSpec | FleetTrainingSpec | DriveTrainingSpec | ScenesTrainingSpec
"""The kinds of training with stable-baselines3."""
AnyTrainingSpec = RLTrainingSpec | NetworkTrainingSpec
"""The kinds of training."""
KINDS: tuple[type[AnyTrainingSpec], ...] = get_args(AnyTrainingSpec)


def _choices(kind: type[TrainingSpec], name: str) -> tuple[str, ...]:
    """Return the values of a field that are text, none for a kind without the field."""
    return get_args(kind.model_fields[name].annotation) if name in kind.model_fields else ()


def kind_of(tables: Mapping[str, Any]) -> type[AnyTrainingSpec]:
    """Return the kind of training that the content of a file chooses.

    Examples:
        >>> kind_of({"env": "fleet"}).__name__
        'FleetTrainingSpec'
    """
    env = tables.get("env", "search")
    if env == "fleet":
        return FleetTrainingSpec
    if env == "drive":
        return DriveTrainingSpec
    if env == "scenes":
        return ScenesTrainingSpec
    if tables.get("algorithm") == "network":
        return NetworkTrainingSpec
    return SearchTrainingSpec
