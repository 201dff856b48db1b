"""`parkenv schema`: the JSON schemas of scenario and experiment files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import BaseModel

from parkenv.errors import InputError
from parkenv.files.spec_file import nearest


def schemas() -> dict[str, dict[str, Any]]:
    """Return the schema of each kind of file, made from the models that validate it."""
    from parkenv.evaluation.experiments import spec as specs
    from parkenv.scenarios.spec import ScenarioSpec

    models: dict[str, type[BaseModel]] = {
        "scenario": ScenarioSpec,
        "compare": specs.ExperimentSpec,
        "benchmark": specs.BenchmarkSpec,
        "survey": specs.SurveySpec,
        "demo": specs.DemoSpec,
        "train": specs.TrainingSpec,
    }
    draft = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return {kind: draft | model.model_json_schema() for kind, model in models.items()}


def schema(
    kind: Annotated[
        str | None,
        typer.Argument(help="scenario, compare, benchmark, survey, demo or train; all with --out."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for all schemas, KIND.schema.json.")
    ] = None,
) -> None:
    """Print the JSON schema of a kind of file, or write all schemas; editors use them to check and complete files.

    Examples:
    * `parkenv schema scenario`

    * `parkenv schema --out docs/schemas`
    """
    made = schemas()
    if kind is not None and kind not in made:
        raise InputError(f"KIND is {kind!r}; {nearest(kind, made)}")
    if out is not None:
        from parkenv.evaluation.experiments.results import make_folder

        make_folder(out)
        for name, content in made.items():
            (out / f"{name}.schema.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    else:
        typer.echo(json.dumps(made[kind or "scenario"], indent=1))
