"""Make the folder of a published model: of the best model of a training, or of a model file."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Self

from parkenv.errors import InputError
from parkenv.files.atomic_write import make_folder
from parkenv.files.known_names import SCENARIO_NAMES
from parkenv.scenarios.spec import ScenarioSpec, scenario_spec
from parkenv.studies.publish.publication import CARD, FILM, MODEL, kind_of
from parkenv.studies.report import RunFolder
from parkenv.studies.results import write_summary
from parkenv.studies.study import Progress
from parkenv.studies.training.spec import PlacesTrainingSpec, TrainingSpec
from parkenv.studies.training.training import FIGURE, TEST_SEED
from parkenv.studies.training.training import MODEL as TRAINED
from parkenv.studies.workers import SERIAL, Workers
from parkenv.version import __version__
from planners.model_file import ModelCard


class TrainedModel(NamedTuple):
    """A model to publish.

    Attributes:
        model: the model file.
        spec: its training, if the folder of that is known.
        tested: the scenarios of its test.
        curve: figure of its training; need not exist.
    """

    model: Path
    spec: TrainingSpec | None = None
    tested: Sequence[ScenarioSpec] | None = None
    curve: Path | None = None

    @classmethod
    def of(cls, path: Path) -> Self:
        """Return a model file, or the best model of a finished training in a folder.

        Raises:
            InputError: the folder holds no finished training, or the file is the model of a fleet.
        """
        if not path.is_dir():
            if "fleet" in ModelCard.of_file(path).settings:
                raise InputError(f"{path}: was trained in a fleet; name the folder of its training")
            return cls(path)
        run = RunFolder.read(path)
        spec = run.spec()
        if not isinstance(spec, TrainingSpec):
            raise InputError(f"{path}: holds a run of {run.kind}, want one of train")
        rows = run.summary["rows"]
        key, better = ("success", max) if spec.env == "drive" else ("total_s", min)
        best = better(rows, key=lambda row: float(row[key]))
        tested = spec.tested
        if isinstance(spec, PlacesTrainingSpec) and spec.test_on is None and spec.held_out is not None:
            kept = set(run.summary["settings"]["held_out"])
            tested = tuple(each for each in spec.scenarios or () if each.title in kept)
        return cls(path / f"seed_{int(best['seed'])}" / TRAINED, spec, tested, path / FIGURE)


def publish(
    trained: TrainedModel,
    folder: Path,
    *,
    scenarios: Sequence[ScenarioSpec] | None = None,
    episodes: int | None = None,
    seed: int = TEST_SEED,
    workers: Workers = SERIAL,
    progress: Progress = lambda *_: None,
) -> None:
    """Evaluate and film a model, and write all that the Hugging Face Hub wants into a folder.

    Args:
        trained: the model.
        folder: the new folder.
        scenarios: where it is evaluated; None for those of its test, or else of its training.
        episodes: in each scenario, or days of a fleet; None for 500, or 16 days.
        seed: first seed.
        workers: where it is evaluated.
        progress: called as its parts are finished.

    Raises:
        InputError: the model cannot be evaluated there.
    """
    model = trained.model
    tested = scenarios or trained.tested or _trained_on(model, ModelCard.of_file(model).scenarios)
    named = {_file_of(each): each for each in tested}
    options = {} if episodes is None else {"episodes": episodes}
    published = kind_of(model, trained.spec)(model, named, seed, **options)
    make_folder(folder)
    progress("Evaluating", 0, 1)
    rows = published.evaluate(workers)
    progress("Evaluating", 1, 1)
    progress("Filming", 0, 1)
    published.film(folder / FILM)
    progress("Filming", 1, 1)
    shutil.copyfile(model, folder / MODEL)
    further = ""
    for name, each in named.items():
        if name.endswith(".json"):
            each.write(folder / name)
            if files := each.files():
                further += f"\n`{name}` needs files that are not here: {', '.join(f.name for f in files)}.\n"
    if trained.curve is not None and trained.curve.exists():
        shutil.copyfile(trained.curve, folder / FIGURE)
        further += f"\n## Training\n\n![Learning curves]({FIGURE})\n"
    published.write_card(rows, folder / CARD, further)
    results = {"command": published.command_line, "version": __version__, "seed": seed, "rows": rows}
    write_summary(folder, results, "results.json")


def _trained_on(model: Path, names: Sequence[str]) -> list[ScenarioSpec]:
    """Return the scenarios that a model was trained on, if they are packaged ones."""
    for name in names:
        if name not in SCENARIO_NAMES:
            raise InputError(f"{model}: was trained on {name}, which is not packaged; add --scenario")
    if not names:
        raise InputError(f"{model}: names no scenario that it was trained on; add --scenario")
    return [scenario_spec(name) for name in names]


def _file_of(spec: ScenarioSpec) -> str:
    """Return the name of a packaged scenario, or of a file for any other."""
    packaged = spec.title in SCENARIO_NAMES and spec == scenario_spec(spec.title)
    return spec.title if packaged else f"{spec.title}.json"
