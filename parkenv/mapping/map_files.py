"""Maps for other programs: the occupancy grid as Nav2's map server reads it, and the slots as GeoJSON."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.files.atomic_write import atomic_write, write_text
from parkenv.lots.formats.geojson import write_features
from parkenv.lots.local_frame import LocalFrame
from parkenv.mapping.grid import OccupancyGrid
from parkenv.mapping.inference import SessionLog, predict
from parkenv.world.lot import ParkingLot
from parkenv.world.occupancy.arrival_window import DAY_NAMES
from parkenv.world.week import DAY_S

# Grey values of cells; with `_YAML`'s thresholds, a map server reads each as what it is.
OCCUPIED, UNKNOWN, FREE = 0, 205, 254
_IS_OCCUPIED = 0.65  # P(occupied) of occupied cells; free ones are below a half
_YAML = """image: {image}
mode: trinary
resolution: {resolution:.6g}
origin: [{x:.6f}, {y:.6f}, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


def write_grid(grid: OccupancyGrid, folder: Path) -> None:
    """Write map.png and map.yaml; the picture's lower left corner is at the origin, y is upwards."""
    p = grid.probability
    free = np.where(grid.seen & (p < 0.5), FREE, UNKNOWN)
    cells = np.where(p > _IS_OCCUPIED, OCCUPIED, free).astype(np.uint8)
    with atomic_write(folder / "map.png") as beside:
        beside.write_bytes(cv2.imencode(".png", cells[::-1])[1].tobytes())
    x, y = grid.low
    write_text(folder / "map.yaml", _YAML.format(image="map.png", resolution=grid.cell, x=x, y=y))


def write_slots(
    path: Path,
    lot: ParkingLot,
    log: SessionLog,
    frame: LocalFrame | None = None,
    of_slots: Sequence[Mapping[str, Any]] = (),
    kerbs: Sequence[FloatArray] = (),
) -> None:
    """Write each slot with P(taken) at the time of the last session and when it was last in view.

    Positions are longitude and latitude with a geographic frame, else metres.
    """

    def feature(kind: str, xy: FloatArray, properties: Mapping[str, Any]) -> dict[str, Any]:
        points = np.round(xy, 3) if frame is None else np.round(frame.to_lonlat(xy), 8)
        at: Any = [points.tolist()] if kind == "Polygon" else points.tolist()
        return {
            "type": "Feature",
            "properties": {**properties},
            "geometry": {"type": kind, "coordinates": at},
        }

    predicted = predict(log, float(log.time[-1]))
    features = []
    for i, ring in enumerate(lot.slot_corners()[:, [0, 1, 2, 3, 0]]):
        seen = np.flatnonzero(log.known[:, i])
        properties = {
            "id": lot.slot_ids[i],
            "p_taken": round(float(predicted.p_occupied[i]), 3),
            "sessions": len(seen),
            "last_seen": week_time(float(log.time[seen[-1]])) if len(seen) else None,
            "last_taken": bool(log.occupied[seen[-1], i]) if len(seen) else None,
        }
        features.append(feature("Polygon", ring, properties | dict(of_slots[i] if of_slots else {})))
    features += [feature("LineString", kerb, {"kind": "kerb"}) for kerb in kerbs]
    head = {"type": "FeatureCollection", "name": lot.name} | ({"frame": "local"} if frame is None else {})
    write_features(path, head, features)


def week_time(time: float) -> str:
    """Return the weekday and the time of day of seconds since Monday 00:00."""
    day, second = divmod(round(time), DAY_S)
    return f"{DAY_NAMES[int(day) % 7]} {int(second) // 3600:02d}:{int(second) // 60 % 60:02d}"
