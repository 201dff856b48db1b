"""Commands that run a study into a folder, and print its result."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self

from parkenv.cli.options import Command, Given, field_options, spec_of
from parkenv.cli.report import Trust, make_report, require_trust
from parkenv.cli.tables import command_line, print_table, stages
from parkenv.errors import require
from parkenv.files.option import Option, option
from parkenv.studies.results import SPEC_FILE, without_nan
from parkenv.studies.runner import Interrupted, run
from parkenv.studies.study import Study

if TYPE_CHECKING:
    from parkenv.studies.runner import Result


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
