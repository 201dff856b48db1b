"""What of a run can be repeated for its report: searches, survey drives and days with many cars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from parkenv.mapping.survey import SurveySettings
    from parkenv.studies.fleet.study import FleetStudy
    from parkenv.world.scenario import Scenario


@dataclass(frozen=True, eq=False)
class Replays:
    """The searches, survey drives and days of a run.

    Attributes:
        searches: cases with the seeds of their searches.
        survey: scenario and settings of the drives.
        sessions: number of drives.
        fleet: the study of many cars.
    """

    searches: Sequence[tuple[Any, Sequence[int]]] = ()
    survey: tuple[Scenario, SurveySettings] | None = None
    sessions: int = 0
    fleet: FleetStudy | None = None
