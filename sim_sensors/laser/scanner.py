"""Laser scanner: beams, noise, and scans of a `ScanPlane`."""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

from parkenv.compiled.arrays import Float32Array
from sim_sensors.errors import SensorError, as_floats, require_numbers
from sim_sensors.laser.footprints import NO_RETURN, ScanPlane
from sim_sensors.laser.kernel import BEAMS_PER_BLOCK, BEAMS_PER_DRAW, BeamTable, scan_all

Int32Array = NDArray[np.int32]

NOISE_TABLE_SIZE = 1 << 16


@dataclass(frozen=True)
class LaserScanner:
    """A planar laser scanner; the default is like a Hokuyo UTM-30LX: 1081 beams over 270°, 30 m.

    Beam n points along start + n·step, counter-clockwise from the sensor's x axis. A range is the distance to the
    nearest footprint or wall, or `inf` if there is none below `max_range` or the return is lost. Inside a footprint
    every beam reads 0 m. A wall is invisible to a sensor exactly on its line. The code is compiled and deterministic;
    it runs on the calling thread only and releases the interpreter lock.

    Args:
        n_beams: number of beams.
        start: angle of beam 0, rad.
        step: angle between beams, rad, above 0. All beams must lie within one turn.
        max_range: m.
        noise_sd: standard deviation of the Gaussian range noise, m. Noisy ranges stay within 0 to max_range.
        dropout: probability that a return is lost, 0 to 1, independent for each beam.

    Raises:
        SensorError: a value is out of these bounds.

    Examples:
        >>> plane = ScanPlane([[[1, -1], [2, -1], [2, 1], [1, 1]]])
        >>> LaserScanner(n_beams=3, start=-np.pi / 2, step=np.pi / 2).scan(plane, (0, 0, 0)).tolist()
        [inf, 1.0, inf]
    """

    n_beams: int = 1081
    start: float = -3 * math.pi / 4
    step: float = math.radians(0.25)
    max_range: float = 30.0
    noise_sd: float = 0.01
    dropout: float = 0.005

    def __post_init__(self) -> None:
        if (
            isinstance(self.n_beams, bool)
            or not isinstance(self.n_beams, int | np.integer)
            or self.n_beams < 1
        ):
            raise SensorError(f"n_beams is {self.n_beams!r}, want an integer of 1 or more")
        require_numbers(self, "start")
        require_numbers(self, "step max_range", above=0.0)
        require_numbers(self, "noise_sd", least=0.0)
        require_numbers(self, "dropout", least=0.0, most=1.0)
        if (self.n_beams - 1) * self.step >= 2 * math.pi:
            raise SensorError(f"step is {self.step} rad, want {self.n_beams} beams within one turn")

    @cached_property
    def angles(self) -> NDArray[np.float64]:
        """(n_beams,) float64, rad, laser frame."""
        return np.asarray(self.start + self.step * np.arange(self.n_beams), dtype=np.float64)

    @cached_property
    def _beams(self) -> BeamTable:
        number = np.arange(-(-self.n_beams // BEAMS_PER_BLOCK) * BEAMS_PER_BLOCK)
        middle = (self.n_beams - 1) / 2
        angle = (number - middle) * self.step
        u, v, b = (a.astype(np.float32) for a in (np.cos(angle), np.sin(angle), number))
        return BeamTable(u, v, b, int(self.n_beams), middle, 1 / self.step, float(self.max_range))

    @cached_property
    def beams(self) -> tuple[BeamTable, float]:
        """The beams for compiled code, and their middle direction, rad, laser frame."""
        return self._beams, float(self.start + self._beams.middle * self.step)

    def scan(
        self, plane: ScanPlane, poses: ArrayLike, rng: np.random.Generator | None = None
    ) -> Float32Array:
        """Simulate scans of one plane.

        Args:
            plane: the obstacles.
            poses: (3,) or (b, 3) x, y in m and yaw in rad of the sensor, world frame.
            rng: generator for noise and dropouts; None for exact ranges.

        Returns:
            (n_beams,) or (b, n_beams) float32, m, `inf` for no return.

        Raises:
            SensorError: poses have another shape, or one is not finite.
        """
        ranges = self._measure(plane, poses, rng, False)[0]
        return ranges if np.ndim(poses) == 2 else np.asarray(ranges[0])

    def scan_with_ids(
        self, plane: ScanPlane, poses: ArrayLike, rng: np.random.Generator | None = None
    ) -> tuple[Float32Array, Int32Array]:
        """Simulate scans; also return the id that each beam hits, int32, `WALL` (-2), or `NO_RETURN` (-1)."""
        ranges, ids = self._measure(plane, poses, rng, True)
        return (ranges, ids) if np.ndim(poses) == 2 else (ranges[0], ids[0])

    def _measure(
        self, plane: ScanPlane, poses: ArrayLike, rng: np.random.Generator | None, with_ids: bool
    ) -> tuple[Float32Array, Int32Array]:
        pose = as_floats("poses", poses, *((None, 3) if np.ndim(poses) == 2 else (3,))).reshape(-1, 3)
        b = len(pose)
        # The first offset of a pair is for the noise, the second for the dropouts.
        n_draws = 0 if rng is None else -(-self.n_beams // BEAMS_PER_DRAW)
        offsets = np.empty((b, 0, 2), np.int64)
        if rng is not None:
            offsets = rng.integers(NOISE_TABLE_SIZE, size=(b, n_draws, 2))
        ranges = np.empty((b, self.n_beams), np.float32)
        ids = np.full((b if with_ids else 0, self.n_beams), NO_RETURN, np.int32)
        noise = noise_table(), offsets, np.float32(self.noise_sd), np.float32(ndtri(self.dropout))
        quads, others = (tuple(cells) for cells in plane.cells)
        scan_all(quads, others, pose, self.beams[1], self._beams, noise, ranges, ids)
        return ranges, ids


@lru_cache(maxsize=1)
def noise_table() -> Float32Array:
    """Return quantiles of the standard normal distribution in a fixed random order.

    (NOISE_TABLE_SIZE + BEAMS_PER_DRAW,) float32. The table is constant, as in the ziggurat algorithm; scans read it
    from random offsets. All values have the same probability, so a threshold gives exactly the dropout rate.
    """
    quantiles = ndtri((np.arange(NOISE_TABLE_SIZE) + 0.5) / NOISE_TABLE_SIZE)
    shuffled = np.random.default_rng(0).permutation(quantiles)
    return np.concatenate([shuffled, shuffled[:BEAMS_PER_DRAW]]).astype(np.float32)
