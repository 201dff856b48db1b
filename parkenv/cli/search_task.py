"""Training of search agents by `parkenv train`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.cli.training_task import (
    EVALUATION_SEED,
    FIGURE,
    TEST_SEED,
    Row,
    TrainingTask,
    name_of,
    print_tests,
    row_of,
    scenario_settings,
)
from parkenv.evaluation.experiments.agent_spec import AgentSpec
from parkenv.scenarios.build import build
from parkenv.scenarios.spec import ScenarioSpec, scenario_spec

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.evaluation.experiments.workers import Workers
    from parkenv.evaluation.training.search_training import SearchTraining
    from parkenv.world.scenario import Scenario

DEMONSTRATION_SEED = 5_000_000
"""First world seed of the demonstrations."""
PLANNERS = tuple(
    AgentSpec(name=name)
    for name in ("belief", "mdp-tuned", "mdp", "first-free", "greedy-drive", "greedy-goal")
)


@dataclass(eq=False)
class SearchTask(TrainingTask):
    """Training of search agents in some scenarios."""

    @property
    def folder(self) -> str:
        """See `TrainingTask`."""
        return self.algorithm

    def config(self) -> Any:
        """See `TrainingTask`."""
        from parkenv.evaluation.training.configs import SEARCH_CONFIGS, config_of

        return config_of(self.algorithm, SEARCH_CONFIGS, "search")

    @property
    def algorithm(self) -> str:
        """See `TrainingTask`."""
        return self.spec.algorithm or "maskable-ppo"

    @property
    def _scenarios(self) -> Sequence[ScenarioSpec]:
        return self.spec.scenarios or (scenario_spec("campus"),)

    @cached_property
    def worlds(self) -> list[Scenario]:
        """Scenarios to train in."""
        return [build(scenario) for scenario in self._scenarios]

    @cached_property
    def tested(self) -> list[Scenario]:
        """Scenarios to test in."""
        return [build(scenario) for scenario in self.spec.test_on or self._scenarios]

    @property
    def k(self) -> int:
        """Number of slots in an observation."""
        return self.spec.k or 5

    @property
    def demonstrations(self) -> int:
        """Number of demonstrations to clone."""
        return self.spec.demonstrations or 2000

    @property
    def evaluation_episodes(self) -> int:
        """Episodes per evaluation."""
        return self.spec.evaluation_episodes or 256

    @property
    def evaluation_seeds(self) -> range:
        """Seeds of the worlds of the evaluations."""
        return range(EVALUATION_SEED, EVALUATION_SEED + self.evaluation_episodes)

    @property
    def compared(self) -> Sequence[AgentSpec]:
        """Planners to draw for comparison."""
        return PLANNERS if self.spec.agents is None else self.spec.agents

    def check(self) -> None:
        """See `TrainingTask`."""
        from parkenv.evaluation.training.cloning import require_cloneable
        from planners.agent import make_agent

        super().check()
        if self.spec.clone is not None:
            require_cloneable(self.algorithm, self.spec.clone, self.worlds[0])
        for world in (self.worlds[0], *self.tested):
            for agent in self.compared:
                make_agent(agent.name, world, **agent.options)

    @property
    def steps(self) -> int:
        """Decisions of a training."""
        return self.spec.steps or 2_000_000

    @property
    def evaluate_every(self) -> int:
        """Decisions between evaluations."""
        return self.spec.evaluate_every or 100_000

    def settings(self) -> Row:
        """See `TrainingTask`."""
        return {
            "algorithm": self.algorithm, "scenario": [w.name for w in self.worlds], "steps": self.steps,
            "clone": self.spec.clone, "demonstrations": self.demonstrations if self.spec.clone else None, "k": self.k,
            "evaluate_every": self.evaluate_every, "evaluation_episodes": self.evaluation_episodes,
            **scenario_settings(self._scenarios),
        }  # fmt: skip

    def evaluation_settings(self, settings: Row) -> Row:
        """See `TrainingTask`."""
        first, *_ = settings.get("scenario") or [None]
        return {"scenario": first, "evaluation_episodes": settings.get("evaluation_episodes")}

    @property
    def measures(self) -> tuple[str, ...]:
        """See `TrainingTask`."""
        return ("total_s",)

    def training(self, console: Console) -> SearchTraining:
        """See `TrainingTask`."""
        from parkenv.evaluation.training.search_training import SearchTraining

        demonstrations = None
        if self.spec.clone is not None:
            from parkenv.evaluation.training.cloning import Demonstrations

            with console.status(f"Recording {self.demonstrations} searches of {self.spec.clone}"):
                demonstrations = Demonstrations.collect(
                    self.spec.clone,
                    self.worlds[0],
                    range(DEMONSTRATION_SEED, DEMONSTRATION_SEED + self.demonstrations),
                    self.k,
                )
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

    def report(
        self,
        console: Console,
        workers: Workers,
        curves: list[list[Row]],
        models: dict[int, Path],
        out: Path,
        beside: dict[str, list[list[Row]]],
    ) -> Row:
        """See `TrainingTask`."""
        from parkenv.evaluation.figures.learning_curves import across_seeds, save_learning_curves
        from parkenv.evaluation.training.search_training import search_times
        from planners.learned import LearnedAgent

        at_test = range(TEST_SEED, TEST_SEED + 2 * self.evaluation_episodes)
        lines, tables = _planner_times(
            console, workers, self.compared, self.worlds[0], self.tested, self.evaluation_seeds, at_test
        )
        rows, transfer = [], []
        with console.status("Testing"):
            for (number, model), curve in zip(models.items(), curves, strict=True):
                for world in self.tested:
                    row = search_times(LearnedAgent(world, self.algorithm, model), world, at_test)
                    transfer.append(
                        {"agent": self.algorithm, "seed": number, "test_scenario": world.name, **row}
                    )
                tested = transfer[-len(self.tested)]
                own = {c: tested[c] for c in ("total_s", "total_s_ci95")}
                rows.append(row_of(self.algorithm, tested["test_scenario"], number, curve, own, model))
        title = f"{self.worlds[0].name}: {self.evaluation_episodes} searches in held-out worlds"
        save_learning_curves({name_of(self.settings()): curves, **beside}, lines, title, out / FIGURE)
        print_tests(
            console,
            "Mean total time, s, in held-out worlds",
            self.algorithm,
            transfer,
            tables,
            _interval,
        )
        return {
            "rows": rows, "transfer": transfer, "planners": tables, "evaluated": lines, "curve": across_seeds(curves),
            "beside": {name: across_seeds(its) for name, its in beside.items()},
        }  # fmt: skip


def _planner_times(
    console: Console,
    workers: Workers,
    agents: Sequence[AgentSpec],
    first: Any,
    tested: Sequence[Any],
    evaluation_seeds: range,
    at_test: range,
) -> tuple[dict[str, float], list[Row]]:
    """Mean times of planners in the evaluation worlds, and their rows in the test worlds."""
    from parkenv.evaluation.experiments.compare import rows_of

    if not agents:
        return {}, []
    with console.status("Planners search in the same worlds"):
        rows = rows_of(agents, first, evaluation_seeds, workers)
        tables = [row for world in tested for row in rows_of(agents, world, at_test, workers)]
    lines = {row["agent"]: row["total_s"] for row in rows}
    return {**lines, "clairvoyant bound": rows[0]["bound_s"]}, tables


def _interval(row: Row) -> str:
    low, high = row["total_s_ci95"]
    return f"{row['total_s']:.1f} [{low:.1f}, {high:.1f}]"
