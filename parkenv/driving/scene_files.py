"""Read scenes of manoeuvres from files: TPCAP's CSV, ParkBench's JSON, and our own TOML and JSON.

Files are recognised by their content. Coordinates of a scene are relative to its start, see `Scene.origin`.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, Strict

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.road_users import Crossing
from parkenv.driving.scene import MAX_POINTS, Contour, Scene, outlines_without
from parkenv.driving.vehicle import TPCAP, VEHICLES, VehicleParameters
from parkenv.errors import InputError, naming, nearest
from parkenv.files.limited_reading import is_there, parse_json, read_text, read_toml
from parkenv.files.spec_file import Several, Spec, read_tables

# Suffixes of the files that are read in a folder of scenes.
SCENE_SUFFIXES = (".csv", ".json", ".toml")
PARKBENCH_STEP_M = 0.1  # distance of the points into which ParkBench divides its lines


def vehicle_of(given: object, folder: str | Path = ".") -> VehicleParameters:
    """Return a car by its name in `VEHICLES`, from a file or a table; missing values are the default car's."""
    if isinstance(given, VehicleParameters):
        return given
    if isinstance(given, str | Path):
        if str(given) in VEHICLES:
            return VEHICLES[str(given)]
        path = Path(folder) / Path(given).expanduser()
        if not is_there(path):
            raise InputError(
                f"vehicle is {str(given)!r:.60}, want {', '.join(VEHICLES)} or a file (.toml, .json)"
            )
        with naming(path):
            return vehicle_of(read_tables(path))
    if not isinstance(given, Mapping):
        raise InputError(f"vehicle is {given!r:.60}, want a name, a file or a table")
    known = [field.name for field in dataclasses.fields(VehicleParameters)]
    for name in given:
        if name not in known:
            raise InputError(f"vehicle: unknown key {name!r:.60}; {nearest(str(name), known)}")
    return VehicleParameters(**given)


_Point = Annotated[tuple[float, float], Strict(False)]
_Bounds = Annotated[tuple[float, float, float, float], Strict(False)]
_Pose = Annotated[
    tuple[float, float, float], Strict(False), Field(description="x, y in m and yaw in rad of the rear axle.")
]


class ObstacleSpec(Spec):
    """An obstacle of a scene: a polygon or a line, m."""

    polygon: Several[_Point] | None = Field(None, min_length=3, description="Corners of a simple polygon.")
    line: Several[_Point] | None = Field(None, min_length=2, description="Points of a line, such as a kerb.")


class CrossingSpec(Spec):
    """A road user that crosses a scene on a straight line; it waits for a car in its way."""

    kind: Literal["pedestrian", "car"]
    way: Annotated[Several[_Point], Field(min_length=2, max_length=2, description="Start and end, m.")]
    speed_mps: float = Field(1.3, description="Its speed, m/s.")
    begins_s: float = Field(0.0, description="Start time, s.")


class SceneSpec(Spec):
    """A scene in a file of our own."""

    start: _Pose
    target: _Pose
    vehicle: Any = Field(None, description="The car: a name, a file, or a table.")
    bounds: _Bounds | None = Field(
        None, description="Smallest x and y and largest x and y that the car may reach, m."
    )
    obstacles: Several[ObstacleSpec] = Field((), description="Obstacles that the car must not touch.")
    crossings: Several[CrossingSpec] = Field((), description="Road users.")


def scene_files(path: str | Path) -> list[Path]:
    """Return a scene file, or those in a folder in the order of their names."""
    path = Path(path)
    if not is_there(path):
        raise InputError(f"{path}: is not there, want a scene file or a folder with some")
    if not path.is_dir():
        return [path]
    files = sorted((f for f in path.iterdir() if f.suffix.lower() in SCENE_SUFFIXES), key=_by_number)
    names = [file.stem for file in files]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{path}: has two scenes named {name!r}, want different names")
    if not files:
        raise InputError(f"{path}: has no scene file ({', '.join(SCENE_SUFFIXES)})")
    return files


def read_scene(path: str | Path, vehicle: VehicleParameters | None = None) -> Scene:
    """Read the scene of a file; without a vehicle, the car is that of the file or of its format."""
    path = Path(path)
    with naming(path):
        if path.suffix.lower() == ".toml":
            return _own(read_toml(path), path, vehicle)
        text = read_text(path)
        if not text.lstrip().startswith("{"):
            return _tpcap(text, path.stem, vehicle)
        content = parse_json(text, str(path), finite=True)
        if "Frames" in content:
            return _parkbench(content, path.stem, vehicle)
        return _own(content, path, vehicle)


def _scene(
    name: str,
    vehicle: VehicleParameters,
    start: Sequence[float],
    target: Sequence[float],
    contours: Sequence[Contour],
    bounds: Sequence[float] | None = None,
) -> Scene:
    """Make a scene with the origin at the start, rounded to metres."""
    origin = np.round(np.array(start[:2]))
    whole = np.array([*origin, 0.0])
    inside = None if bounds is None else tuple((np.array(bounds) - np.tile(origin, 2)).tolist())
    moved = tuple(Contour(points - origin, closed) for points, closed in contours)
    return Scene(name, vehicle, np.array(start) - whole, np.array(target) - whole, moved, inside, origin)


