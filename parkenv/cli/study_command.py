"""Commands that run a study into a folder, and print its result; `parkenv run` and `schema`."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self, cast

from pydantic import create_model
from typer import echo

from parkenv.cli.options import Command, Given, field_options, spec_of
from parkenv.cli.report import Trust, make_report, require_trust
from parkenv.cli.tables import command_line, print_table, stages
from parkenv.errors import nearest, require
from parkenv.files.atomic_write import make_folder
from parkenv.files.option import Option, option
from parkenv.studies.results import SPEC_FILE, without_nan
from parkenv.studies.runner import Interrupted, run
from parkenv.studies.study import STUDIES, ExecutionSpec, Study, read_study, schemas, study_class

if TYPE_CHECKING:
    from parkenv.studies.runner import Result

# Commands of studies that have options besides the fields of the study, in `parkenv.cli.study_commands`.
WITH_MORE = {"survey": "Survey", "demo": "Demo", "park": "Park"}

KINDS = ("scenario", *STUDIES)  # kinds of files that have a schema


class RunCommand(Command):
    out: Annotated[Path | None, Option(short="-o")] = None
    resume: bool = option(
        False,
        "Continue the run in --out. Options may change it, for example to more episodes, if "
        "finished results stay valid.",
        panel="Results",
    )
    overwrite: bool = option(False, "Replace the run in --out.", panel="Results")
    report: bool = option(False, "Also write report.html, as `parkenv report` does.", panel="Results")
    trust: Trust = False


class StudyCommand(RunCommand):
    study: Study

    @classmethod
    def of(cls, given: Given) -> Self:
        """See `Command`: options change the study, which with --resume is the one in the folder."""
        options = [option for option in field_options(cls) if option.name in given]
        command = spec_of(
            cls, {option.name: given[option.name] for option in options if len(option.path) == 1}
        )
        study, out = command.study, command.out or command.study.folder(given)
        file = out / SPEC_FILE
        if command.resume:
            require(file.exists(), f"--resume: {out} holds no run to resume: no {SPEC_FILE}")
            study = type(study).read(file)
        if "--backend" in given and "--address" not in given:
            # The address belongs to the other backend.
            study = study.changed(address=None)
        inner = {option.name: given[option.name] for option in options if len(option.path) > 1}
        # An option of a table in the field, such as --hours of the scenarios, leaves the rest as the file has it.
        whole = {option.path[1] for option in options if len(option.path) == 2}
        require_trust(study, out, command.trust or not command.resume, given=whole)
        command = spec_of(cls, inner, command.changed(study=study, out=out))
        return command.changed(study=command.study.with_options(given, resumed=command.resume))

    def run(self) -> None:
        self.run_study()

    def run_study(self) -> Result:
        out = self.out or self.study.folder({})
        try:
            with stages(self.console, self.study.unit) as progress:
                result = run(
                    self.study, out, resume=self.resume, overwrite=self.overwrite, progress=progress,
                    command=command_line(),
                )  # fmt: skip
        except KeyboardInterrupt as stopped:
            if isinstance(stopped, Interrupted):
                self.show(stopped.result)
            rest = f" What was finished is in {out}; parkenv run {out} --resume goes on."
            self.say(f"Interrupted.{rest if (out / SPEC_FILE).exists() else ''}", soft_wrap=True)
            raise
        self.show(result)
        self.say(f"Results are in {out}")
        if self.report:
            self.write_report(result)
        return result

    def write_report(self, result: Result) -> Path:
        return make_report(result.folder, self.study)

    def show(self, result: Result) -> None:
        if result.rows:
            summary = without_nan(result.summary)
            for table in self.study.printed(summary, result.folder):
                print_table(self.console, table)
            for line in self.study.findings(summary) if result.complete else ():
                self.say(line, soft_wrap=True)


def study_command(kind: str) -> type[StudyCommand]:
    study = study_class(kind)
    base: Any = (
        getattr(import_module("parkenv.cli.study_commands"), WITH_MORE[kind])
        if kind in WITH_MORE
        else StudyCommand
    )
    out = option(None, f"Folder for {study.writes}.", short="-o", default=str(study.folder({})))
    fields: Any = {"study": (study, study()), "out": (Path | None, out)}
    model: Any = create_model(study.__name__, __base__=base, __doc__=study.__doc__, **fields)
    made = cast("type[StudyCommand]", model)
    made.examples = study.examples
    return made


class Run(RunCommand, ExecutionSpec):
    """Settings that the file omits have the defaults of its command.

    The result folder keeps a copy, experiment.json, for `parkenv report` and `--resume`. The key `kind` selects the
    command: compare (the default), commute, fleet, curve, demand, benchmark, survey, demo, calibrate, train
    or park (scenes).
    """

    examples = """
        parkenv run sweep.toml --out results/sweep --report
        parkenv run results/sweep --resume
        """

    experiment: Path = option(
        ..., "An experiment file (.toml, .json), or the folder of a run.", takes="FILE|DIR", argument=True
    )
    out: Path | None = option(None, "Folder for the results.", short="-o", default="results/NAME of the file")

    def run(self) -> None:
        file, out = self.experiment, self.out
        if file.is_dir():
            require(out is None, f"{file} is the folder of a run, which goes on there; leave out --out")
            file, out = file / SPEC_FILE, file
        study = read_study(file)
        require_trust(study, self.experiment, self.trust)
        given = self.model_fields_set & ExecutionSpec.model_fields.keys()
        if "backend" in given:
            given |= {"address"}
        study = study.changed(**{name: getattr(self, name) for name in given})
        options = {name: True for name in ("resume", "overwrite", "report") if getattr(self, name)}
        command = study_command(study.kind)
        command.parse({"study": study, "out": out or Path("results") / file.stem, **options}, "").run()


class Schema(Command):
    """Editors use them to check and complete files."""

    examples = """
        parkenv schema scenario
        parkenv schema --out schemas
        """

    kind: str | None = option(None, f"{', '.join(KINDS)}.", argument=True, default="scenario; all with --out")
    out: Path | None = option(None, "Folder for all schemas, KIND.schema.json.", short="-o", default="none")

    def run(self) -> None:
        kind = "scenario" if self.kind is None else self.kind
        require(kind in KINDS, f"KIND is {kind!r}; {nearest(kind, KINDS)}")
        texts = {kind: json.dumps(content, indent=1) for kind, content in schemas().items()}
        if self.out is None:
            echo(texts[kind])
            return
        make_folder(self.out)
        for name, text in texts.items():
            (self.out / f"{name}.schema.json").write_text(f"{text}\n", encoding="utf-8")
