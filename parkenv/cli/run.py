"""`parkenv run`: run an experiment file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated

import typer

from parkenv.cli import arguments as args
from parkenv.cli.benchmark import run_suite
from parkenv.cli.compare import run_comparison
from parkenv.cli.demo import run_demo
from parkenv.cli.report import make_report
from parkenv.cli.survey import run_survey_of
from parkenv.cli.train import run_training
from parkenv.cli.trust import TrustOption, require_trust
from parkenv.errors import InputError
from parkenv.files.spec_file import nearest, read_tables

KINDS: Mapping[str, Callable[..., None]] = {
    "compare": run_comparison,
    "benchmark": run_suite,
    "survey": run_survey_of,
    "demo": run_demo,
    "train": run_training,
}
"""Functions that run the specifications of each kind."""


def run(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE|DIR", help="An experiment file (.toml, .json), or the folder of a run."),
    ],
    jobs: Annotated[
        int | None,
        typer.Option("--jobs", "-j", min=0, help="Worker processes; 0 for all cores.  [default: the file's]"),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for the results.  [default: results/NAME of the file]"),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in --out.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the results in --out.")] = False,
    report: args.ReportOption = False,
    trust: TrustOption = False,
) -> None:
    """Run an experiment file: agents, scenarios, and a grid of settings.

    Settings that the file leaves out have the defaults of its command. The result folder keeps a copy, experiment.json,
    for `parkenv report` and `--resume`. The key `kind` selects the command: compare (the default), benchmark, survey,
    demo or train.

    Examples:
    * `parkenv run sweep.toml --out results/sweep --report`

    * `parkenv run results/sweep --resume`
    """
    from parkenv.evaluation.experiments.spec import SPEC_FILE, SPECS

    if file.is_dir():
        if out is not None:
            raise InputError(f"{file} is the folder of a run, which goes on there; leave out --out")
        file, out = file / SPEC_FILE, file
    tables = read_tables(file)
    name = tables.get("kind", "compare")
    if name not in KINDS:
        raise InputError(f"{file}: kind is {name!r}; {nearest(str(name), KINDS)}")
    spec = SPECS[name].parse(tables, str(file), file.parent)
    if jobs is not None:
        spec = spec.changed(jobs=jobs)
    out = out or Path("results") / file.stem
    require_trust(spec, file, trust)
    KINDS[name](spec, out, resume=resume, overwrite=overwrite)
    if report:
        make_report(out, jobs=spec.jobs, trust=True)
