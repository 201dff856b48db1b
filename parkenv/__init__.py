"""Search for a free parking space: Gymnasium environments, a perception stack, and planners as baselines.

Importing this package registers the environments; heavy modules are loaded on first use.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

from parkenv.files.command_process import end_on_signals, is_command

if is_command():
    end_on_signals()  # before everything that takes time

from gymnasium.envs.registration import register, registry

from parkenv.version import __version__ as __version__

if TYPE_CHECKING:
    from parkenv.engine.model import model
    from parkenv.errors import InputError
    from parkenv.lots import import_lot, load_lot
    from parkenv.scenarios.build import make_scenario, make_scenarios
    from parkenv.studies.curve.curves import load_curves
    from parkenv.studies.runner import Result, open_run
    from parkenv.studies.simulate import simulate
    from parkenv.studies.verbs import compare, curve, fleet, survey, train
    from parkenv.world.lot import Lane, Mouth, ParkingLot, Turn
    from parkenv.world.occupancy.arrival_window import ArrivalWindow
    from parkenv.world.occupancy.log import OccupancyLog
    from parkenv.world.occupancy.process import OccupancyProcess
    from parkenv.world.occupancy.recorded import RecordedOccupancy
    from parkenv.world.scenario import Scenario, SearchProblem
    from parkenv.world.sensor_model import SensorBand, SensorModel
    from parkenv.world.traffic import Traffic
    from planners.agent import make_agent

if sys.flags.safe_path:
    from parkenv.files.command_process import skip_settings

    skip_settings()

_EXPORTS = {
    name: module
    for module, names in {
        "parkenv.engine.model": ("model",),
        "parkenv.errors": ("InputError",),
        "parkenv.lots": ("import_lot", "load_lot"),
        "parkenv.scenarios.build": ("make_scenario", "make_scenarios"),
        "parkenv.studies.curve.curves": ("load_curves",),
        "parkenv.studies.runner": ("Result", "open_run"),
        "parkenv.studies.simulate": ("simulate",),
        "parkenv.studies.verbs": ("compare", "curve", "fleet", "survey", "train"),
        "parkenv.world.lot": ("Lane", "Mouth", "ParkingLot", "Turn"),
        "parkenv.world.occupancy.arrival_window": ("ArrivalWindow",),
        "parkenv.world.occupancy.log": ("OccupancyLog",),
        "parkenv.world.occupancy.process": ("OccupancyProcess",),
        "parkenv.world.occupancy.recorded": ("RecordedOccupancy",),
        "parkenv.world.scenario": ("Scenario", "SearchProblem"),
        "parkenv.world.sensor_model": ("SensorBand", "SensorModel"),
        "parkenv.world.traffic": ("Traffic",),
        "planners.agent": ("make_agent",),
    }.items()
    for name in names
}
__all__ = [
    "ArrivalWindow", "InputError", "Lane", "Mouth", "OccupancyLog", "OccupancyProcess", "ParkingLot",
    "RecordedOccupancy", "Result", "Scenario", "SearchProblem", "SensorBand", "SensorModel", "Traffic", "Turn",
    "compare", "curve", "fleet", "import_lot", "load_curves", "load_lot", "make_agent", "make_scenario",
    "make_scenarios", "model", "open_run", "simulate", "survey", "train",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        return getattr(import_module(_EXPORTS[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


for _name, _entry_point, _vector_entry_point in (
    ("parkenv/Search-v2", "parkenv.envs.search:SearchEnv", "parkenv.envs.search_vector:ParkSearchVectorEnv"),
    ("parkenv/SearchSensors-v2", "parkenv.envs.sensors:SearchSensorsEnv", None),
    ("parkenv/SearchPerception-v2", "parkenv.envs.perception:SearchPerceptionEnv", None),
):
    if _name not in registry:
        register(
            id=_name,
            entry_point=_entry_point,
            vector_entry_point=_vector_entry_point,
            max_episode_steps=2000,
            # The environments themselves check that `reset` comes first.
            order_enforce=False,
        )
if "parkenv/Drive-v1" not in registry:
    register(id="parkenv/Drive-v1", entry_point="parkenv.envs.drive:DriveEnv", max_episode_steps=600)
