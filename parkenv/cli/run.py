"""`parkenv run`: run an experiment file."""

from __future__ import annotations

from pathlib import Path

from parkenv.cli.options import command_class
from parkenv.cli.study_command import RunCommand
from parkenv.cli.trust import require_trust
from parkenv.errors import InputError
from parkenv.files.option import option
from parkenv.studies.results import SPEC_FILE
from parkenv.studies.study import ExecutionSpec, read_study

COMMANDS = {
    "compare": "compare:Compare",
    "commute": "commute:Commute",
    "fleet": "fleet:Fleet",
    "benchmark": "benchmark:RunSuite",
    "survey": "survey:Survey",
    "detectors": "detect:CompareDetectors",
    "demo": "demo:Demo",
    "calibrate": "drive:Calibrate",
    "verify": "verify:Verify",
    "train": "train:Train",
}
"""The command of each kind of study."""


class Run(RunCommand, ExecutionSpec):
    """Settings that the file leaves out have the defaults of its command.

    The result folder keeps a copy, experiment.json, for `parkenv report` and `--resume`. The key `kind` selects the
    command: compare (the default), commute, fleet, benchmark, survey, demo or train.
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
