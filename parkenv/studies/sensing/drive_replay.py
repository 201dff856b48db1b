"""Survey drives, driven again for a report."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

from parkenv.mapping.survey import Survey, SurveySettings
from parkenv.show.report.drive_recording import record_drive
from parkenv.studies.report import Recording, ReplayJob
from parkenv.studies.report_options import ReportOptions
from parkenv.world.scenario import Scenario


class DriveReplay(NamedTuple):
    """The drives of a survey."""

    scenario: Scenario
    settings: SurveySettings
    sessions: int

    def again(self, options: ReportOptions) -> ReplayJob:
        numbers = range(min(options.sessions, self.sessions) if options.drives is None else 0)
        frames = options.frames // max(len(numbers), 1)
        return ReplayJob(
            [partial(_drive, self.scenario, self.settings, number, frames) for number in numbers]
        )


def _drive(scenario: Scenario, settings: SurveySettings, number: int, frames: int) -> Recording:
    return record_drive(Survey(scenario, settings), number, most_frames=frames)[1]
