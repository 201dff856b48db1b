"""What a searching car's sensors measure on the way from one stop to the next."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.envs.search_state import SearchState
from parkenv.errors import InputError
from parkenv.world.lot_scene import LotScenes, slot_lot
from parkenv.world.scenario import Scenario
from sim_sensors.camera.weather import PRESETS, Weather
from sim_sensors.rig import RIG_NAMES, Capture, SensorRig

if TYPE_CHECKING:
    from sim_sensors.movers import Movers

FloatArray = NDArray[np.float64]

_SEEDS = 1 << 31


class Moment(NamedTuple):
    """One capture, and its time in s since Monday 00:00."""

    time: float
    capture: Capture


class Station(NamedTuple):
    """Where to measure.

    Attributes:
        time: s since Monday 00:00.
        pose: (3,) x, y in m, yaw in rad, of the vehicle.
        movers: who moves around it; None for the scenario's traffic as it is then where nobody waits for anybody.
    """

    time: float
    pose: FloatArray
    movers: Movers | None = None


class Lookout:
    """The sensors of a searching car.

    Where the car stops it stands on its vertex and looks along the lane; between two stops it looks where it drives.
    Equal worlds, seen from equal places at equal times, give equal measurements, whoever drives.

    Args:
        scenario: the world, with its traffic.
        rig: laser, stereo, both_sides, or any rig.
        weather: one of `sim_sensors.camera.weather.PRESETS`; None draws one for each world.
        captures: how many there are at most on an edge.
        every: m; captures on an edge are at least so far apart, but for the one where it ends.

    Raises:
        InputError: an unknown rig or weather, a number out of its range.
    """

    def __init__(
        self, scenario: Scenario, rig: str | SensorRig, weather: str | None, captures: int, every: float
    ) -> None:
        if isinstance(rig, str):
            if rig not in RIG_NAMES:
                raise InputError(f"rig is {rig!r}, want a SensorRig or one of {', '.join(RIG_NAMES)}")
            rig = SensorRig.named(rig)
        elif not isinstance(rig, SensorRig):
            raise InputError(
                f"rig is a {type(rig).__name__}, want a SensorRig or one of {', '.join(RIG_NAMES)}"
            )
        if weather is not None and weather not in PRESETS:
            raise InputError(f"weather is {weather!r}, want None or one of {', '.join(PRESETS)}")
        if isinstance(captures, bool) or not isinstance(captures, (int, np.integer)) or captures < 1:
            raise InputError(f"captures is {captures!r}, want a whole number of at least 1")
        if not (isinstance(every, (int, float)) and math.isfinite(every) and every > 0.0):
            raise InputError(f"every is {every!r} m, want a finite distance above 0")
        self.rig = rig
        self.captures = int(captures)
        self._lot, self._scenario = scenario.lot, scenario
        self._weather, self._every = weather, every
        self._slots = slot_lot(scenario.lot)
        self._seen_world: tuple[np.uint64, LotScenes, Weather] | None = None

    def look(self, state: SearchState, since: tuple[int, float] | None) -> list[Moment]:
        """Measure along the edge just driven, or where the car stands if it has not moved.

        Args:
            state: of the search, now.
            since: vertex and time, s, before the last step; None where the search has just begun.

        Returns:
            1 to `captures` moments, the newest last.
        """
        return self.measure(state, self._stations(state, since))

    def measure(self, state: SearchState, stations: Sequence[Station]) -> list[Moment]:
        """Measure at some places.

        Args:
            state: of the search, whose world it is.
            stations: where, oldest first.

        Returns:
            A moment for each.
        """
        scenes, weather = self._world(state)
        moments = []
        for time, pose, movers in stations:
            # By the millisecond: the same look has the same noise.
            noise = np.random.SeedSequence([int(state.key), int(time * 1000.0)]).generate_state(1)
            scene = scenes.at(time, pose)
            if movers is not None:
                scene = scene.with_movers(movers)
            moments.append(Moment(time, self.rig.capture(scene, pose, weather, int(noise[0]))))
        return moments

    def chosen(self, driven: FloatArray) -> NDArray[np.int64]:
        """Where on a way to measure: evenly, `every` m apart at least, at most `captures` times, and where it ends.

        Args:
            driven: (k,) m, how far the car had come at each of the places it could be, ascending; k at least 1.

        Returns:
            Indices of 1 to `captures` of them, ascending.
        """
        n = self._n_on(float(driven[-1] - driven[0]))
        wanted = np.linspace(driven[0], driven[-1], n + 1)[1:-1]
        return np.unique(np.r_[np.searchsorted(driven, wanted), len(driven) - 1])

    def _n_on(self, metres: float) -> int:
        return min(max(int(metres / self._every), 1), self.captures)

    def _world(self, state: SearchState) -> tuple[LotScenes, Weather]:
        if self._seen_world is None or self._seen_world[0] != state.key:
            seed = int(state.key) % _SEEDS
            preset = self._weather or str(np.random.default_rng(seed).choice(PRESETS))
            scenes = LotScenes(self._slots, self._scenario, state.key, state.world)
            self._seen_world = state.key, scenes, Weather.draw(preset, seed)
        return self._seen_world[1:]

    def _stations(self, state: SearchState, since: tuple[int, float] | None) -> list[Station]:
        """Time and pose of each capture."""
        here = self._lot.vertex_xy[state.vertex]
        stop = Station(state.time, np.array([*here, self._heading(state)]))
        if since is None or since[0] == state.vertex:
            return [stop]
        start, begun = self._lot.vertex_xy[since[0]], since[1]
        way = here - start
        n = self._n_on(float(np.hypot(*way)))
        yaw = math.atan2(way[1], way[0])
        shares = [k / n for k in range(1, n)]
        passing = [
            Station(begun + s * (state.time - begun), np.array([*(start + s * way), yaw])) for s in shares
        ]
        return [*passing, stop]

    def _heading(self, state: SearchState) -> float:
        """Where the car looks when it stands: along the lane; at a junction as it came, or on to the first way out."""
        lot, vertex = self._lot, state.vertex
        if vertex < lot.n_slots:
            return float(lot.vertex_yaw[vertex])
        ends = state.path[-2:]
        if len(ends) < 2:
            ends = [vertex, int(lot.neighbors[vertex][lot.neighbors[vertex] >= 0][0])]
        way = lot.vertex_xy[ends[1]] - lot.vertex_xy[ends[0]]
        return math.atan2(way[1], way[0])
