"""Commands that run a study into a folder, with progress bars, and print its result; `parkenv run`."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self

from parkenv.cli.options import Command, Given, command_class, field_options, made
from parkenv.cli.report import make_report
from parkenv.cli.tables import command_line, make_console, stages
from parkenv.cli.trust import Trust, TrustModel, readable_models, require_trust
from parkenv.errors import InputError
from parkenv.files.option import Option, option
from parkenv.studies.agent_spec import split_agents
from parkenv.studies.results import SPEC_FILE
from parkenv.studies.study import ExecutionSpec, Study, read_study

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.studies.runner import Result


class RunCommand(Command):
    """A command that runs a study into a folder."""

    out: Annotated[Path | None, Option(short="-o")]
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
    """A command that runs one kind of study."""

    study: Study

    @classmethod
    def of(cls, given: Given) -> Self:
        """See `Command`: options change the study, which with --resume is the one in the folder."""
        options = [option for option in field_options(cls) if option.name in given]
        command = made(cls, {option.name: given[option.name] for option in options if len(option.path) == 1})
        study, file = command.study, (command.out or Path()) / SPEC_FILE
        if command.resume:
            if not file.exists():
                raise InputError(f"--resume: {command.out} holds no run to resume: no {SPEC_FILE}")
            study = type(study).read(file)
        if "--backend" in given and "--address" not in given:
            # The address belongs to the other backend.
            study = study.changed(address=None)
        inner = {option.name: option.path[1] for option in options if len(option.path) > 1}
        # An option of a table in the field, such as --hours of the scenarios, leaves the rest as the file has it.
        whole = {option.path[1] for option in options if len(option.path) == 2}
        require_trust(study, file.parent, command.trust or not command.resume, given=whole)
        return made(cls, {name: given[name] for name in inner}, command.changed(study=study))

    def run(self) -> None:
        self.run_study()

    def run_study(self) -> Result:
        """Run the study, print its result, and write its report on request.

        Raises:
            InputError: the study cannot be run, or the folder cannot be used.
            KeyboardInterrupt: the run was interrupted; what is finished is printed and in the folder.
        """
        from parkenv.studies.runner import Interrupted, run

        console = make_console()
        try:
            with stages(console, self.study.unit) as progress:
                result = run(
                    self.study, self.out, resume=self.resume, overwrite=self.overwrite, progress=progress,
                    command=command_line(),
                )  # fmt: skip
        except KeyboardInterrupt as stopped:
            if isinstance(stopped, Interrupted):
                self.show(console, stopped.result)
            rest = f" What was finished is in {self.out}; parkenv run {self.out} --resume goes on."
            has_begun = self.out is not None and (self.out / SPEC_FILE).exists()
            console.print(f"Interrupted.{rest if has_begun else ''}", soft_wrap=True)
            raise
        self.show(console, result)
        if self.out is not None:
            console.print(f"Results are in {self.out}")
            if self.report:
                self.write_report(result)
        return result

    def write_report(self, result: Result) -> Path:
        """Write the page on the run; return its path."""
        return make_report(result.folder, self.study)

    @abstractmethod
    def show(self, console: Console, result: Result) -> None:
        """Print a result, perhaps of an interrupted run."""


class AgentStudyCommand(StudyCommand):
    """A command that runs one kind of study, with agents."""

    trust_model: TrustModel = False

    @classmethod
    def of(cls, given: Given) -> Self:
        if "--agents" in given and "--trust-model" in given:
            given = {**given, "--agents": ",".join(readable_models(split_agents(given["--agents"])))}
        return super().of(given)


COMMANDS = {
    "compare": "compare:Compare",
    "commute": "drivers:Commute",
    "fleet": "drivers:Fleet",
    "curve": "drivers:Curve",
    "demand": "occupancy:Demand",
    "benchmark": "benchmark:RunSuite",
    "survey": "survey:Survey",
    "demo": "demo:Demo",
    "calibrate": "drive:Calibrate",
    "train": "train:Train",
    "park": "drive:Park",
}
"""The command of each kind of study."""


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
        """See `Command`; the folder of a run goes on there."""
        file, out = self.experiment, self.out
        if file.is_dir():
            if out is not None:
                raise InputError(f"{file} is the folder of a run, which goes on there; leave out --out")
            file, out = file / SPEC_FILE, file
        study = read_study(file)
        require_trust(study, self.experiment, self.trust)
        given = self.model_fields_set & ExecutionSpec.model_fields.keys()
        if "backend" in given:
            given |= {"address"}
        study = study.changed(**{name: getattr(self, name) for name in given})
        options = {name: True for name in ("resume", "overwrite", "report") if getattr(self, name)}
        command = command_class(COMMANDS[study.kind])
        command.parse({"study": study, "out": out or Path("results") / file.stem, **options}, "").run()