def _tpcap(text: str, name: str, vehicle: VehicleParameters | None) -> Scene:
    """Read start, target, number of obstacles, numbers of their corners, and corners: numbers in any lines."""
    words = text.replace(",", " ").split()
    if len(words) > 4 * MAX_POINTS:
        raise InputError(f"has {len(words):,} numbers, want at most {4 * MAX_POINTS:,}")
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise InputError(
            "is no scene: want numbers as TPCAP's CSV has them, ParkBench's JSON, or our TOML or JSON"
        ) from None
    if not np.isfinite(values).all():
        raise InputError(f"number {int(np.argmin(np.isfinite(values))) + 1} is not finite")
    n = int(values[6]) if len(values) > 6 and 0 <= values[6] <= len(values) - 7 else -1
    counts = values[7 : 7 + max(n, 0)].astype(np.int64)
    if n < 0 or (counts < 0).any() or 7 + n + 2 * counts.sum() != len(values):
        raise InputError(
            f"has {len(values)} numbers, want start and target (x, y, yaw), the number of obstacles, the corners "
            "of each, and x and y of every corner"
        )
    corners = np.split(values[7 + n :].reshape(-1, 2), np.cumsum(counts)[:-1]) if n else []
    contours = [Contour(_opened(points)) for points in corners]
    return _scene(name, vehicle or TPCAP, values[:3].tolist(), values[3:6].tolist(), contours)


def _parkbench(content: Mapping[str, Any], name: str, vehicle: VehicleParameters | None) -> Scene:
    """Read a scene of ParkBench, in the frame of its obstacles; its poses are in that of the request."""
    try:
        frame = next(iter(content["Frames"].values()))
        request = frame["PlanningRequest"]
        area = request.get("m_targetArea") or request["m_targetAreas"]
        target = area["m_targetPosture"]
        target = target[0] if isinstance(target, list) else target
        offset = np.subtract(request.get("m_origin", (0.0, 0.0)), frame.get("m_nfmOrigin", (0.0, 0.0)))
        start, goal = (
            np.array(pose["m_pose"], dtype=np.float64) + np.append(offset, 0.0)
            for pose in (request["m_startPosture"], target)
        )
        nodes = [each.get("nfmPolygonObjectNodes", ()) for each in frame["NfmAggregatedPolygonObjects"]]
        if sum(map(len, nodes)) > MAX_POINTS:
            raise InputError(f"has {sum(map(len, nodes)):,} points of obstacles, want at most {MAX_POINTS:,}")
        lines = [
            np.array([(n["m_x"], n["m_y"]) for n in each], np.float64) for each in nodes if len(each) > 1
        ]
    except InputError:
        raise
    except (AttributeError, IndexError, KeyError, StopIteration, TypeError, ValueError) as error:
        raise InputError(f"is no scene of ParkBench: {type(error).__name__} {error}") from error
    car = vehicle or TPCAP  # the file names no car
    # The benchmark drops obstacle points in the footprint of the parked car, such as wheel stops.
    contours = outlines_without(lines, goal, car, PARKBENCH_STEP_M)
    return _scene(name, car, start.tolist(), goal.tolist(), contours)


def _own(content: Mapping[str, Any], path: Path, vehicle: VehicleParameters | None) -> Scene:
    spec = SceneSpec.parse(content, "", path.parent)
    if spec.bounds and not (spec.bounds[0] < spec.bounds[2] and spec.bounds[1] < spec.bounds[3]):
        raise InputError(f"bounds is {list(spec.bounds)}, want smallest x and y, then largest x and y")
    contours = []
    for i, each in enumerate(spec.obstacles):
        if (each.polygon is None) == (each.line is None):
            raise InputError(f"obstacles.{i} is {each.tables()!r:.60}, want a polygon or a line")
        points = np.array(each.polygon or each.line)
        contours.append(Contour(_opened(points)) if each.polygon else Contour(points, closed=False))
    given = VehicleParameters() if spec.vehicle is None else vehicle_of(spec.vehicle, path.parent)
    scene = _scene(path.stem, vehicle or given, spec.start, spec.target, contours, spec.bounds)
    crossings = []
    for user in spec.crossings:
        crossing = Crossing(
            user.kind, (user.way[0], user.way[1]), user.speed_mps, user.begins_s
        )  # checked as in the file
        start, end = (tuple((np.array(point) - scene.origin).tolist()) for point in user.way)
        crossings.append(dataclasses.replace(crossing, way=(start, end)))
    return dataclasses.replace(scene, crossings=tuple(crossings))


def _opened(points: FloatArray) -> FloatArray:
    """Drop the last corner of a closed polygon, and corners that repeat the one before."""
    fresh = np.ones(len(points), dtype=np.bool_)
    fresh[1:] = (np.diff(points, axis=0) != 0.0).any(axis=1)
    points = points[fresh]
    return points[:-1] if len(points) > 3 and (points[0] == points[-1]).all() else points


def _by_number(path: Path) -> tuple[str, float, str]:
    """Sort Case2 before Case10."""
    digits = path.stem[len(path.stem.rstrip("0123456789")) :]
    return path.stem.removesuffix(digits), float(digits) if digits else -math.inf, path.name
