"""Parked cars of a drive: sightings in several captures joined to one car with one place and its error."""

from __future__ import annotations

from dataclasses import dataclass

from parkenv.compiled.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class ParkedCars:
    """The cars that a drive has passed, each once."""

    xy: FloatArray  # (n, 2) m, centres, world frame
    yaw: FloatArray  # (n,) rad, along the car, in [0, π)
    size: FloatArray  # (n, 2) m, length and width
    std: FloatArray  # (n,) m, standard deviation of the centre along each axis
    probability: FloatArray  # (n,) P(there is a car)
    sightings: IntArray  # (n,) captures in which it was located
    distance: FloatArray  # (n,) m, least distance to its nearest side
    time: FloatArray  # (n,) s, when it was nearest
