"""The last laser scans and poses of a search as a vector, for policies that learn from raw scans.

It contains no belief, forecast or map: besides scans and poses only what a driver knows without sensors, the time and
the position of the goal. The vector has 30 + 77k numbers from -1 to 1 for the last k scans; those still to come are 0.
A time of s seconds is encoded as s / (s + 60), a length of d metres as 1 / (1 + d / 5): 1 at the laser, about 0 far
away.

| Index | Meaning |
|---|---|
| 0 | time since the search began |
| 1 to 3 | the goal seen from the car: cosine and sine of its bearing, and its distance |
| 4, 5 | cosine and sine of the car's heading in the lot |
| 6 to 29 | sine and cosine of x, sine and cosine of y, for wavelengths of 8, 16, 32, 64, 128 and 512 m |
| 30 + 77i | for scan i, the newest first: 1, or 0 if there is none yet |
| 31 + 77i, 32 + 77i | where it was measured, as seen from the car now: ahead and to the left, in units of 30 m |
| 33 + 77i, 34 + 77i | cosine and sine of the heading there, relative to the heading now |
| 35 + 77i to 106 + 77i | the shortest range in each of 72 equal sectors, from the right to the left |
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from parkenv.engine.records import N_ACTIONS
from parkenv.envs.sensors import SearchSensorsEnv
from parkenv.errors import InputError
from parkenv.world.occupancy.kernel import kernel
from parkenv.world.scenario import SearchProblem

SCANS = 4
"""Default number of scans in an observation."""
MAX_SCANS = 100
"""Maximum number of scans in an observation."""
WAVELENGTHS_M = (8.0, 16.0, 32.0, 64.0, 128.0, 512.0)
SECTORS = 72
_AT = 6  # index of the position
FIXED = _AT + 4 * len(WAVELENGTHS_M)
PER_SCAN = 5 + SECTORS
_MINUTE, _NEAR_M, _AWAY_M = 60.0, 5.0, 30.0


class ScanHistory(NamedTuple):
    """The last k scans of n searches, the newest first.

    Attributes:
        known: (n,) int64, number of scans so far, at most k.
        pose: (n, k, 3) float64, x, y in m and yaw in rad of the vehicle.
        closeness: (n, k, `SECTORS`) float32.
    """

    known: NDArray[np.int64]
    pose: NDArray[np.float64]
    closeness: NDArray[np.float32]

    @classmethod
    def of(cls, n: int, k: int) -> ScanHistory:
        """Return the history of n searches that have not begun.

        Raises:
            InputError: k is not a whole number from 1 to `MAX_SCANS`.
        """
        if isinstance(k, bool) or not isinstance(k, (int, np.integer)) or not 1 <= k <= MAX_SCANS:
            raise InputError(f"k is {k!r}, want a whole number of scans from 1 to {MAX_SCANS}")
        return cls(np.zeros(n, np.int64), np.zeros((n, k, 3)), np.zeros((n, k, SECTORS), np.float32))


def scans_space(k: int) -> spaces.Dict:
    """The observation space: `scan`, (30 + 77k,) float32, and `action_mask`, (5,) int8."""
    return spaces.Dict(
        {
            "scan": spaces.Box(-1.0, 1.0, (FIXED + PER_SCAN * k,), np.float32),
            "action_mask": spaces.Box(0, 1, (N_ACTIONS,), np.int8),
        }
    )


def goal_of(problem: SearchProblem) -> tuple[float, float]:
    """Return where the goal is, x, y in m."""
    x, y = problem.lot.goals[problem.goal].tolist()
    return x, y


class ScanObservation(
    gym.ObservationWrapper[dict[str, Any], np.int64, dict[str, Any]], gym.utils.RecordConstructorArgs
):
    """Observe `parkenv/SearchSensors-v2` as `scan` and `action_mask`; the module describes `scan`.

    Args:
        env: `parkenv/SearchSensors-v2`; with `observation="scan"` it draws no pictures.
        k: number of scans; with `captures=1` there is one for each decision.

    Raises:
        TypeError: another environment.
        InputError: k is not a whole number from 1 to `MAX_SCANS`.

    Examples:
        >>> import gymnasium as gym
        >>> import parkenv
        >>> env = gym.make("parkenv/SearchSensors-v2", scenario="mini", observation="scan", captures=1)
        >>> observation, info = ScanObservation(env, k=4).reset(seed=0)
        >>> observation["scan"].shape
        (338,)
    """

    def __init__(self, env: gym.Env[Any, Any], k: int = SCANS) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, k=k)
        super().__init__(env)
        if not isinstance(env.unwrapped, SearchSensorsEnv):
            raise TypeError(
                f"ScanObservation wraps parkenv/SearchSensors-v2, not {type(env.unwrapped).__name__}"
            )
        self._history = ScanHistory.of(1, k)
        self._goal = goal_of(env.unwrapped.scenario)
        self._laser = f"scan.{env.unwrapped.rig.lasers[0][0]}"
        self.observation_space = scans_space(k)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode, without the scans of the one before."""
        self._history.known[:] = 0
        return super().reset(seed=seed, options=options)

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the last scans."""
        scans = np.empty((1, *self.observation_space["scan"].shape), np.float32)  # type: ignore[index]
        batch = [np.asarray(observation[name])[None] for name in (self._laser, "pose", "count", "time")]
        nobody = np.zeros(1, np.bool_)
        observe_scans(*batch, self._goal, nobody, nobody, self._history, scans)
        return {"scan": scans[0], "action_mask": observation["action_mask"]}


@kernel
def observe_scans(
    scan: NDArray[np.float32],
    pose: NDArray[np.float32],
    count: NDArray[np.int64],
    time: NDArray[np.float32],
    goal: tuple[float, float],
    fresh: NDArray[np.bool_],
    idle: NDArray[np.bool_],
    history: ScanHistory,
    out: NDArray[np.float32],
) -> None:
    """Add the captures of a step to the history of all searches except idle ones, and write what they observe.

    Args:
        scan: (n, captures, n_beams), m.
        pose: (n, captures, 3), x, y in m and yaw in rad of the vehicle.
        count: (n,), number of captures of the step.
        time: (n, 2), s since Monday 00:00, and since the search began.
        goal: x, y in m.
        fresh: (n,), searches that begin; what they knew is forgotten.
        idle: (n,), searches that made no step.
        history: is changed.
        out: (n, 30 + 77k), observations to write.
    """
    k = history.pose.shape[1]
    for e in range(len(count)):
        if idle[e]:
            continue
        if fresh[e]:
            history.known[e] = 0
        for capture in range(count[e]):
            for i in range(min(history.known[e], k - 1), 0, -1):
                for part in range(3):
                    history.pose[e, i, part] = history.pose[e, i - 1, part]
                for sector in range(SECTORS):
                    history.closeness[e, i, sector] = history.closeness[e, i - 1, sector]
            for part in range(3):
                history.pose[e, 0, part] = pose[e, capture, part]
            _pool(scan[e, capture], history.closeness[e, 0])
            history.known[e] = min(history.known[e] + 1, k)
        _write(history.known[e], history.pose[e], history.closeness[e], time[e, 1], goal, out[e])


@kernel
def _pool(scan: NDArray[np.float32], closeness: NDArray[np.float32]) -> None:
    """Write how close the nearest obstacle of each sector is."""
    for sector in range(SECTORS):
        nearest = math.inf
        for beam in range(sector * len(scan) // SECTORS, (sector + 1) * len(scan) // SECTORS):
            nearest = min(nearest, scan[beam])
        closeness[sector] = _closeness(nearest)


@kernel
def _closeness(metres: float) -> float:
    return 1.0 / (1.0 + metres / _NEAR_M)


@kernel
def _write(
    known: int,
    pose: NDArray[np.float64],
    closeness: NDArray[np.float32],
    elapsed: float,
    goal: tuple[float, float],
    out: NDArray[np.float32],
) -> None:
    """Write the observation of one search, (30 + 77k,)."""
    x, y, yaw = pose[0, 0], pose[0, 1], pose[0, 2]
    away_x, away_y = goal[0] - x, goal[1] - y
    bearing = math.atan2(away_y, away_x) - yaw
    out[0] = elapsed / (elapsed + _MINUTE)
    out[1], out[2] = math.cos(bearing), math.sin(bearing)
    out[3] = _closeness(math.hypot(away_x, away_y))
    out[4], out[5] = math.cos(yaw), math.sin(yaw)
    place = _AT
    for wavelength in WAVELENGTHS_M:
        for metres in (x, y):
            angle = 2.0 * math.pi * metres / wavelength
            out[place], out[place + 1] = math.sin(angle), math.cos(angle)
            place += 2
    for i in range(known):
        back_x, back_y, turn = pose[i, 0] - x, pose[i, 1] - y, pose[i, 2] - yaw
        ahead = (math.cos(yaw) * back_x + math.sin(yaw) * back_y) / _AWAY_M
        left = (math.cos(yaw) * back_y - math.sin(yaw) * back_x) / _AWAY_M
        out[place] = 1.0
        out[place + 1], out[place + 2] = min(max(ahead, -1.0), 1.0), min(max(left, -1.0), 1.0)
        out[place + 3], out[place + 4] = math.cos(turn), math.sin(turn)
        for sector in range(SECTORS):
            out[place + 5 + sector] = closeness[i, sector]
        place += PER_SCAN
    out[place:] = np.float32(0.0)
