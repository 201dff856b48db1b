"""Simulated sensor measurements between two decisions of a search."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.threads import in_threads
from parkenv.engine.state import SearchState
from parkenv.errors import require, require_number, require_one_of, require_whole
from parkenv.world.lot_scene import LotScenes, slot_lot
from parkenv.world.scenario import Scenario
from sim_sensors.camera.weather import PRESETS, Weather
from sim_sensors.rig import RIG_NAMES, SensorRig, TimedCapture

if TYPE_CHECKING:
    from sim_sensors.movers import Movers


# px; width of the pictures of a searching car's cameras. Those of a survey are 640 px wide.
PICTURE_WIDTH = 400

_SEEDS = 1 << 31


class Station(NamedTuple):
    time: float  # s since Monday 00:00
    pose: FloatArray  # (3,) x, y in m, yaw in rad, of the vehicle
    # moving cars and pedestrians around it; None: the scenario's traffic at this time, undisturbed
    movers: Movers | None = None


def make_rig(rig: str | SensorRig | None, scenario: Scenario, picture_width: int | None = None) -> SensorRig:
    """Return a rig by name, as it is, or by default the scenario's; with pictures of another width, px, if given.

    A rig by name has pictures of `PICTURE_WIDTH`.
    """
    rig = scenario.rig if rig is None else rig
    width = picture_width
    if not isinstance(rig, SensorRig):
        require(rig in RIG_NAMES, f"rig is {rig!r:.60}, want a SensorRig or one of {', '.join(RIG_NAMES)}")
        rig, width = SensorRig.named(rig), PICTURE_WIDTH if width is None else width
        rig = rig.mirrored() if scenario.lot.left_hand else rig
    if width is None:
        return rig
    require_whole("picture_width", width, least=64)
    return rig.resized(int(width))


class SensorSampler:
    """Samples the simulated sensors of the searching car along each edge it drives.

    At a vertex the car is headed along the lane, between two vertices along the edge. Measurements depend only on
    world, pose and time, not on the agent or on earlier measurements: at most `captures` on an edge, `every` m apart
    except for the last one. Without a weather, each world draws one.
    """

    def __init__(
        self,
        scenario: Scenario,
        rig: str | SensorRig | None,
        weather: str | None,
        captures: int,
        every: float,
    ) -> None:
        require_one_of("weather", weather, (None, *PRESETS))
        require_whole("captures", captures, least=1)
        require_number("every", every, above=0.0)
        self.rig = make_rig(rig, scenario)
        self.captures = int(captures)
        self._lot, self._scenario = scenario.lot, scenario
        self._weather, self._every = weather, every
        self._slots = slot_lot(scenario.lot)
        self._cached_world: tuple[np.uint64, LotScenes, Weather] | None = None

    def sample_step(self, state: SearchState, since: tuple[int, float] | None) -> list[TimedCapture]:
        """Measure along the edge just driven, or at the vertex if the car has not moved; the newest capture last.

        `since` are vertex and time, s, before the last step; None at the start of the search.
        """
        return self.sample(state, self._stations(state, since))

    def sample(self, state: SearchState, stations: Sequence[Station]) -> list[TimedCapture]:
        scenes, weather = self._world(state)
        jobs = []
        for time, pose, movers in stations:
            # Keyed by the millisecond: the same capture has the same noise.
            noise = np.random.SeedSequence([int(state.key), int(time * 1000.0)]).generate_state(1)
            scene = scenes.at(time, pose)
            if movers is not None:
                scene = scene.with_movers(movers)
            self.rig.prepare(scene, pose, weather)
            jobs.append((time, scene, pose, int(noise[0])))
        return in_threads(
            lambda job: TimedCapture(job[0], self.rig.capture(job[1], job[2], weather, job[3])), jobs
        )

    def select_stations(self, driven: FloatArray) -> NDArray[np.int64]:
        """Return indices into `driven`, (k,) m up to each point of a path, of points to measure at, with the last one.

        They are evenly spaced, at most `captures`, and at least `every` m apart.
        """
        n = self._captures_on(float(driven[-1] - driven[0]))
        wanted = np.linspace(driven[0], driven[-1], n + 1)[1:-1]
        return np.unique(np.r_[np.searchsorted(driven, wanted), len(driven) - 1])

    def _captures_on(self, metres: float) -> int:
        return min(max(int(metres / self._every), 1), self.captures)

    def _world(self, state: SearchState) -> tuple[LotScenes, Weather]:
        if self._cached_world is None or self._cached_world[0] != state.key:
            seed = int(state.key) % _SEEDS
            preset = self._weather or str(np.random.default_rng(seed).choice(PRESETS))
            scenes = LotScenes(self._slots, self._scenario, state.key, state.world)
            self._cached_world = state.key, scenes, Weather.draw(preset, seed)
        return self._cached_world[1:]

    def _stations(self, state: SearchState, since: tuple[int, float] | None) -> list[Station]:
        here = self._lot.vertex_xy[state.vertex]
        stop = Station(state.time, np.array([*here, self._heading(state)]))
        if since is None or since[0] == state.vertex:
            return [stop]
        start, begun = self._lot.vertex_xy[since[0]], since[1]
        way = here - start
        n = self._captures_on(float(np.hypot(*way)))
        yaw = math.atan2(way[1], way[0])
        shares = [k / n for k in range(1, n)]
        passing = [
            Station(begun + s * (state.time - begun), np.array([*(start + s * way), yaw])) for s in shares
        ]
        return [*passing, stop]

    def _heading(self, state: SearchState) -> float:
        lot, vertex = self._lot, state.vertex
        if vertex < lot.n_slots:
            return float(lot.vertex_yaw[vertex])
        ends = state.path[-2:]
        if len(ends) < 2:
            ends = [vertex, int(lot.neighbors[vertex][lot.neighbors[vertex] >= 0][0])]
        way = lot.vertex_xy[ends[1]] - lot.vertex_xy[ends[0]]
        return math.atan2(way[1], way[0])
