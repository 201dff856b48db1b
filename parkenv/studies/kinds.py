"""Specifications by the key `kind` of an experiment file."""

from __future__ import annotations

from parkenv.studies.spec import (
    BenchmarkSpec,
    CommuteSpec,
    DemoSpec,
    ExperimentSpec,
    FleetSpec,
    SurveySpec,
    Workplace,
)
from parkenv.studies.training.spec import TrainingSpec

SPECS: dict[str, type[Workplace]] = {
    "compare": ExperimentSpec,
    "commute": CommuteSpec,
    "fleet": FleetSpec,
    "benchmark": BenchmarkSpec,
    "survey": SurveySpec,
    "demo": DemoSpec,
    "train": TrainingSpec,
}
"""Specifications by kind; `TrainingSpec` stands for the kinds of training."""
