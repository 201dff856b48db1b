"""`parkenv dataset`: data sets for offline reinforcement learning."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from parkenv.cli.study_command import StudyCommand
from parkenv.cli.tables import print_rows
from parkenv.files.option import option
from parkenv.studies.dataset.study import DatasetStudy

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.studies.runner import Result


class Dataset(StudyCommand):
    """The folder is a root of Minari's data sets: `MINARI_DATASETS_PATH=DIR` lets `minari.load_dataset` find them.

    Each search has the world of its seed. `recover_environment` returns the environment; with the seed and the actions
    of an episode it repeats the episode. --resume continues with more --steps.
    """

    examples = """
        parkenv dataset campus --policy random,greedy,mdp,belief,mixed
        parkenv dataset mini --policy greedy --epsilon 0.2 --steps 1000000
        parkenv dataset --lot lot.geojson --policy my_agents:Patient
        """

    study: DatasetStudy = DatasetStudy()
    out: Path = option(
        Path("results/dataset"), "Folder for the data sets, episodes.csv and summary.json.", short="-o"
    )

    def show(self, console: Console, result: Result) -> None:
        """Print what each data set holds, and how it is loaded."""
        shown = ("dataset", "episodes", "steps", "total_s", "parked_fraction", "truncated_fraction")
        print_rows(console, "Data sets", result.rows, shown)
        if result.complete:
            name, folder = result.rows[0]["dataset"], result.folder
            console.print(f"MINARI_DATASETS_PATH={folder} minari show {name}", soft_wrap=True)
