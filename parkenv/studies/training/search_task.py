"""Training of search agents by `parkenv train`."""

from __future__ import annotations

import itertools
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from parkenv.envs.sb3 import search_batch
from parkenv.errors import InputError
from parkenv.scenarios.build import build
from parkenv.scenarios.places import lot_share, place_of_episode, require_different_names, split_places
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.show.figures.learning_curves import save_learning_curves
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.benchmark.suite import suite_lots
from parkenv.studies.compare.cases import rows_of
from parkenv.studies.training.cloning import Demonstrations, require_cloneable
from parkenv.studies.training.curve_file import across_seeds
from parkenv.studies.training.rl_training import AnyTraining
from parkenv.studies.training.search_training import (
    SearchTraining,
    episode_times,
    search_config,
    times_row,
)
from parkenv.studies.training.spec import (
    NetworkTrainingSpec,
    PlacesTrainingSpec,
    ScanTrainingSpec,
    SearchTrainingSpec,
)
from parkenv.studies.training.training_task import (
    Row,
    Status,
    Table,
    Trained,
    TrainingTask,
    name_of,
    row_of,
    table_of_tests,
)
from parkenv.studies.workers import Workers
from parkenv.world.scenario import Scenario
from planners.agent import make_agent
from planners.learned import LearnedAgent

DEMONSTRATION_SEED = 5_000_000
"""First world seed of the demonstrations."""
PLANNERS = tuple(
    AgentSpec(name=name)
    for name in ("belief", "mdp-tuned", "mdp", "first-free", "greedy-drive", "greedy-goal")
)

PLANNERS_OF_PLACES = tuple(spec for spec in PLANNERS if spec.name not in ("mdp-tuned", "greedy-goal"))
"""Default planners beside trainings with held-out places: those that need no time on each lot."""


