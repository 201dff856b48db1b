"""`parkenv run`: run an experiment file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from parkenv.cli import arguments as args
from parkenv.cli.benchmark import show_scores
from parkenv.cli.calibrate import show_calibration
from parkenv.cli.commute import show as show_commute
from parkenv.cli.compare import show as show_comparison
from parkenv.cli.demo import run_demo
from parkenv.cli.detector_drives import show as show_detectors
from parkenv.cli.fleet import show as show_fleet
from parkenv.cli.study_run import run_study
from parkenv.cli.survey import show as show_survey
from parkenv.cli.train import show as show_training
from parkenv.cli.trust import require_trust
from parkenv.cli.verify import show as show_verification
from parkenv.errors import InputError

SHOWN: Mapping[str, Callable[..., None]] = {
    "compare": show_comparison,
    "commute": show_commute,
    "fleet": show_fleet,
    "benchmark": show_scores,
    "survey": show_survey,
    "detectors": show_detectors,
    "calibrate": show_calibration,
    "verify": show_verification,
    "train": show_training,
}
"""What prints the result of each kind of study."""


def run(
    experiment: Path,
    /,
    out: Path | None = None,
    *,
    trust: bool = False,
    folder: args.ReportedRun,
    machines: args.Machines,
) -> None:
    """Run an experiment file: agents, scenarios, and a grid of settings.

    Settings that the file leaves out have the defaults of its command. The result folder keeps a copy, experiment.json,
    for `parkenv report` and `--resume`. The key `kind` selects the command: compare (the default), commute, fleet,
    benchmark, survey, demo or train.

    Examples:
        parkenv run sweep.toml --out results/sweep --report
        parkenv run results/sweep --resume

    Options:
        experiment (FILE|DIR): An experiment file (.toml, .json), or the folder of a run.
        out, -o (DIR): Folder for the results.  [default: results/NAME of the file]
    """
    from parkenv.studies.results import SPEC_FILE
    from parkenv.studies.study import read_study

    file = experiment
    if file.is_dir():
        if out is not None:
            raise InputError(f"{file} is the folder of a run, which goes on there; leave out --out")
        file, out = file / SPEC_FILE, file
    study = read_study(file)
    require_trust(study, experiment, trust)
    study, out = study.changed(**machines.given), out or Path("results") / file.stem
    if study.kind == "demo":
        run_demo(study, out, folder)
    else:
        run_study(study, out, folder, SHOWN[study.kind])
