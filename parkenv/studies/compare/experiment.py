"""Run an experiment: make its cases from the specification, and its results from the finished cases."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv import __version__
from parkenv.errors import InputError
from parkenv.files.spec_file import Spec
from parkenv.perception.detector_registry import detector_version, make_detector
from parkenv.scenarios.blind import blind_scenario
from parkenv.scenarios.build import build
from parkenv.scenarios.spec import ScenarioSpec, SensorModelSpec
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.cases import (
    Case,
    at_occupancy,
    check_worlds,
    require_distinct,
    run_cases,
    settings_of,
    table,
)
from parkenv.studies.results import ResultFolder, Row
from parkenv.studies.spec import SPEC_FILE, CommuteSpec, ExperimentSpec
from parkenv.studies.trips.calibration import Calibration
from parkenv.studies.workers import HERE, Workers
from parkenv.world.occupancy.constant_map import FlatMap
from parkenv.world.occupancy.process import OccupancyProcess
from parkenv.world.scenario import Scenario
from parkenv.world.sensor_model import SensorModel
from planners.agent import agent_file, make_agent

if TYPE_CHECKING:
    from parkenv.studies.compare.figures import ComparisonResults

NEEDS_OBSERVATIONS = ("belief", "belief-rivals", "mdp-tuned", "exact", "network")
"""Agents that require observations of slots before an attempt."""
MAP_SAYS = "-map-says-"  # separator between the name of a scenario and the constant probability of its map


@dataclass(frozen=True, eq=False)
class Experiment:
    """An experiment with its scenarios made and its agents checked.

    Raises:
        InputError: a scenario or an agent cannot be made, or parts of the specification do not fit together.
    """

    spec: ExperimentSpec  # specification of the experiment

    def __post_init__(self) -> None:
        for scenario in self._base_scenarios:
            for agent in self.spec.agents:
                make_agent(agent.name, scenario, **agent.options)
        if self.spec.rig is not None:
            for name in {self.spec.detector or scenario.detector for scenario in self._base_scenarios}:
                make_detector(name)
        if self.spec.grid.blind and not any(_works_blind(agent) for agent in self.spec.agents):
            raise InputError(
                "blind searches have no observations, and all agents plan on observations: "
                f"{', '.join(agent.label for agent in self.spec.agents)}; add one that does not, such as mdp"
            )
        names = [scenario.name for scenario in self.scenarios]
        if repeated := [name for name in names if names.count(name) > 1]:
            raise InputError(
                f"two scenarios are called {repeated[0]!r}, want different names; rename one of them"
            )
        if (measured := self.calibration) is not None and names != [measured.scenario]:
            raise InputError(
                f"{self.spec.grid.calibrated} was measured on {measured.scenario!r}, here are {', '.join(names)}; "
                "compare that scenario alone, neither blind nor with wrong maps"
            )
        require_distinct(case for case, _ in self.cases)

    @cached_property
    def _base_scenarios(self) -> list[Scenario]:
        return [build(_seen_through(spec, self.spec.rig)) for spec in self.spec.scenarios]

    @cached_property
    def wrong_map_scenarios(self) -> dict[str, tuple[Scenario, float]]:
        """Scenarios with flat maps, and the constant probability of each map, by name."""
        made = {}
        for p_occupied in self.spec.grid.map_says:
            for scenario in self._base_scenarios:
                name = f"{scenario.name}{MAP_SAYS}{p_occupied:g}"
                wrong = FlatMap(p_occupied, scenario.prior or scenario.occupancy)
                made[name] = (scenario.replace(name=name, prior=wrong), p_occupied)
        return made

    @cached_property
    def scenarios(self) -> list[Scenario]:
        """All scenarios, with their own costs and speeds."""
        made = self._base_scenarios + [flat for flat, _ in self.wrong_map_scenarios.values()]
        return (
            [s for scenario in made for s in (scenario, blind_scenario(scenario))]
            if self.spec.grid.blind
            else made
        )

    @cached_property
    def calibration(self) -> Calibration | None:
        """The measured costs, if any."""
        path = self.spec.grid.calibrated
        return None if path is None else Calibration.from_file(path)

    @property
    def seeds(self) -> range:
        """Seeds of the episodes."""
        return range(self.spec.seed, self.spec.seed + self.spec.episodes)

    @cached_property
    def cases(self) -> list[tuple[Case, range]]:
        """Return every agent in every scenario and setting, with the seeds of its episodes."""
        return [
            (self._case(setting, agent), self.seeds)
            for scenario in self.scenarios
            for setting in self._settings(scenario)
            for agent in self.spec.agents
            if scenario.sensor_model != SensorModel.blind() or _works_blind(agent)
        ]

    @cached_property
    def occupancy_cases(self) -> list[tuple[Case, range]]:
        """Return the cases at the occupancy levels, with a third of the episodes, at the first speeds of the grid."""
        return [
            (self._case(setting, agent, level), self.seeds[: max(1, self.spec.episodes // 3)])
            for scenario in self.scenarios
            if isinstance(scenario.occupancy, OccupancyProcess)
            and scenario.name not in self.wrong_map_scenarios
            for level in self.spec.grid.occupancy_levels
            for setting in self._grid_settings(at_occupancy(scenario, level), first_speeds=True)
            for agent in self.spec.agents
            if scenario.sensor_model != SensorModel.blind() or _works_blind(agent)
        ]

    def _case(self, scenario: Scenario, agent: AgentSpec, level: float | None = None) -> Case:
        return Case(scenario, agent.name, level, self.spec.rig, agent.options, self.spec.detector)

    def _settings(self, scenario: Scenario) -> list[Scenario]:
        settings = self._grid_settings(scenario)
        if (measured := self.calibration) is not None:
            settings += settings_of(measured.applied(scenario), v_walk_kmh=self.spec.grid.v_walk_kmh)
        return settings

    def _grid_settings(self, scenario: Scenario, first_speeds: bool = False) -> list[Scenario]:
        grid = self.spec.grid
        walk, drive = grid.v_walk_kmh, grid.v_drive_kmh
        if first_speeds:
            walk, drive = walk and walk[:1], drive and drive[:1]
        return settings_of(scenario, grid.failure_s, walk, drive)

    def fingerprint(self) -> Row:
        """Return everything that affects the outcome of an episode; a resumed run must have the same settings."""
        spec = self.spec
        looks = {} if spec.detector is None else {"detector": detector_version(spec.detector)}
        return {**spec_fingerprint(spec), "rig": spec.rig, **looks}


def _works_blind(agent: AgentSpec) -> bool:
    return agent.name not in NEEDS_OBSERVATIONS


def _seen_through(spec: ScenarioSpec, rig: str | None) -> ScenarioSpec:
    """Return the scenario with the rig's fitted sensor model, unless the scenario names another."""
    if (
        rig is None
        or spec.sensor_model.name not in (None, "perfect")
        or spec.sensor_model.hit_rate is not None
    ):
        return spec
    if spec.sensor_model.file is not None:
        return spec
    measured = SensorModelSpec(
        name="stereo" if rig == "stereo" else "laser", view_range=spec.sensor_model.view_range
    )
    return spec.changed(sensor_model=measured)