class SearchTask(TrainingTask):
    """Training of search agents in some scenarios."""

    def __init__(self, spec: SearchTrainingSpec | ScanTrainingSpec | NetworkTrainingSpec) -> None:
        super().__init__(spec)
        self.test_on, self.steps = spec.test_on, spec.steps
        self.evaluate_every, self.observation, self.k = 100_000, "local", 5
        if not isinstance(spec, NetworkTrainingSpec):
            self.evaluate_every, self.observation, self.k = spec.evaluate_every, spec.observation, spec.k
        self.clone, self.curriculum, self.demonstrations = None, None, 2000
        if isinstance(spec, SearchTrainingSpec):
            self.clone, self.curriculum = spec.clone, spec.curriculum
            self.demonstrations = spec.demonstrations or 2000
        self.held_out_share, self.evaluate_on = (
            (spec.held_out, spec.evaluate_on) if isinstance(spec, PlacesTrainingSpec) else (None, None)
        )
        self._holds_out = self.held_out_share is not None or self.evaluate_on is not None
        usual = PLANNERS_OF_PLACES if self._holds_out else PLANNERS
        self.compared = usual if spec.agents is None else spec.agents

    @property
    def given_scenarios(self) -> tuple[ScenarioSpec, ...]:
        """See `TrainingTask`."""
        return (*self.scenarios, *(self.evaluate_on or ()))

    @property
    def folder(self) -> str:
        """See `TrainingTask`."""
        return f"scan-{self.algorithm}" if self.observation == "scan" else super().folder

    @cached_property
    def _sides(self) -> tuple[list[Scenario], list[Scenario]]:
        """Scenarios to train in, and held-out ones."""
        given = [build(scenario) for scenario in self.scenarios]
        if self.held_out_share is not None:
            sides = split_places(given, self.held_out_share, suite_lots())
        else:
            sides = given, [build(scenario) for scenario in self.evaluate_on or ()]
        require_apart(*sides)
        require_trainable(sides[0])
        return sides

    @property
    def worlds(self) -> list[Scenario]:
        """Scenarios to train in."""
        return self._sides[0]

    @property
    def held_out(self) -> list[Scenario]:
        """Places to evaluate in and not to train in."""
        return self._sides[1]

    @cached_property
    def tests(self) -> dict[str, list[Scenario]]:
        """The tests in the end, by name: each in one scenario, or in many of which every search draws one."""
        if self.test_on is None and self._holds_out:
            return {
                f"{_places(self.worlds)} trained on": self.worlds,
                f"{_places(self.held_out)} held out": self.held_out,
            }
        tested = self.worlds if self.test_on is None else [build(one) for one in self.test_on]
        return {scenario.name: [scenario] for scenario in tested}

    @property
    def _evaluated(self) -> list[Scenario]:
        """Scenarios of the evaluations that decide which model is kept."""
        return self.worlds

    @property
    def measures(self) -> tuple[str, ...]:
        """See `TrainingTask`."""
        return ("total_s", "held_out_s") if self._holds_out else ("total_s",)

    @property
    def announcement(self) -> str | None:
        """See `TrainingTask`."""
        if not self._holds_out:
            return None
        names = ", ".join(scenario.name for scenario in self.held_out)
        return (
            f"Trained on {_places(self.worlds)}, and evaluated on {_places(self.held_out)} held out: {names}"
        )

    def check(self) -> None:
        """See `TrainingTask`."""
        search_config(self.algorithm, self.observation)
        super().check()
        if self.observation == "scan":
            # What gives no scans in a batch is refused before training, not at the tests in the end.
            for place in (*self.worlds, *itertools.chain(*self.tests.values())):
                search_batch(1, self.worlds if place in self.worlds else place, "scan", self.k)
        if self.clone is not None:
            require_cloneable(self.algorithm, self.clone, self.worlds[0])
        for world in (self.worlds[0], *(places[0] for places in self.tests.values())):
            for agent in self.compared:
                make_agent(agent.name, world, **agent.options)

    def settings(self) -> Row:
        """See `TrainingTask`."""
        return {
            **super().settings(), "scenario": [w.name for w in self.worlds], "steps": self.steps, "k": self.k,
            "clone": self.clone, "demonstrations": self.demonstrations if self.clone else None,
            "evaluate_every": self.evaluate_every, "held_out": [w.name for w in self.held_out],
            "curriculum": self.curriculum, "observation": self.observation,
        }  # fmt: skip

    def evaluation_settings(self, settings: Row) -> Row:
        """See `TrainingTask`."""
        first, *others = settings.get("scenario") or [None]
        return {
            "scenario": [first, *others] if others else first,
            "held_out": settings.get("held_out") or [],
            "evaluation_episodes": settings.get("evaluation_episodes"),
        }

    def training(self, status: Status) -> AnyTraining:
        """See `TrainingTask`."""
        demonstrations = None
        if self.clone is not None:
            seeds = range(DEMONSTRATION_SEED, DEMONSTRATION_SEED + self.demonstrations)
            with status(f"Recording {self.demonstrations} searches of {self.clone}"):
                demonstrations = Demonstrations.collect(self.clone, self._evaluated, seeds, self.k)
        return SearchTraining(
            self.algorithm,
            self.steps,
            self.evaluate_every,
            tuple(self.worlds),
            self.evaluation_seeds,
            self.k,
            demonstrations,
            tuple(self.held_out),
            self.curriculum,
            self.observation,
        )

    def score_text(self, row: Row) -> str:
        """See `TrainingTask`."""
        held_out = f", held out {row['held_out_s']:.1f} s" if self._holds_out else ""
        return f"{row['total_s']:.1f} s{held_out}"

    def report(self, status: Status, workers: Workers, trained: Trained, figure: Path) -> tuple[Row, Table]:
        """See `TrainingTask`."""
        lines: dict[str, float] = {}
        planners: list[Row] = []
        drawn = self.held_out or self._evaluated
        if self.compared:
            with status("Planners search in the same worlds"):
                evaluated = rows_of(self.compared, drawn, self.evaluation_seeds, workers)
                for name, places in self.tests.items():
                    planners += rows_of(self.compared, places, self.test_seeds, workers, name)
            lines = {row["agent"]: row["total_s"] for row in evaluated}
            lines["clairvoyant bound"] = evaluated[0]["bound_s"]
        rows, transfer, by_place = [], [], []
        with status("Testing"):
            for (number, model), curve in zip(trained.models.items(), trained.curves, strict=True):
                for name, places in self.tests.items():
                    times, parked = self.times_of(model, places)
                    test = {"agent": self.algorithm, "seed": number, "test_scenario": name}
                    transfer.append({**test, **times_row(times, parked)})
                    if len(places) > 1:
                        by_place += [test | row for row in self._rows_by_place(places, times, parked)]
                # The first test; of those on either side of a split, the one on held-out places.
                split = self._holds_out and self.test_on is None
                main = transfer[-1 if split else -len(self.tests)]
                own = {c: main[c] for c in ("total_s", "total_s_ci95")}
                rows.append(row_of(self.algorithm, main["test_scenario"], number, curve, own, model))
        name = name_of(self.settings())
        where = self.worlds[0].name if len(self.worlds) == 1 else _places(self.worlds)
        if self._holds_out:
            where = f"{_places(self.held_out)} held out"
        title = f"{where}: {self.evaluation_episodes} searches in held-out worlds"
        curves = self._curves(name, trained.curves) | trained.beside
        means = {name: across_seeds(its) for name, its in curves.items()}
        save_learning_curves(curves, means, lines, title, figure)
        heading = "Mean total time, s, in held-out worlds"
        return {
            "rows": rows, "transfer": transfer, "planners": planners, "evaluated": lines,
            **({"places": by_place} if by_place else {}),
            "curve": across_seeds(trained.curves),
            "beside": {name: means[name] for name in trained.beside},
        }, table_of_tests(heading, self.algorithm, transfer, planners, _interval)  # fmt: skip

    def times_of(self, model: Path, places: list[Scenario]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Test a model: return the times of the test's episodes, s, and whether the car parked."""
        agent = LearnedAgent(self.worlds[0], self.algorithm, model)
        return episode_times(agent.model, places, self.test_seeds)

    def _curves(self, name: str, curves: list[list[Row]]) -> dict[str, list[list[Row]]]:
        """Return the curves to draw: in places trained on, and in those held out."""
        if not self._holds_out:
            return {name: curves}
        held_out = [[row | {"total_s": row["held_out_s"]} for row in curve] for curve in curves]
        return {f"{name}, {_places(self.worlds)} trained on": curves, f"{name}, held out": held_out}

    def _rows_by_place(
        self, places: list[Scenario], times: NDArray[np.float64], parked: NDArray[np.bool_]
    ) -> list[Row]:
        """Return a row of the test for each place that a search was in."""
        place_of = np.array([place_of_episode(seed, 0, len(places)) for seed in self.test_seeds])
        return [
            {"place": place.name, "slots": place.lot.n_slots, **times_row(times[its], parked[its])}
            for i, place in enumerate(places)
            if (its := place_of == i).any()
        ]


def require_apart(learned: list[Scenario], held_out: list[Scenario]) -> None:
    """Check that no place is on both sides.

    Raises:
        InputError: two places have one name, or a held-out lot is also one to train on.
    """
    if not held_out:
        return
    require_different_names([*learned, *held_out])
    shares = {lot_share(scenario.lot): scenario.name for scenario in learned}
    for scenario in held_out:
        if (same := shares.get(lot_share(scenario.lot))) is not None:
            raise InputError(
                f"evaluate_on has {scenario.name!r}, whose lot is that of {same!r}, which is trained on"
            )


def require_trainable(learned: list[Scenario]) -> None:
    """Check that none of the places to train on is one of a benchmark suite.

    Raises:
        InputError: one is.
    """
    kept = suite_lots()
    for scenario in learned:
        if (name := kept.get(lot_share(scenario.lot))) is not None:
            raise InputError(
                f"scenario {scenario.name!r} is {name} of benchmark suite v2, which no agent is trained on: leave it "
                "out, or add --held-out"
            )


def _places(scenarios: list[Scenario]) -> str:
    return f"{len(scenarios)} place{'s' * (len(scenarios) != 1)}"


def _interval(row: Row) -> str:
    low, high = row["total_s_ci95"]
    return f"{row['total_s']:.1f} [{low:.1f}, {high:.1f}]"
