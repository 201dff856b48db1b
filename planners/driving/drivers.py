"""Who can park in `parkenv/Drive-v1`, by name."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from parkenv.driving.vehicle import VehicleParameters
from parkenv.errors import InputError
from planners.agent import Agent

PLANNER = "planner"


def make_driver(name: str, vehicle: VehicleParameters | None = None) -> Agent:
    """Make a driver.

    Args:
        name: `planner`; or `ALGORITHM:FILE` for a model of `parkenv train --env drive`, such as `sac:models/sac.zip`.
        vehicle: the car.

    Raises:
        InputError: an unknown name, or a file that is no such model.
    """
    # Named, not imported: the planner needs no torch.
    algorithm, colon, file = name.partition(":")
    if colon:
        driver: Any = import_module("planners.driving.learned_driver").LearnedDriver(algorithm, file, vehicle)
    elif name == PLANNER:
        driver = import_module("planners.driving.parking").ParkingAgent(vehicle)
    else:
        raise InputError(
            f"unknown driver {name!r}; known: {PLANNER}, and ALGORITHM:FILE for a model of `parkenv train --env drive`"
        )
    result: Agent = driver
    return result
