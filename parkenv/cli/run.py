"""`parkenv run`: run an experiment file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from parkenv.cli import arguments as args
from parkenv.cli.benchmark import run_suite
from parkenv.cli.compare import run_comparison
from parkenv.cli.demo import run_demo
from parkenv.cli.report import make_report
from parkenv.cli.run_folder import run_folder
from parkenv.cli.survey import run_survey_of
from parkenv.cli.train import run_training
from parkenv.errors import InputError
from parkenv.files.spec_file import nearest, read_tables


class Kind(NamedTuple):
    """A kind of experiment file.

    Attributes:
        spec: module and class of its specification, imported on demand.
        run: function that runs it.
    """

    spec: str
    run: Callable[..., None]


KINDS: Mapping[str, Kind] = {
    "compare": Kind("ExperimentSpec", run_comparison),
    "benchmark": Kind("BenchmarkSpec", run_suite),
    "survey": Kind("SurveySpec", run_survey_of),
    "demo": Kind("DemoSpec", run_demo),
    "train": Kind("TrainingSpec", run_training),
}


def run(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE|DIR", help="An experiment file (.toml, .json), or the folder of a run."),
    ],
    jobs: args.JobsOption = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for the results.  [default: results/NAME of the file]"),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in --out.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the results in --out.")] = False,
    report: args.ReportOption = False,
) -> None:
    """Run an experiment file: agents, scenarios, and a grid of settings.

    Settings that the file leaves out have the defaults of its command. The result folder keeps a copy, experiment.json,
    for `parkenv report` and `--resume`. The key `kind` selects the command: compare (the default), benchmark, survey,
    demo or train.

    Examples:
    * `parkenv run sweep.toml --out results/sweep --report`

    * `parkenv run results/sweep --resume`
    """
    from parkenv.evaluation.experiments import spec as specs
    from parkenv.evaluation.experiments.spec import SPEC_FILE

    if file.is_dir():
        if out is not None:
            raise InputError(f"{file} is the folder of a run, which goes on there; leave out --out")
        file, out = file / SPEC_FILE, file
    tables = read_tables(file)
    name = tables.get("kind", "compare")
    if name not in KINDS:
        raise InputError(f"{file}: kind is {name!r}; {nearest(str(name), KINDS)}")
    kind = KINDS[name]
    spec: Any = getattr(specs, kind.spec).parse(tables, str(file), file.parent)
    spec = spec.changed(**args.workplace(jobs))
    out = out or Path("results") / file.stem
    with run_folder(out, f"parkenv run {out} --resume"):
        kind.run(spec, out, resume=resume, overwrite=overwrite)
        if report:
            make_report(out, jobs=spec.jobs)
