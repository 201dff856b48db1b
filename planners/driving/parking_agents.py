"""Parking agents of `parkenv/Drive-v1`, by name."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

from parkenv.driving.vehicle import VehicleParameters
from parkenv.errors import InputError
from planners.agent import Agent
from planners.names import ALGORITHMS, PARKING_PLANNER

if TYPE_CHECKING:
    from parkenv.driving.scene import Scene
    from planners.driving.car_path import CarPath

LEARNED, HYBRID, LEARNS = "learned", "hybrid", "maskable-ppo"
"""Planners of manoeuvres: the network that comes with the package, the same with the planner, and its algorithm."""


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


@cache
def manoeuvre_planner(name: str) -> Callable[[Scene], Iterator[CarPath]]:
    """Return what yields paths in scenes, by name.

    Args:
        name: `planner`; `learned`, or `maskable-ppo:FILE` for another model of `parkenv train --env scenes`; or
            `hybrid` or `hybrid:FILE`, where the planner plans what the network cannot.

    Raises:
        InputError: the name is unknown, or the file is not such a model.
    """
    kind, _, file = name.partition(":")
    if name == PARKING_PLANNER:
        planner: Any = import_module("planners.driving.manoeuvre").paths_in_scene
    elif kind == HYBRID or name == LEARNED or (file and kind in ALGORITHMS):
        moves = import_module("planners.driving.learned_moves")
        algorithm = LEARNS if kind in (HYBRID, LEARNED) else kind
        model = moves.LearnedPlanner.load(algorithm, file or moves.SHIPPED, finish=kind == HYBRID)
        planner = model.paths
    else:
        raise InputError(
            f"unknown agent {name!r}; known in scenes: {PARKING_PLANNER}, {LEARNED}, {HYBRID}, and {LEARNS}:FILE or "
            f"{HYBRID}:FILE for a model of `parkenv train --env scenes`"
        )
    result: Callable[[Scene], Iterator[CarPath]] = planner
    return result
