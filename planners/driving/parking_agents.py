"""Parking agents of `parkenv/Drive-v1`, by name."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from parkenv.driving.vehicle import VehicleParameters
from parkenv.errors import InputError
from planners.agent import Agent
from planners.names import PARKING_PLANNER


def make_parking_agent(name: str, vehicle: VehicleParameters | None = None) -> Agent:
    """Make a parking agent.

    Args:
        name: `planner`, or `ALGORITHM:FILE` for a model trained by `parkenv train --env drive`, such as
            `sac:models/sac.safetensors`.
        vehicle: the car.

    Raises:
        InputError: the name is unknown, or the file is not such a model.
    """
    # Import only what is needed: the planner needs no torch.
    algorithm, colon, file = name.partition(":")
    if colon:
        agent: Any = import_module("planners.driving.learned_parking").LearnedParkingAgent(
            algorithm, file, vehicle
        )
    elif name == PARKING_PLANNER:
        agent = import_module("planners.driving.parking").ParkingAgent(vehicle)
    else:
        raise InputError(
            f"unknown agent {name!r}; known: {PARKING_PLANNER}, and ALGORITHM:FILE for a model of "
            "`parkenv train --env drive`"
        )
    result: Agent = agent
    return result
