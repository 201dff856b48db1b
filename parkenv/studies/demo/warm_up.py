"""Compile the functions of surveys and searches before many processes need them at once.

Compiled code is cached on disk, but processes that start together would all compile the same functions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from parkenv.mapping.survey import Survey, SurveySettings
from parkenv.scenarios.build import make_scenario
from parkenv.studies.compare.cases import Case
from parkenv.studies.workers import Task
from parkenv.world.scenario import Scenario
from parkenv.world.traffic import Traffic

_ONE_CAPTURE_M = 1e6


def warm_up_tasks(settings: SurveySettings, agents: Sequence[str]) -> list[Task[None]]:
    """Return two tasks: a survey of one or two captures, and one search of each agent without sensors.

    They share few functions, so two processes can run them in parallel.

    Args:
        settings: settings of the survey whose functions are needed.
        agents: names of the agents whose functions are needed.
    """
    scenario = make_scenario("mini", traffic=Traffic(cars=2, pedestrians=2))
    short = replace(settings, every=_ONE_CAPTURE_M, weather="sunny")
    return [partial(_survey, scenario, short), partial(_search, scenario, tuple(agents))]


def _survey(scenario: Scenario, settings: SurveySettings) -> None:
    Survey(scenario, settings).drive(0)


def _search(scenario: Scenario, agents: Sequence[str]) -> None:
    for name in agents:
        Case(scenario, name).run([0])
