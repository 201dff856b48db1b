"""`parkenv schema`: the JSON schemas of scenario and experiment files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from typer import echo

from parkenv.errors import InputError, nearest

KINDS = (
    "scenario", "compare", "commute", "fleet", "benchmark", "survey", "detectors", "demo", "calibrate", "verify",
    "train",
)  # fmt: skip


def schemas() -> dict[str, dict[str, Any]]:
    """Return the schema of each kind of file, made from the models that validate it."""
    from pydantic import TypeAdapter

    from parkenv.scenarios.spec import ScenarioSpec
    from parkenv.studies.study import study_class
    from parkenv.studies.training.spec import AnyTrainingSpec

    models: dict[str, Any] = {"scenario": ScenarioSpec}
    models |= {kind: study_class(kind) for kind in KINDS[1:-1]} | {"train": AnyTrainingSpec}
    draft = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return {kind: draft | TypeAdapter(models[kind]).json_schema() for kind in KINDS}


def schema(kind: str | None = None, /, out: Path | None = None) -> None:
    """Print the JSON schema of a kind of file, or write all schemas; editors use them to check and complete files.

    Examples:
        parkenv schema scenario
        parkenv schema --out docs/schemas

    Options:
        kind (KIND): scenario, compare, commute, fleet, benchmark, survey, detectors, demo, calibrate, verify,
            train.  [default: scenario; all with --out]
        out, -o (DIR): Folder for all schemas, KIND.schema.json.  [default: none]
    """
    if kind is not None and kind not in KINDS:
        raise InputError(f"KIND is {kind!r}; {nearest(kind, KINDS)}")
    made = schemas()
    if out is None:
        echo(json.dumps(made[kind or "scenario"], indent=1))
        return
    from parkenv.files.atomic_write import make_folder

    make_folder(out)
    for name, content in made.items():
        (out / f"{name}.schema.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
