"""The command of each kind of study, made from its fields; `parkenv run` and `schema`."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import Any, cast

from pydantic import create_model
from typer import echo

from parkenv.cli.options import Command
from parkenv.cli.report import require_trust
from parkenv.cli.study_command import RunCommand, StudyCommand
from parkenv.errors import nearest, require
from parkenv.files.atomic_write import make_folder
from parkenv.files.option import option
from parkenv.studies.results import SPEC_FILE
from parkenv.studies.study import STUDIES, ExecutionSpec, read_study, schemas, study_class

# Commands of studies that have options besides the fields of the study, in `parkenv.cli.study_commands`.
WITH_MORE = {"survey": "Survey", "demo": "Demo", "park": "Park"}

KINDS = ("scenario", *STUDIES)  # kinds of files that have a schema


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
