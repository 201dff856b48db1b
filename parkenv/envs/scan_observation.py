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

import math
from collections import deque
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from parkenv.compiled.arrays import FloatArray
from parkenv.engine.records import N_ACTIONS
from parkenv.envs.sensors import SearchSensorsEnv, sensor_key
from parkenv.errors import require_whole

SCANS = 4  # default number of scans in an observation
MAX_SCANS = 100  # maximum number of scans in an observation
WAVELENGTHS_M = (8.0, 16.0, 32.0, 64.0, 128.0, 512.0)
SECTORS = 72
FIXED = 6 + 4 * len(WAVELENGTHS_M)
PER_SCAN = 5 + SECTORS
_MINUTE, _NEAR_M, _AWAY_M = 60.0, 5.0, 30.0


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
        require_whole("k", k, least=1, most=MAX_SCANS)
        # Pose, (3,), and closeness of each sector, (SECTORS,), of the last scans, the newest first.
        self._scans: deque[tuple[FloatArray, FloatArray]] = deque(maxlen=k)
        problem = env.unwrapped.scenario
        self._goal = problem.lot.goals[problem.goal]
        self._laser = sensor_key("scan", env.unwrapped.rig.lasers[0][0])
        self.observation_space = spaces.Dict(
            {
                "scan": spaces.Box(-1.0, 1.0, (FIXED + PER_SCAN * k,), np.float32),
                "action_mask": spaces.Box(0, 1, (N_ACTIONS,), np.int8),
            }
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        self._scans.clear()
        return super().reset(seed=seed, options=options)

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        for i in range(int(observation["count"])):
            scan = observation[self._laser][i].astype(np.float64)
            nearest = np.minimum.reduceat(scan, np.arange(SECTORS) * len(scan) // SECTORS)
            self._scans.appendleft((observation["pose"][i].astype(np.float64), _closeness(nearest)))
        return {
            "scan": self._vector(float(observation["time"][1])),
            "action_mask": observation["action_mask"],
        }

    def _vector(self, elapsed: float) -> Any:
        (x, y, yaw), _ = self._scans[0]
        away_x, away_y = self._goal[0] - x, self._goal[1] - y
        bearing = math.atan2(away_y, away_x) - yaw
        parts = [
            elapsed / (elapsed + _MINUTE),
            *(math.cos(bearing), math.sin(bearing), _closeness(math.hypot(away_x, away_y))),
            *(math.cos(yaw), math.sin(yaw)),
        ]
        for wavelength in WAVELENGTHS_M:
            for metres in (x, y):
                angle = 2.0 * math.pi * metres / wavelength
                parts += [math.sin(angle), math.cos(angle)]
        for pose, closeness in self._scans:
            back_x, back_y, turn = pose[0] - x, pose[1] - y, pose[2] - yaw
            ahead = (math.cos(yaw) * back_x + math.sin(yaw) * back_y) / _AWAY_M
            left = (math.cos(yaw) * back_y - math.sin(yaw) * back_x) / _AWAY_M
            parts += [
                1.0,
                min(max(ahead, -1.0), 1.0),
                min(max(left, -1.0), 1.0),
                math.cos(turn),
                math.sin(turn),
            ]
            parts += closeness.tolist()
        vector = np.zeros(self.observation_space["scan"].shape, np.float32)  # type: ignore[index]
        vector[: len(parts)] = parts
        return vector


def _closeness(metres: Any) -> Any:
    return 1.0 / (1.0 + metres / _NEAR_M)
