"""The demo: a survey, and searches on other days that use only its map."""

from __future__ import annotations

from typing import Any

from parkenv.files.known_names import RigName
from parkenv.mapping.inference import SessionLog
from parkenv.mapping.learned_map import map_prior
from parkenv.mapping.survey import SurveySettings
from parkenv.studies.compare.cases import Case
from parkenv.studies.sensing.surveys import survey_of
from parkenv.studies.spec import DemoSpec, SurveySpec
from parkenv.world.scenario import Scenario
from parkenv.world.sensor_model import SensorModel

AGENTS = ("mdp", "belief", "first-free", "greedy-drive", "oracle")
FILMED = "belief"
QUICK = {"sessions": 2, "episodes": 2, "every": 4.0}
"""Settings of a shorter demo."""
RIG: RigName = "laser"
_HOURS = ("08:00-09:30", "09:30-11:00", "11:00-12:30", "12:30-13:00")
_APART = 1_000_000  # offset between the seeds of survey and searches, so that their worlds differ


def demo_survey(spec: DemoSpec) -> tuple[Scenario, SurveySettings]:
    """Return the scenario of the demo and the settings of its survey.

    Raises:
        InputError: the scenario cannot be made.
    """
    survey = SurveySpec(
        scenario=spec.scenario,
        sessions=spec.sessions,
        rig=RIG,
        hours=_HOURS,
        every=spec.every,
        seed=spec.seed,
        detector=spec.detector,
    )
    return survey_of(survey)


def demo_cases(spec: DemoSpec, scenario: Scenario, log: SessionLog) -> list[tuple[Case, range]]:
    """Return the cases: every agent with the surveyed map and simulated sensors, with the seeds of its searches.

    The oracle knows which slots are taken, so it needs no sensors.

    Args:
        spec: specification of the demo.
        scenario: scenario from `demo_survey`.
        log: the sessions of the map.
    """
    prior = map_prior(log, (), scenario.lot.walk_m(scenario.goal))
    known = scenario.replace(prior=prior, sensor_model=SensorModel.named(RIG))
    seeds = range(spec.seed + _APART, spec.seed + _APART + spec.episodes)
    sensors: dict[str, Any] = {"rig": RIG, "detector": spec.detector, "every": spec.every}
    return [(Case(known, name, **({} if name == "oracle" else sensors)), seeds) for name in AGENTS]
