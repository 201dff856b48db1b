"""Names that files and commands know, without the modules behind them: help and completion need no more."""

from typing import Literal, get_args

PackagedLot = Literal["campus", "jam", "street", "mini", "town", "kerbs"]
PACKAGED_LOTS: tuple[PackagedLot, ...] = get_args(PackagedLot)
SCENARIO_NAMES = (*PACKAGED_LOTS, "rush")  # packaged scenarios; all but rush have a lot of their own
SuiteName = Literal["v3", "streets-v1"]  # benchmark suites
LOT_SUFFIXES = (".geojson", ".json", ".yml", ".yaml")  # suffixes of lot files
SensorModelName = Literal["perfect", "blind", "laser", "stereo"]
SENSOR_MODELS: tuple[SensorModelName, ...] = get_args(SensorModelName)
RigName = Literal["laser", "stereo", "both_sides", "camera"]
# Packaged detectors: hog has both HOG models, side and front; net is a network in parkenv/perception/models.
DETECTORS = ("hog", "net", "side", "front")
DETECTOR_SUFFIXES = (".npz", ".onnx")
WeatherName = Literal["sunny", "overcast", "low_sun", "dusk", "rain"]
WEATHERS: tuple[WeatherName, ...] = get_args(WeatherName)
LocaliserName = Literal["none", "scan-matching"]
# What corrects the pose of a survey's car; see `parkenv.mapping.scan_matching`.
LOCALISERS: tuple[LocaliserName, ...] = get_args(LocaliserName)
MapName = Literal["empty", "right", "wrong"]  # maps that a commute starts from
# Column `map` of the references: a right map that does not learn; an agent that uses no map.
FIXED, NONE = "fixed", "none"
# What the cars of a fleet know; see `parkenv.engine.fleet.DriverKind`.
KnowledgeName = Literal["own", "shared", "reserve", "full"]
KNOWLEDGE: tuple[KnowledgeName, ...] = get_args(KnowledgeName)
UNBEATEN = ("oracle", "bound")  # agents that compete with no other: they know what others do not
# Levels of drawn scenes with a kind of slot each, the easiest first; see `parkenv.driving.levels`.
SCENE_LEVELS = tuple(
    f"{kind}-{level}"
    for level in ("normal", "complex", "extreme", "moving")
    for kind in ("perpendicular", "oblique", "parallel")
)
MAX_CARS = 1_000_000  # maximum number of cars of a world
BackendName = Literal["loky", "ray", "dask"]
ForecastFrom = Literal["others", "rolling", "past"]
# Recorded days that a forecast is made from; see `parkenv.world.occupancy.recorded`.
FORECAST_FROM: tuple[ForecastFrom, ...] = get_args(ForecastFrom)
# When the states of a log of looks change; see `parkenv.world.occupancy.recorded`.
Changes = Literal["midway", "drawn"]
CHANGES: tuple[Changes, ...] = get_args(Changes)
# Mapping of a log whose slots have the names of the lot's, or of counts by the names of its facilities or zones.
SAME_SLOTS = "same"
# Whether the agent of a driven trip observes slots from the lane.
OBSERVED, UNOBSERVED = "observed", "unobserved"
