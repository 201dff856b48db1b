"""`parkenv run`: run an experiment file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from parkenv.cli import arguments as args
from parkenv.cli.benchmark import run_suite
from parkenv.cli.commute import run_commute_of
from parkenv.cli.compare import run_comparison
from parkenv.cli.demo import run_demo
from parkenv.cli.fleet import run_fleet_of
from parkenv.cli.single_writer import writing_into
from parkenv.cli.survey import run_survey_of
from parkenv.cli.train import run_training
from parkenv.cli.trust import require_trust
from parkenv.errors import InputError, nearest

KINDS: Mapping[str, Callable[..., None]] = {
    "compare": run_comparison,
    "commute": run_commute_of,
    "fleet": run_fleet_of,
    "benchmark": run_suite,
    "survey": run_survey_of,
    "demo": run_demo,
    "train": run_training,
}
"""Function that runs each kind of file."""


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
    from parkenv.files.spec_file import read_tables
    from parkenv.studies.kinds import SPECS
    from parkenv.studies.spec import SPEC_FILE

    file = experiment
    if file.is_dir():
        if out is not None:
            raise InputError(f"{file} is the folder of a run, which goes on there; leave out --out")
        file, out = file / SPEC_FILE, file
    tables = read_tables(file)
    name = tables.get("kind", "compare")
    if not isinstance(name, str) or name not in KINDS:
        raise InputError(f"{file}: kind is {name!r}; {nearest(str(name), KINDS)}")
    spec = SPECS[name].parse(tables, str(file), file.parent)
    require_trust(spec, experiment, trust)
    out = out or Path("results") / file.stem
    with writing_into(out, f"parkenv run {out} --resume"):
        KINDS[name](spec.changed(**machines.given), out, folder)
