"""`parkenv train`: train search agents by reinforcement learning."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Self

from parkenv.cli.options import Given, made
from parkenv.cli.study_command import StudyCommand
from parkenv.cli.tables import print_rows
from parkenv.files.option import option
from parkenv.studies.training.spec import TrainingSpec

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.studies.runner import Result

SHOWN = ("test_scenario", "agent", "seed", "episodes", "total_s", "parked_fraction")
"""Columns of the tests that are printed."""


class Train(StudyCommand):
    """The reward of search agents is minus the time in seconds. They observe the surroundings of the car.

    So they run on any lot. They are evaluated in held-out worlds; each seed's best model is kept, and tested at the
    end. Hyperparameters are in parkenv/studies/training/configs.py.

    With --resume, trainings continue from the checkpoints in --out; the models equal those of an uninterrupted
    training. With more --steps, finished trainings continue, too.
    """

    examples = """
        parkenv train maskable-ppo --scenario campus
        parkenv train maskable-ppo --scenario campus --steps 4000000 --resume
        parkenv train ppo --scenario my_lot.toml --steps 200000 --trainings 1
        parkenv train maskable-ppo --scenario lots --held-out 0.2 --curriculum size
        parkenv train ppo --clone mdp-tuned --test-on street,jam --out cloned
        parkenv train ppo --beside results/maskable-ppo,results/dqn
        parkenv compare --agents mdp,ppo:results/ppo/seed_0/model.safetensors
        """

    study: TrainingSpec = TrainingSpec()
    out: Path | None = option(
        None, "Folder for models, curves and figures.", short="-o", default="results/ALGORITHM"
    )

    @classmethod
    def of(cls, given: Given) -> Self:
        """See `Command`; with --resume the options are those of the training, which may have more steps."""
        command = made(cls, given)
        return command if command.out else command.changed(out=Path("results") / command.study.algorithm)

    def show(self, console: Console, result: Result) -> None:
        """Print the tests of the models and of the planners."""
        if self.study.training.announcement:
            console.print(self.study.training.announcement)
        if result.complete:
            models, planners = result.summary["transfer"], result.summary["planners"]
            rows = [*models, *(row | {"test_scenario": row["scenario"]} for row in planners)]
            print_rows(console, "Tests in held-out worlds", rows, SHOWN)