def flat_tables(tables: Mapping[str, Any], before: str = "") -> Row:
    """Flatten nested tables into one with dotted keys.

    Examples:
        >>> flat_tables({"costs": {"failure_s": 10.0}, "goal": 0})
        {'costs.failure_s': 10.0, 'goal': 0}
    """
    flat: Row = {}
    for key, value in tables.items():
        flat |= (
            flat_tables(value, f"{before}{key}.") if isinstance(value, Mapping) else {f"{before}{key}": value}
        )
    return flat


def spec_fingerprint(spec: ExperimentSpec | CommuteSpec) -> Row:
    """Return the version, the scenarios, and hashes of the files of scenarios and agents."""
    return {
        "version": __version__,
        "scenarios": {s.title: flat_tables(s.model_dump(mode="json")) for s in spec.scenarios},
        "files": fingerprints(spec.files()),
        "agent files": agent_fingerprints(agent.name for agent in spec.agents),
    }


def fingerprints(files: Iterable[Path]) -> dict[str, str]:
    """Return a short hash of each file's content, by path, so that a resumed run detects changed files."""
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest()[:16] for path in files}


def agent_fingerprints(names: Iterable[str]) -> dict[str, str]:
    """Return the fingerprints of agents that come from files: trained models and user-defined agents."""
    files = {name: agent_file(name) for name in dict.fromkeys(names)}
    return {name: fingerprints([file])[str(file)] for name, file in files.items() if file is not None}


