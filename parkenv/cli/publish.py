"""`parkenv publish`: a folder with a trained model for the Hugging Face Hub."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from parkenv import __version__
from parkenv.cli import arguments as args
from parkenv.cli.tables import make_console
from parkenv.cli.trust import require_trust
from parkenv.errors import InputError
from parkenv.files.known_names import SCENARIO_NAMES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from parkenv.scenarios.spec import ScenarioSpec
    from parkenv.studies.training.spec import TrainingSpec


def publish(
    trained: Path,
    /,
    out: Path,
    scenario: str | None = None,
    episodes: int | None = None,
    seed: int | None = None,
    *,
    trust: bool = False,
    machines: args.Machines,
) -> None:
    """Make a folder with a trained model that the Hugging Face Hub takes as it is; nothing is uploaded.

    Of a training, the best model is published, with its learning curve. The model is evaluated beside planners in the
    same worlds, by default in the scenarios that it was tested in, and if it was trained in a fleet, in fleets with
    that demand; the model card gives results with 95 % intervals and the command that repeats them.

    Examples:
        parkenv publish results/maskable-ppo --out hub/maskable-ppo
        parkenv publish results/fleet-maskable-ppo --out hub/fleet
        parkenv publish mine.safetensors --scenario my_lot.toml --out hub/mine

    Options:
        trained (DIR|FILE): The folder of a finished training, or a model file.
        out, -o (DIR): The folder to make.
        scenario (NAME|FILE|DIR[,...]): {scenarios}; scenario files (.toml), lots (.geojson), or folders.  [default:
            those of the training's test]
        episodes, -n (N >= 2): Episodes of the evaluation in each scenario; in a fleet, days.  [default: 500; in a
            fleet, 16]
        seed (N >= 0): First seed; episode i uses seed + i.  [default: 3000000, as in the tests of trainings]
    """
    from parkenv.files.atomic_write import make_folder
    from parkenv.studies.publication import CARD, FILM, MODEL, kind_of
    from parkenv.studies.results import write_summary
    from parkenv.studies.training.training import FIGURE, TEST_SEED
    from planners.model_file import ModelCard

    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out {out}: exists; name a new folder")
    seed = TEST_SEED if seed is None else seed
    spec, model, tested = _best(trained, trust) if trained.is_dir() else (None, trained, None)
    card = ModelCard.of_file(model)
    if spec is None and "fleet" in card.settings:
        raise InputError(f"{model}: was trained in a fleet; name the folder of its training")
    if scenario is not None:
        tested = args.scenario_specs(scenario)
    named = {_file_of(spec): spec for spec in (tested or _trained_on(model, card.scenarios))}
    published = kind_of(model, spec)(model, named, seed, **args.not_none(episodes=episodes))
    make_folder(out)
    console = make_console()
    with console.status("Evaluating"), machines.workers() as workers:
        rows = published.evaluate(workers)
    with console.status("Filming"):
        published.film(out / FILM)
    shutil.copyfile(model, out / MODEL)
    further = ""
    for name, each in named.items():
        if name.endswith(".json"):
            each.write(out / name)
            if files := each.files():
                further += f"\n`{name}` needs files that are not here: {', '.join(f.name for f in files)}.\n"
    if (curve := trained / FIGURE).exists():
        shutil.copyfile(curve, out / FIGURE)
        further += f"\n## Training\n\n![Learning curves]({FIGURE})\n"
    published.write_card(rows, out / CARD, further)
    results = {"command": published.command_line, "version": __version__, "seed": seed, "rows": rows}
    write_summary(out, results, "results.json")
    console.print(f"{out} holds {', '.join(sorted(path.name for path in out.iterdir()))}")
    console.print(f"To upload it: hf upload USER/NAME {shlex.quote(str(out))}")


def _best(folder: Path, trust: bool) -> tuple[TrainingSpec, Path, Sequence[ScenarioSpec] | None]:
    """Return the specification of a training, its best model, and the scenarios of its test.

    Raises:
        InputError: the folder holds no finished training.
    """
    from parkenv.studies.report import RunFolder
    from parkenv.studies.training.spec import PlacesTrainingSpec, TrainingSpec
    from parkenv.studies.training.training import MODEL

    run = RunFolder.read(folder)
    spec = run.spec()
    if not isinstance(spec, TrainingSpec):
        raise InputError(f"{folder}: holds a run of {run.kind}, want one of train")
    require_trust(spec, folder, trust)
    rows = run.summary["rows"]
    key, better = ("success", max) if spec.env == "drive" else ("total_s", min)
    best = better(rows, key=lambda row: float(row[key]))
    tested = spec.tested
    if isinstance(spec, PlacesTrainingSpec) and spec.test_on is None and spec.held_out is not None:
        kept = set(run.summary["settings"]["held_out"])
        tested = tuple(each for each in spec.scenarios or () if each.title in kept)
    return spec, folder / f"seed_{int(best['seed'])}" / MODEL, tested


def _trained_on(model: Path, names: Sequence[str]) -> list[ScenarioSpec]:
    """Return the scenarios that a model was trained on, if they are packaged ones."""
    from parkenv.scenarios.spec import scenario_spec

    for name in names:
        if name not in SCENARIO_NAMES:
            raise InputError(f"{model}: was trained on {name}, which is not packaged; add --scenario")
    if not names:
        raise InputError(f"{model}: names no scenario that it was trained on; add --scenario")
    return [scenario_spec(name) for name in names]


def _file_of(spec: ScenarioSpec) -> str:
    """Return the name of a packaged scenario, or of a file for any other."""
    from parkenv.scenarios.spec import scenario_spec

    packaged = spec.title in SCENARIO_NAMES and spec == scenario_spec(spec.title)
    return spec.title if packaged else f"{spec.title}.json"
