"""Made car parks as outlines of parking spaces, in the form in which overpass-turbo exports them."""

import json

import numpy as np

from parkenv.lots.local_frame import LocalFrame

FRAME = LocalFrame(lon=4.4, lat=52.1)


def row(start, heading_deg, n, *, size=(5.0, 2.5), angle_deg=90.0, bend=0.0):
    """Corners, (n, 4, 2) m, of spaces to the left of a line, at an angle to it; `bend` turns it by degrees a space."""
    length, width = size
    at, heading = np.array(start, dtype=float), np.radians(heading_deg)
    spaces = []
    for _ in range(n):
        along = np.array([np.cos(heading), np.sin(heading)])
        left, angle = np.array([-along[1], along[0]]), np.radians(angle_deg)
        nose = length * (np.cos(angle) * along + np.sin(angle) * left)
        pitch = width / np.sin(angle) * along
        spaces.append([at, at + pitch, at + pitch + nose, at + nose])
        at = at + pitch
        heading += np.radians(bend)
    return np.array(spaces)


def kerb(start, heading_deg, n, size=(6.0, 2.1)):
    """Corners, (n, 4, 2) m, of spaces end to end on the left of a line."""
    return row(start, heading_deg, n, size=(size[1], size[0]))


def double_row(n=8):
    """Two aisles of 6 m with a double row between them."""
    return [
        row((n * 2.5, 0.0), 180.0, n),
        row((0.0, 6.0), 0.0, n),
        row((n * 2.5, 16.0), 180.0, n),
        row((0.0, 22.0), 0.0, n),
    ]


def document(rows, *, turned_deg=0.0, moved=(0.0, 0.0), more=(), frame=FRAME):
    """A FeatureCollection of rows of spaces, turned and moved, m; `more` are further features' tags and lines."""
    turn = np.radians(turned_deg)
    matrix = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])

    def lonlat(points):
        return frame.to_lonlat(np.asarray(points) @ matrix + moved).round(8).tolist()

    corners = np.concatenate(rows)
    features = [
        feature(k + 1, {"amenity": "parking_space"}, "Polygon", [lonlat(space[[0, 1, 2, 3, 0]])])
        for k, space in enumerate(corners)
    ]
    for k, (tags, points) in enumerate(more):
        points = np.asarray(points, dtype=float)
        shape = "Point" if points.ndim == 1 else "LineString"
        placed = lonlat(points.reshape(-1, 2))
        if shape == "Point":
            placed = placed[0]
        elif "building" in tags:
            shape, placed = "Polygon", [placed]
        features.append(feature(10_000 + k, tags, shape, placed))
    return {"type": "FeatureCollection", "features": features}


def feature(number, tags, shape, coordinates):
    kind = "node" if shape == "Point" else "way"
    name = f"{kind}/{number}"
    return {
        "type": "Feature",
        "id": name,
        "properties": {"@id": name, **tags},
        "geometry": {"type": shape, "coordinates": coordinates},
    }


def write(path, made):
    path.write_text(json.dumps(made), encoding="utf-8")
    return path
