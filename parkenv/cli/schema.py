"""`parkenv schema`: JSON schemas of files."""

from __future__ import annotations

import json
from pathlib import Path

from typer import echo

from parkenv.cli.options import Command
from parkenv.errors import InputError, nearest
from parkenv.files.option import option
from parkenv.studies.study import STUDIES, schemas

KINDS = ("scenario", *STUDIES)


class Schema(Command):
    """Editors use them to check and complete files."""

    examples = """
        parkenv schema scenario
        parkenv schema --out schemas
        """

    kind: str | None = option(None, f"{', '.join(KINDS)}.", argument=True, default="scenario; all with --out")
    out: Path | None = option(None, "Folder for all schemas, KIND.schema.json.", short="-o", default="none")

    def run(self) -> None:
        from parkenv.files.atomic_write import make_folder

        if self.kind is not None and self.kind not in KINDS:
            raise InputError(f"KIND is {self.kind!r}; {nearest(self.kind, KINDS)}")
        made = schemas()
        if self.out is None:
            echo(json.dumps(made[self.kind or "scenario"], indent=1))
            return
        make_folder(self.out)
        for name, content in made.items():
            file = self.out / f"{name}.schema.json"
            file.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