@dataclass(frozen=True, eq=False)
class ExperimentResult:
    """Result of an experiment."""

    experiment: Experiment
    folder: ResultFolder  # its result folder, with every finished episode
    rows: list[Row]  # one row per case with finished episodes, as in `summary.json`
    occupancy_rows: list[Row]  # the same at the occupancy levels
    complete: bool  # whether all episodes are finished

    def figure_data(self) -> ComparisonResults:
        """Return the data for the figures of a comparison."""
        from parkenv.studies.compare.figures import ComparisonResults  # loads Matplotlib

        flat = {
            name: (name.partition(MAP_SAYS)[0], p)
            for name, (_, p) in self.experiment.wrong_map_scenarios.items()
        }
        return ComparisonResults(
            self.experiment.cases,
            self.folder.episodes,
            self.rows,
            self.occupancy_rows,
            flat,
            self.experiment.spec.seed,
        )


def run_experiment(
    spec: ExperimentSpec,
    out: Path,
    *,
    command: Iterable[str] = (),
    resume: bool = False,
    overwrite: bool = False,
    workers: Workers = HERE,
    on_start: Callable[[int], None] = lambda _: None,
    on_progress: Callable[[int], None] = lambda _: None,
) -> ExperimentResult:
    """Run an experiment, and write its results; skip episodes that the folder already holds.

    The folder gets the specification (`experiment.json`), every episode (`episodes.csv`), and the table
    (`summary.json`). Ctrl-C stops the run; finished episodes stay in the folder.

    Args:
        spec: specification of the experiment.
        out: result folder.
        command: command line to record in the summary.
        resume: continue an earlier run.
        overwrite: replace the results of another run.
        workers: where episodes run; results do not depend on it.
        on_start: called with the number of episodes before the first one starts.
        on_progress: called with the number of episodes just finished.

    Raises:
        InputError: a scenario or an agent cannot be made, or the folder cannot be used.

    Examples:
        >>> from tempfile import mkdtemp
        >>> spec = ExperimentSpec.parse(
        ...     {"scenarios": ["mini"], "agents": ["first-free", "oracle"], "episodes": 3}, "example"
        ... )
        >>> result = run_experiment(spec, Path(mkdtemp()))
        >>> [row["agent"] for row in result.rows], result.rows[0]["episodes"]
        (['first-free', 'oracle'], 3)
    """
    from parkenv.studies.compare.figures import remove_figures  # loads Matplotlib

    experiment = Experiment(spec)
    for scenario in experiment.scenarios:
        check_worlds(scenario, experiment.seeds)
    cases = experiment.cases + experiment.occupancy_cases
    with workers:
        folder = ResultFolder(out, experiment.fingerprint(), resume=resume, overwrite=overwrite)
        remove_figures(out)
        spec.write(out / SPEC_FILE)
        on_start(sum(len(seeds) for _, seeds in cases))
        try:
            run_cases(cases, folder, workers=workers, on_progress=on_progress)
            complete = True
        except KeyboardInterrupt:
            complete = False
    measured = experiment.calibration
    result = ExperimentResult(
        experiment,
        folder,
        table(experiment.cases, folder),
        table(experiment.occupancy_cases, folder),
        complete,
    )
    summary = {
        "command": list(command),
        "version": __version__,
        "seed": spec.seed,
        "complete": complete,
        "rows": result.rows,
        "occupancy_rows": result.occupancy_rows,
        "calibrated": None if measured is None else dataclasses.asdict(measured),
    }
    folder.finish([case.key(s) for case, seeds in cases for s in seeds], summary, complete=complete)
    return result


def saved_spec(folder: Path) -> dict[str, Any] | None:
    """Read the tables of the specification in a run folder; return None if there is none.

    Raises:
        InputError: the file is damaged.
    """
    from parkenv.files.spec_file import read_tables

    file = folder / SPEC_FILE
    return read_tables(file) if file.exists() else None


def require_unchanged(spec: Spec, settings: Mapping[str, Any]) -> None:
    """Check that the files of a run have not changed since.

    Raises:
        InputError: a file has changed.
    """
    before = settings.get("files", {})
    for path, now in fingerprints(spec.files()).items():
        if before.get(path) not in (None, now):
            raise InputError(f"{path} has changed since the run")
