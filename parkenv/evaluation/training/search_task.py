"""Training of search agents by `parkenv train`."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from parkenv.evaluation.experiments.agent_spec import AgentSpec
from parkenv.evaluation.experiments.compare import rows_of
from parkenv.evaluation.experiments.spec import TrainingSpec
from parkenv.evaluation.experiments.workers import Workers
from parkenv.evaluation.figures.learning_curves import across_seeds, save_learning_curves
from parkenv.evaluation.training.cloning import Demonstrations, require_cloneable
from parkenv.evaluation.training.configs import SEARCH_CONFIGS, config_of
from parkenv.evaluation.training.search_training import SearchTraining, search_times
from parkenv.evaluation.training.training_task import (
    Row,
    Status,
    Table,
    Trained,
    TrainingTask,
    name_of,
    row_of,
    table_of_tests,
)
from parkenv.scenarios.build import build
from parkenv.world.scenario import Scenario
from planners.agent import make_agent
from planners.learned import LearnedAgent

DEMONSTRATION_SEED = 5_000_000
"""First world seed of the demonstrations."""
PLANNERS = tuple(
    AgentSpec(name=name)
    for name in ("belief", "mdp-tuned", "mdp", "first-free", "greedy-drive", "greedy-goal")
)


class SearchTask(TrainingTask):
    """Training of search agents in some scenarios."""

    default_algorithm = "maskable-ppo"
    default_scenarios = ("campus",)
    default_episodes = 256

    def __init__(self, spec: TrainingSpec) -> None:
        super().__init__(spec)
        self.steps = spec.steps or 2_000_000
        self.evaluate_every = spec.evaluate_every or 100_000
        self.k = spec.k or 5
        self.demonstrations = spec.demonstrations or 2000
        self.compared = PLANNERS if spec.agents is None else spec.agents

    @cached_property
    def worlds(self) -> list[Scenario]:
        """Scenarios to train in."""
        return [build(scenario) for scenario in self.scenarios]

    @cached_property
    def tested(self) -> list[Scenario]:
        """Scenarios to test in."""
        return [build(scenario) for scenario in self.spec.test_on or self.scenarios]

    @property
    def measures(self) -> tuple[str, ...]:
        """See `TrainingTask`."""
        return ("total_s",)

    def check(self) -> None:
        """See `TrainingTask`."""
        config_of(self.algorithm, SEARCH_CONFIGS, "search")
        super().check()
        if self.spec.clone is not None:
            require_cloneable(self.algorithm, self.spec.clone, self.worlds[0])
        for world in (self.worlds[0], *self.tested):
            for agent in self.compared:
                make_agent(agent.name, world, **agent.options)

    def settings(self) -> Row:
        """See `TrainingTask`."""
        return {
            **super().settings(), "scenario": [w.name for w in self.worlds], "steps": self.steps, "k": self.k,
            "clone": self.spec.clone, "demonstrations": self.demonstrations if self.spec.clone else None,
            "evaluate_every": self.evaluate_every,
        }  # fmt: skip

    def evaluation_settings(self, settings: Row) -> Row:
        """See `TrainingTask`."""
        first, *_ = settings.get("scenario") or [None]
        return {"scenario": first, "evaluation_episodes": settings.get("evaluation_episodes")}

    def training(self, status: Status) -> SearchTraining:
        """See `TrainingTask`."""
        demonstrations = None
        if self.spec.clone is not None:
            seeds = range(DEMONSTRATION_SEED, DEMONSTRATION_SEED + self.demonstrations)
            with status(f"Recording {self.demonstrations} searches of {self.spec.clone}"):
                demonstrations = Demonstrations.collect(self.spec.clone, self.worlds[0], seeds, self.k)
        return SearchTraining(
            self.algorithm,
            self.steps,
            self.evaluate_every,
            tuple(self.worlds),
            self.evaluation_seeds,
            self.k,
            demonstrations,
        )

    def score_text(self, row: Row) -> str:
        """See `TrainingTask`."""
        return f"{row['total_s']:.1f} s"

    def report(self, status: Status, workers: Workers, trained: Trained, figure: Path) -> tuple[Row, Table]:
        """See `TrainingTask`."""
        lines: dict[str, float] = {}
        planners: list[Row] = []
        if self.compared:
            with status("Planners search in the same worlds"):
                evaluated = rows_of(self.compared, self.worlds[0], self.evaluation_seeds, workers)
                for world in self.tested:
                    planners += rows_of(self.compared, world, self.test_seeds, workers)
            lines = {row["agent"]: row["total_s"] for row in evaluated}
            lines["clairvoyant bound"] = evaluated[0]["bound_s"]
        rows, transfer = [], []
        with status("Testing"):
            for (number, model), curve in zip(trained.models.items(), trained.curves, strict=True):
                for world in self.tested:
                    row = search_times(LearnedAgent(world, self.algorithm, model), world, self.test_seeds)
                    transfer.append(
                        {"agent": self.algorithm, "seed": number, "test_scenario": world.name, **row}
                    )
                first = transfer[-len(self.tested)]
                own = {c: first[c] for c in ("total_s", "total_s_ci95")}
                rows.append(row_of(self.algorithm, first["test_scenario"], number, curve, own, model))
        title = f"{self.worlds[0].name}: {self.evaluation_episodes} searches in held-out worlds"
        curves = {name_of(self.settings()): trained.curves, **trained.beside}
        save_learning_curves(curves, lines, title, figure)
        heading = "Mean total time, s, in held-out worlds"
        return {
            "rows": rows, "transfer": transfer, "planners": planners, "evaluated": lines,
            "curve": across_seeds(trained.curves),
            "beside": {name: across_seeds(its) for name, its in trained.beside.items()},
        }, table_of_tests(heading, self.algorithm, transfer, planners, _interval)  # fmt: skip


def _interval(row: Row) -> str:
    low, high = row["total_s_ci95"]
    return f"{row['total_s']:.1f} [{low:.1f}, {high:.1f}]"
