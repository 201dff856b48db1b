"""The JSON schema of each kind of file, made from the class that validates it."""

from __future__ import annotations

from typing import Any

from pydantic import TypeAdapter

from parkenv.scenarios.spec import ScenarioSpec
from parkenv.studies.study import STUDIES, study_class

KINDS = ("scenario", *STUDIES)


def schemas() -> dict[str, dict[str, Any]]:
    """Return the schema of each kind of file."""
    from parkenv.studies.training.spec import AnyTrainingSpec

    draft = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    models: dict[str, Any] = {"scenario": ScenarioSpec}
    models |= {kind: study_class(kind) for kind in STUDIES} | {"train": AnyTrainingSpec}
    return {kind: draft | TypeAdapter(model).json_schema() for kind, model in models.items()}
