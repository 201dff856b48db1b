"""The lines along which cars drive on the lanes of a lot, and where the drive graph's vertices lie on them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.world.drive_graph import LANE_OFFSET, NODE_TOLERANCE
from parkenv.world.lot import ParkingLot

FloatArray = NDArray[np.float64]

KEPT_RIGHT_M = 1.0
"""m, of a car's middle from that of a two-way lane: nearer than the graph's vertices, so that right turns succeed."""

_ON_LINE = 0.05  # m
_DIFFERS = 1.0  # m, by which a way along a line around bends may differ from the edge's length


@dataclass(frozen=True, eq=False)
class DrivenLine:
    """One direction of a lane: the line that cars keep to, right of the middle where the lane is two-way.

    Args:
        points: (k, 2) m, in the order driven.
    """

    points: FloatArray
    station: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        step = np.hypot(*np.diff(self.points, axis=0).T)
        object.__setattr__(self, "station", np.r_[0.0, np.cumsum(step)])

    @property
    def length(self) -> float:
        """Its length, m."""
        return float(self.station[-1])

    @cached_property
    def _shape(self) -> shapely.LineString:
        return shapely.LineString(self.points)

    def pose(self, station: float) -> FloatArray:
        """(3,) x, y in m and yaw in rad at a station, m; straight on before its start and beyond its end."""
        k = int(np.clip(np.searchsorted(self.station, station, side="right") - 1, 0, len(self.points) - 2))
        step = self.points[k + 1] - self.points[k]
        along = step / np.hypot(*step)
        xy = self.points[k] + (station - self.station[k]) * along
        return np.array([*xy, math.atan2(along[1], along[0])])

    def station_of(self, xy: FloatArray) -> float:
        """The station, m, of the point of the line, straight on at both ends, that is nearest to a point, (2,) m."""
        station = float(self._shape.line_locate_point(shapely.Point(xy)))
        if 0.0 < station < self.length:
            return station
        x, y, yaw = self.pose(station).tolist()
        beyond = math.cos(yaw) * (float(xy[0]) - x) + math.sin(yaw) * (float(xy[1]) - y)
        return station + float(min(beyond, 0.0) if station <= 0.0 else max(beyond, 0.0))

    def between(self, start: float, end: float) -> FloatArray:
        """The part from one station to a later one, (k, 2) m."""
        inner = self.points[(self.station > start + 1e-6) & (self.station < end - 1e-6)]
        return np.concatenate([self.pose(start)[None, :2], inner, self.pose(end)[None, :2]])


@dataclass(frozen=True, eq=False)
class DrivenEdge:
    """An edge of the drive graph on the ground.

    Args:
        line: which of `DrivenLines.lines` it leads along, or onto.
        start: station on it where the edge begins, m; that of `end` where the edge leads across the lane.
        end: station on it where the edge ends, m.
        across: whether it leads across a two-way lane, to who drives the other way.
    """

    line: int
    start: float
    end: float
    across: bool


class DrivenLines:
    """All lines of a lot.

    Args:
        lot: the lot.

    Attributes:
        lines: of each lane the way along its points, and of two-way ones the way back.
    """

    def __init__(self, lot: ParkingLot) -> None:
        self._lot = lot
        self._centers: list[FloatArray] = []
        self.lines: list[DrivenLine] = []
        for lane in lot.lanes:
            for points in (lane.points,) if lane.oneway else (lane.points, lane.points[::-1]):
                self._centers.append(points)
                self.lines.append(DrivenLine(_beside(points, 0.0 if lane.oneway else KEPT_RIGHT_M)))
        self._aside = np.array([abs(LANE_OFFSET - KEPT_RIGHT_M) * (not lane.oneway) for lane in lot.lanes])
        self._aside = np.repeat(self._aside, [1 if lane.oneway else 2 for lane in lot.lanes])
        self._middles = np.array([shapely.LineString(points) for points in self._centers])
        self._sides = np.array([shapely.LineString(line.points) for line in self.lines])
        self._stations: dict[int, list[tuple[int, float]]] = {}

    def edge(self, source: int, target: int, length: float) -> DrivenEdge:
        """The edge between two vertices.

        Args:
            source: vertex where it begins.
            target: vertex where it ends.
            length: m, that the graph gives it.

        Raises:
            InputError: no line leads to the target.
        """
        ends = self._on_lines(target)
        along = [
            (abs(end - start - length), line, start, end)
            for line, start in self._on_lines(source)
            for other, end in ends
            if other == line and end > start
        ]
        if along:
            differs, line, start, end = min(along)
            if differs <= _DIFFERS:
                return DrivenEdge(line, start, end, across=False)
        if not ends:
            raise InputError(f"lot {self._lot.name!r}: vertex {target} lies on no lane")
        line, end = ends[0]
        return DrivenEdge(line, end, end, across=True)

    def at(self, vertex: int) -> tuple[int, float]:
        """The line on which a slot's vertex lies, and the station there, m."""
        heading = self._lot.vertex_yaw[vertex]
        return max(
            self._on_lines(vertex), key=lambda at: math.cos(self.lines[at[0]].pose(at[1])[2] - heading)
        )

    def _on_lines(self, vertex: int) -> list[tuple[int, float]]:
        """Where a vertex lies: lines, and stations on them."""
        if vertex not in self._stations:
            lot = self._lot
            xy = lot.vertex_xy[vertex]
            point = shapely.Point(xy)
            if vertex < lot.n_slots:
                near = np.flatnonzero(
                    np.abs(shapely.distance(self._sides, point) - self._aside) < _ON_LINE
                ).tolist()
                heading = lot.vertex_yaw[vertex]
                found = [(k, self.lines[k].station_of(xy)) for k in near]
                found = [at for at in found if math.cos(self.lines[at[0]].pose(at[1])[2] - heading) > 0.7]
            else:
                found = []
                for k in np.flatnonzero(shapely.distance(self._middles, point) < 2 * NODE_TOLERANCE).tolist():
                    found += [(k, station) for station in self._abeam(k, xy)]
            self._stations[vertex] = found
        return self._stations[vertex]

    def _abeam(self, k: int, xy: FloatArray) -> list[float]:
        """Stations of line k abeam of a point of its lane's middle; two where the lane comes back to its start."""
        line, center = self.lines[k], self._centers[k]
        ends = [
            station
            for station, end in ((0.0, center[0]), (line.length, center[-1]))
            if np.hypot(*(end - xy)) < 2 * NODE_TOLERANCE
        ]
        return ends or [line.station_of(xy)]


def _beside(points: FloatArray, offset: float) -> FloatArray:
    """A polyline, (k, 2) m, `offset` m to the right of another."""
    step = np.diff(points, axis=0)
    along = step / np.hypot(step[:, 0], step[:, 1])[:, None]
    right = np.stack([along[:, 1], -along[:, 0]], axis=1)
    normal = np.concatenate([right[:1], right[:-1] + right[1:], right[-1:]])
    # The bisector of a corner is stretched so that both sides keep their distance.
    scale = np.r_[1.0, 2.0 / np.maximum((normal[1:-1] ** 2).sum(axis=1), 0.5), 1.0]
    beside: FloatArray = points + offset * scale[:, None] * normal
    return beside
