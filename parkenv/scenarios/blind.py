"""Scenarios in which slots are not observed before a parking attempt."""

from __future__ import annotations

from parkenv.world.scenario import Scenario
from parkenv.world.sensor_model import SensorModel

BLIND = "-blind"
"""Suffix of the names of these scenarios."""


def blind_scenario(scenario: Scenario) -> Scenario:
    """Return a renamed scenario in which slots are not observed before a parking attempt."""
    return scenario.replace(name=f"{scenario.name}{BLIND}", sensor_model=SensorModel.blind())
