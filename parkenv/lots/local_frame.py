"""Local metric frames: metres east and north of a geographic point."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import ArrayLike

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, with_extra

if TYPE_CHECKING:
    from pyproj import Proj


@dataclass(frozen=True)
class LocalFrame:
    """An azimuthal equidistant projection: distances and bearings from its centre are exact.

    Examples:
        >>> frame = LocalFrame(lon=7.85, lat=48.0)
        >>> frame.to_xy([[7.85, 48.0]]).round(3).tolist()
        [[0.0, 0.0]]
    """

    lon: float  # longitude of the centre, degrees, WGS 84
    lat: float  # latitude of the centre, degrees
    # m, what the centre is called; of a file in metres, whose own numbers stay the lot's
    origin: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not (abs(self.lon) <= 360.0 and abs(self.lat) <= 90.0):
            raise InputError(f"frame at longitude {self.lon}, latitude {self.lat}: not on the globe")

    @classmethod
    def around(cls, lonlat: ArrayLike) -> Self:
        """Return the frame centred on positions, (n, 2) degrees, longitude first; n ≥ 1."""
        lon, lat = np.asarray(lonlat, dtype=np.float64).T
        if np.ptp(lon) > 180.0:
            lon = np.where(lon < 0.0, lon + 360.0, lon)  # positions on both sides of the date line
        return cls(float(lon.min() + lon.max()) / 2, float(lat.min() + lat.max()) / 2)

    def to_xy(self, lonlat: ArrayLike) -> FloatArray:
        """Convert positions, (n, 2) degrees, longitude first, to metres east and north, (n, 2)."""
        lon, lat = np.asarray(lonlat, dtype=np.float64).reshape(-1, 2).T
        return np.column_stack(self._projection(lon, lat)) + (self.origin or (0.0, 0.0))

    def to_lonlat(self, xy: ArrayLike) -> FloatArray:
        """Convert points, (n, 2) m, to positions, (n, 2) degrees, longitude first."""
        x, y = (np.asarray(xy, dtype=np.float64).reshape(-1, 2) - (self.origin or (0.0, 0.0))).T
        return np.column_stack(self._projection(x, y, inverse=True))

    def __str__(self) -> str:
        return (
            "metres as in the file"
            if self.origin
            else f"metres east and north of {self.lat:.7f}, {self.lon:.7f}"
        )

    @cached_property
    def _projection(self) -> Proj:
        with with_extra("longitude and latitude", "osm"):
            from pyproj import Proj

        return Proj(proj="aeqd", lon_0=self.lon, lat_0=self.lat, ellps="WGS84")
