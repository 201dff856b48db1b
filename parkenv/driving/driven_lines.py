"""The lines that cars follow on the lanes of a lot, and the positions of the drive graph's vertices on them."""

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.world.drive_graph import LANE_OFFSET, NODE_TOLERANCE
from parkenv.world.lot import ParkingLot

# Offset of a car from the centre of a two-way lane, m: less than that of the graph's vertices, for right turns.
KEPT_RIGHT_M = 1.0

_ON_LINE = 0.05  # m
_LENGTH_TOLERANCE = 1.0  # m, between the length along a line with bends and that of the edge


@dataclass(frozen=True, eq=False)
class DrivenLine:
    """One direction of a lane: the line that cars follow, right of the middle on a two-way lane."""

    points: FloatArray  # (k, 2) m, in driving order
    station: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        step = np.hypot(*np.diff(self.points, axis=0).T)
        object.__setattr__(self, "station", np.r_[0.0, np.cumsum(step)])

    @property
    def length(self) -> float:
        return float(self.station[-1])

    @cached_property
    def _shape(self) -> shapely.LineString:
        return shapely.LineString(self.points)

    def pose(self, station: float) -> FloatArray:
        """Pose, (3,) x, y in m and yaw in rad, at a station, m; extrapolated straight beyond both ends."""
        k = int(np.clip(np.searchsorted(self.station, station, side="right") - 1, 0, len(self.points) - 2))
        step = self.points[k + 1] - self.points[k]
        along = step / np.hypot(*step)
        xy = self.points[k] + (station - self.station[k]) * along
        return np.array([*xy, math.atan2(along[1], along[0])])

    def station_of(self, xy: FloatArray) -> float:
        """Station, m, of the point nearest to `xy`, (2,) m, on the line extended straight at both ends."""
        station = float(self._shape.line_locate_point(shapely.Point(xy)))
        if 0.0 < station < self.length:
            return station
        x, y, yaw = self.pose(station).tolist()
        beyond = math.cos(yaw) * (float(xy[0]) - x) + math.sin(yaw) * (float(xy[1]) - y)
        return station + float(min(beyond, 0.0) if station <= 0.0 else max(beyond, 0.0))

    def between(self, start: float, end: float) -> FloatArray:
        """The part between two stations, start < end, (k, 2) m."""
        inner = self.points[(self.station > start + 1e-6) & (self.station < end - 1e-6)]
        return np.concatenate([self.pose(start)[None, :2], inner, self.pose(end)[None, :2]])


@dataclass(frozen=True, eq=False)
class DrivenEdge:
    """An edge of the drive graph as part of a driven line."""

    line: int  # index in `DrivenLines.lines` of the line that it follows, or leads to
    start: float  # station of its start, m; equal to `end` where the edge crosses the lane
    end: float  # station of its end, m
    across: bool  # whether it crosses a two-way lane to the line of the opposite direction


class DrivenLines:
    """All driven lines of a lot: each lane in the order of its points, two-way lanes also in reverse order."""

    def __init__(self, lot: ParkingLot) -> None:
        self._lot = lot
        self._centers: list[FloatArray] = []
        self.lines: list[DrivenLine] = []
        for lane in lot.lanes:
            offset = 0.0 if lane.oneway else lot.side * KEPT_RIGHT_M
            for points in (lane.points,) if lane.oneway else (lane.points, lane.points[::-1]):
                self._centers.append(points)
                self.lines.append(DrivenLine(_offset_line(points, offset)))
        self._aside = np.array([abs(LANE_OFFSET - KEPT_RIGHT_M) * (not lane.oneway) for lane in lot.lanes])
        self._aside = np.repeat(self._aside, [1 if lane.oneway else 2 for lane in lot.lanes])
        self._middles = np.array([shapely.LineString(points) for points in self._centers])
        self._sides = np.array([shapely.LineString(line.points) for line in self.lines])
        self._stations: dict[int, list[tuple[int, float]]] = {}

    def edge(self, source: int, target: int, length: float) -> DrivenEdge:
        """Find the edge between two vertices; `length` is its length in the graph, m."""
        ends = self._on_lines(target)
        along = [
            (abs(end - start - length), line, start, end)
            for line, start in self._on_lines(source)
            for other, end in ends
            if other == line and end > start
        ]
        if along:
            differs, line, start, end = min(along)
            if differs <= _LENGTH_TOLERANCE:
                return DrivenEdge(line, start, end, across=False)
        if not ends:
            raise InputError(f"lot {self._lot.name!r}: vertex {target} lies on no lane")
        line, end = ends[0]
        return DrivenEdge(line, end, end, across=True)

    def at(self, vertex: int) -> tuple[int, float]:
        """Return the line index of a slot's vertex, and its station on that line, m."""
        heading = self._lot.vertex_yaw[vertex]
        return max(
            self._on_lines(vertex), key=lambda at: math.cos(self.lines[at[0]].pose(at[1])[2] - heading)
        )

    def _on_lines(self, vertex: int) -> list[tuple[int, float]]:
        if vertex not in self._stations:
            lot = self._lot
            xy = lot.vertex_xy[vertex]
            point = shapely.Point(xy)
            if vertex < lot.n_slots:
                away = np.abs(shapely.distance(self._sides, point) - self._aside)
                near = np.flatnonzero(away < _ON_LINE).tolist()
                heading = lot.vertex_yaw[vertex]
                places = [(k, self.lines[k].station_of(xy)) for k in near]
                places = [at for at in places if math.cos(self.lines[at[0]].pose(at[1])[2] - heading) > 0.7]
            else:
                near = np.flatnonzero(shapely.distance(self._middles, point) < 2 * NODE_TOLERANCE).tolist()
                places = [(k, station) for k in near for station in self._stations_near(k, xy)]
            self._stations[vertex] = places
        return self._stations[vertex]

    def _stations_near(self, k: int, xy: FloatArray) -> list[float]:
        """Stations on line k of a point on its lane's centre line; two where the lane is closed."""
        line, center = self.lines[k], self._centers[k]
        ends = [
            station
            for station, end in ((0.0, center[0]), (line.length, center[-1]))
            if np.hypot(*(end - xy)) < 2 * NODE_TOLERANCE
        ]
        return ends or [line.station_of(xy)]


def _offset_line(points: FloatArray, offset: float) -> FloatArray:
    """Offset a polyline, (k, 2) m, by `offset` m to the right."""
    step = np.diff(points, axis=0)
    along = step / np.hypot(step[:, 0], step[:, 1])[:, None]
    right = np.stack([along[:, 1], -along[:, 0]], axis=1)
    normal = np.concatenate([right[:1], right[:-1] + right[1:], right[-1:]])
    # The bisector of a corner is lengthened so that both sides keep their distance.
    scale = np.r_[1.0, 2.0 / np.maximum((normal[1:-1] ** 2).sum(axis=1), 0.5), 1.0]
    beside: FloatArray = points + offset * scale[:, None] * normal
    return beside
