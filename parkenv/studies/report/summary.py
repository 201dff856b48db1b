"""What a report needs of `summary.json`, by the kind of run."""

from __future__ import annotations

from typing import Annotated, Any, Self, Union

from pydantic import Field, model_validator

from parkenv.files.known_names import KnowledgeName
from parkenv.files.spec_file import Several, Spec

Number = float | None
Ends = Annotated[tuple[Number, Number], Field(strict=False)]


# A row holds rows. The oldest pydantic wants the name before the class.
Cell = Union[Number, bool, str, list[Union[Number, "SummaryRow"]], "SummaryRow"]


class SummaryRow(Spec, extra="allow"):
    """A row of a table: numbers, texts, lists of numbers, and rows in rows."""

    __pydantic_extra__: dict[str, Cell]

    scenario: str = ""
    agent: str = ""
    seed: int = Field(0, ge=0, le=10**15)
    total_s: Number = None

    @model_validator(mode="after")
    def _intervals(self) -> Self:
        for name, value in (self.model_extra or {}).items():
            if name.endswith("_ci95"):
                if not (isinstance(value, list) and len(value) == 2) or any(
                    isinstance(v, Spec) for v in value
                ):
                    raise ValueError(f"{name} to be the two ends of an interval")
            elif isinstance(value, list) and None in value:
                raise ValueError(f"{name} to hold no null")
        return self


SummaryRow.model_rebuild()


class _ComparisonRow(SummaryRow):
    scenario: str
    agent: str
    failure_cost_s: float
    v_walk_kmh: float
    v_drive_kmh: float
    total_s: float
    total_s_ci95: Ends
    bound_s: float


class _FleetRow(SummaryRow):
    scenario: str
    agents: str
    knows: KnowledgeName
    share: float
    arrivals_per_hour: float
    total_s: Number
    occupancy: float
    balked_fraction: float
    price_of_anarchy: Number
    price_of_anarchy_ci95: Ends


class _ReachRow(SummaryRow):
    weather: str


class _SurveyRow(SummaryRow):
    sessions: int
    slots: int
    car_detection_rate: float
    slot_accuracy: float
    by_weather: dict[str, SummaryRow] = Field(default_factory=dict)
    detection_by_distance: Several[_ReachRow] = ()


class _TrainingRow(SummaryRow):
    scenario: str
    seed: int = Field(ge=0, le=10**15)

    @model_validator(mode="after")
    def _measured(self) -> Self:
        if not {"total_s", "success"} & self.model_fields_set | (
            {"success"} & (self.model_extra or {}).keys()
        ):
            raise ValueError("total_s or success")
        return self


class _CurveRow(SummaryRow):
    steps: Any


_Curves = Several[_CurveRow] | dict[str, Several[_CurveRow]]


class Summary(Spec, extra="allow"):
    """Content of `summary.json`."""

    command: Several[str] = Field(min_length=2)
    version: str
    seed: int | None = None
    rows: Several[SummaryRow]
    transfer: Several[SummaryRow] = ()
    planners: Several[SummaryRow] = ()
    weeks: Several[SummaryRow] = ()
    occupancy_rows: Several[SummaryRow] = ()
    survey: _SurveyRow | None = None
    curve: _Curves = ()
    evaluated: dict[str, Number] = Field(default_factory=dict)
    beside: dict[str, _Curves] = Field(default_factory=dict)


class _ComparisonSummary(Summary):
    rows: Several[_ComparisonRow]


class _DemoSummary(_ComparisonSummary):
    survey: _SurveyRow


class _FleetSummary(Summary):
    rows: Several[_FleetRow]


class _SurveySummary(Summary):
    rows: Several[_SurveyRow] = Field(min_length=1)


class _TrainingSummary(Summary):
    rows: Several[_TrainingRow] = Field(min_length=1)


SUMMARIES: dict[str, type[Summary]] = {
    "compare": _ComparisonSummary,
    "demo": _DemoSummary,
    "fleet": _FleetSummary,
    "survey": _SurveySummary,
    "train": _TrainingSummary,
}
"""What the summary of a kind of run has to hold; any other is a `Summary`."""
