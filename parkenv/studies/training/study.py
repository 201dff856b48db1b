"""The study that trains search agents by reinforcement learning, several times, and tests them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from parkenv.files.atomic_write import atomic_write
from parkenv.files.limited_reading import read_json
from parkenv.show.tables import Column, shared
from parkenv.studies.results import PAGE, SUMMARY, Row, Table, without_nan
from parkenv.studies.study import Cell, ReplayJob, ReportOptions, Stage
from parkenv.studies.training.curve_file import CURVE, read_curve
from parkenv.studies.training.spec import TrainingSpec
from parkenv.version import __version__

if TYPE_CHECKING:
    from parkenv.show.report.page import Page
    from parkenv.studies.results import Results
    from parkenv.studies.training.training import Training

FILES = "files"  # key of the files of a training in its row


class _Seeds(NamedTuple):
    folder: Path = Path()  # that of the run; a training keeps its checkpoint there
    command: tuple[str, ...] = ()  # command line of the run
    columns: Row = {}  # noqa: RUF012 - never changed


class TrainingStudy(TrainingSpec):
    """The reward of search agents is minus the time in seconds. They observe the surroundings of the car.

    So they run on any lot. They are evaluated in held-out worlds; each seed's best model is kept, and tested at the
    end. Hyperparameters are in parkenv/studies/training/configs.py.

    With --resume, trainings continue from the checkpoints in --out, in worlds that they have not seen. With more
    --steps, finished trainings continue, too.
    """

    table: ClassVar = Table("trainings.csv", ("seed",), ("steps", "wall_s"))
    block: ClassVar = 1
    doing: ClassVar = "Training"
    table_titles: ClassVar = {
        "rows": "Trained models",
        "transfer": "Test in held-out worlds",
        "planners": "Planners in the same worlds",
    }
    unit: ClassVar = ""
    columns: ClassVar = (
        *shared("scenario"),
        Column("test_scenario", "tested on", setting=True),
        *shared("agent"),
        Column("seed", "seed", digits=0),
        *shared("total_s"),
        Column("steps", "decisions in training", digits=0),
        Column("steps_per_s", "decisions/s", digits=0),
        Column("model", "model"),
    )
    shown: ClassVar = dict.fromkeys(
        ("transfer", "planners"),
        ("test_scenario", "scenario", "agent", "seed", "episodes", "total_s", "parked_fraction"),
    )
    writes: ClassVar = "models, curves and figures"
    examples: ClassVar = """
        parkenv train maskable-ppo --scenario campus
        parkenv train maskable-ppo --scenario campus --steps 4000000 --resume
        parkenv train ppo --scenario my_lot.toml --steps 200000 --trainings 1
        parkenv train maskable-ppo --scenario lots --held-out 0.2
        parkenv train ppo --test-on street,jam
        parkenv compare --agents mdp,ppo:results/ppo/seed_0/model.safetensors
        """

    @cached_property
    def training(self) -> Training:
        """What trains, evaluates and tests; it loads torch."""
        from parkenv.studies.training.training import Training

        return Training(self)

    def check(self) -> None:
        self.training.check()

    def settings(self) -> Row:
        return {"version": __version__, **self.training.settings()}

    def prepare(self, results: Results, *, continues: bool) -> None:
        from parkenv.studies.training.training import FIGURE

        for outcome in (PAGE, FIGURE):
            (results.path / outcome).unlink(missing_ok=True)
        if not continues:
            for folder in results.path.glob("seed_*"):
                shutil.rmtree(folder)

    def cells(self) -> list[Cell]:
        return [Cell(_Seeds(), range(self.seed, self.seed + self.trainings))]

    def stages(self, results: Results) -> Iterator[Stage]:
        """See `Study`; shorter trainings go on, and the bars follow the curves that trainings write."""
        rows = results.rows(self.table).values()
        results.replace([row for row in rows if row["steps"] >= self.steps], self.table)
        seeds = self.cells()[0].items
        work = _Seeds(results.path, tuple(results.command))
        with self.training.watched(results.path, seeds, results.progress):
            yield Stage(self.doing, self, [Cell(work, seeds)])

    def run(self, work: _Seeds, items: Sequence[int]) -> list[Row]:
        from parkenv.studies.training.training import MODEL, own_thread_and_seeds

        rows: list[Row] = []
        for seed in items:
            folder = work.folder / f"seed_{seed}"
            with own_thread_and_seeds():
                last = self.training.train(seed, folder, work.command)[-1]
            # As bytes, so that a worker on another machine can return them.
            files = {name: (folder / name).read_bytes() for name in (CURVE, MODEL)}
            rows.append({"seed": seed, "steps": int(last["steps"]), "wall_s": last["wall_s"], FILES: files})
        return rows

    def save_artifacts(self, work: _Seeds, rows: Sequence[Row], results: Results) -> None:
        for row in rows:
            folder = results.path / f"seed_{row['seed']}"
            folder.mkdir(exist_ok=True)
            for name, content in row.pop(FILES).items():
                with atomic_write(folder / name) as beside:
                    beside.write_bytes(content)

    def summarise(self, results: Results) -> Row:
        if len(self.rows_of(self.cells()[0], results)) < self.trainings:
            return {"rows": []}
        return {"settings": self.settings(), **self.training.report(results)}

    @classmethod
    def findings(cls, summary: Row) -> list[str]:
        rows = summary["rows"]
        if not rows:
            return []
        best, worst = min(row["total_s"] for row in rows), max(row["total_s"] for row in rows)
        return [f"Models tested on {rows[0]['scenario']} in held-out worlds: {best:.1f} to {worst:.1f} s."]

    @classmethod
    def page(cls, summary: Row, folder: Path) -> Page:
        from parkenv.show.report.page import learning_panels, listed, on_scenarios

        rows = summary["rows"]
        agents = list(dict.fromkeys(str(row.get("agent", "agent")) for row in rows))
        curves = [without_nan(read_curve(folder / f"seed_{row['seed']}" / CURVE)) for row in rows]
        title, panels = f"{listed(agents)} trained{on_scenarios(rows)}", learning_panels(summary, curves)
        return super().page(summary, folder)._replace(title=title, learning=panels)

    def replays(self, folder: Path, options: ReportOptions) -> Sequence[ReplayJob]:
        return self.training.replays(read_json(folder / SUMMARY), folder, options)
