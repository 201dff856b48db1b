"""`parkenv publish`: a folder with a trained model for the Hugging Face Hub."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

from parkenv.cli.options import Command
from parkenv.cli.tables import make_console, stages
from parkenv.cli.trust import Trust, require_trust
from parkenv.errors import InputError
from parkenv.files.option import Inside, Option, option, words_in
from parkenv.studies.fields import SCENARIOS_HELP, SCENARIOS_TAKE, ScenarioList, Seed
from parkenv.studies.study import ExecutionSpec


class Publish(Command, ExecutionSpec):
    """Of a training, the best model is published, with its learning curve.

    The model is evaluated beside planners in the same worlds, by default in the scenarios that it was tested in, and if
    it was trained in a fleet, in fleets with that demand; the model card gives results with 95 % intervals and the
    command that repeats them.
    """

    examples = """
        parkenv publish results/maskable-ppo --out hub/maskable-ppo
        parkenv publish results/fleet-maskable-ppo --out hub/fleet
        parkenv publish mine.safetensors --scenario my_lot.toml --out hub/mine
        """

    trained: Path = option(
        ..., "The folder of a finished training, or a model file.", takes="DIR|FILE", argument=True
    )
    scenarios: Annotated[ScenarioList | None, Inside(only=())] = option(
        None,
        SCENARIOS_HELP,
        name="--scenario",
        takes=SCENARIOS_TAKE,
        parse=words_in,
        default="those of the training's test",
    )
    episodes: int | None = option(
        None,
        "Episodes of the evaluation in each scenario; in a fleet, days.",
        short="-n",
        default="500; in a fleet, 16",
        ge=2,
    )
    seed: Annotated[Seed, Option(default="3000000, as in the tests of trainings")] = 3_000_000
    trust: Trust = False
    out: Path = option(..., "The folder to make.", short="-o")

    def run(self) -> None:
        """See `Command`."""
        from parkenv.studies.publish_model import TrainedModel, publish

        if self.out.exists() and (not self.out.is_dir() or any(self.out.iterdir())):
            raise InputError(f"--out {self.out}: exists; name a new folder")
        model = TrainedModel.of(self.trained)
        if model.spec is not None:
            require_trust(model.spec, self.trained, self.trust)
        console = make_console()
        with stages(console) as progress, self.workers() as workers:
            publish(
                model, self.out, scenarios=self.scenarios, episodes=self.episodes, seed=self.seed, workers=workers,
                progress=progress,
            )  # fmt: skip
        console.print(f"{self.out} holds {', '.join(sorted(path.name for path in self.out.iterdir()))}")
        console.print(f"To upload it: hf upload USER/NAME {shlex.quote(str(self.out))}")
