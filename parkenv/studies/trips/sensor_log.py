"""Record sensor data and perception results for the Rerun viewer (https://rerun.io)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from gymnasium.wrappers import TimeLimit
from matplotlib import colormaps
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, needs_extra
from parkenv.files.atomic_write import atomic_write
from parkenv.studies.episodes import SearchRecorder
from parkenv.studies.simulate import STEP_LIMIT, simulate
from parkenv.world.lot import ParkingLot

if TYPE_CHECKING:
    import rerun as rr

    from parkenv.envs.perception import SearchPerceptionEnv
    from parkenv.mapping.grid import OccupancyGrid
    from parkenv.mapping.survey import Survey, SurveyFrame
    from parkenv.perception.pipeline import PerceptionResult
    from parkenv.show.search_record import Moment
    from parkenv.studies.trips.driven_search import DrivenSearch, Trip
    from planners.agent import Agent
    from sim_sensors.rig import SensorRig


TIMELINE = "drive"  # seconds since the first drive began
PAUSE_S = 5.0  # pause between two drives, s
GRID_EVERY = 10  # record the grid at every this many captures only: it is large and changes little
JPEG_QUALITY = 80
UNOBSERVED_GREY = 40
SIDE, END, UNRANGED = (255, 208, 0), (86, 180, 233), (150, 150, 150)
INK, PATH, SCAN, GOAL = (120, 126, 134), (0, 114, 178), (213, 94, 0), (204, 121, 167)


class SensorLog:
    """A recording on one timeline: images, boxes, scans, grid, slots, path.

    Entities are `lot/...` (m, z up: outlines of the slots, coloured by belief), `car` with its cameras, images and
    boxes below it, `scan/...`, `grid`, detected `cars`, and `path`.

    Args:
        recording: the stream to write to.
        lot: drawn once.
        rig: the sensors.
    """

    def __init__(self, recording: rr.RecordingStream, lot: ParkingLot, rig: SensorRig) -> None:
        self._rec, self._lot, self._rig = recording, lot, rig
        self._path: list[list[float]] = []
        self._n_captures = 0
        self._begun = self._time = 0.0
        corners = lot.slot_corners()[:, [0, 1, 2, 3, 0]]
        self._outlines = np.concatenate([corners, np.zeros((*corners.shape[:2], 1))], axis=2)
        self._draw_lot()
        self._draw_rig()

    def begin(self) -> None:
        """Begin another drive after those recorded so far."""
        self._begun = 0.0 if not self._n_captures else self._time + PAUSE_S
        self._path = []

    def capture(self, time: float, result: PerceptionResult) -> None:
        """Record the estimated pose of the car, its measurements, and the detected cars.

        Args:
            time: time since the drive began, s.
            result: result of the perception pipeline.
        """
        import rerun as rr

        self._time = self._begun + time
        self._rec.set_time(TIMELINE, duration=self._time)
        x, y, yaw = (float(v) for v in result.vehicle)
        axis = rr.RotationAxisAngle(axis=(0.0, 0.0, 1.0), radians=yaw)
        self._rec.log("car", rr.Transform3D(translation=(x, y, 0.0), rotation=axis))
        self._path.append([x, y, 0.05])
        self._rec.log("path", rr.LineStrips3D([self._path], colors=[PATH], radii=0.08))
        for view in result.views:
            at = f"car/{view.name}"
            self._rec.log(at, rr.EncodedImage(contents=_jpeg(view.image), media_type="image/jpeg"))
            found = view.detections
            standing = np.isin(np.arange(len(found)), view.cars.detection)
            colors = np.where(standing[:, None], np.where(found.end_on[:, None], END, SIDE), UNRANGED).astype(
                np.uint8
            )
            labels = [f"{p:.2f}" for p in found.probability]
            boxes = rr.Boxes2D(
                array=found.boxes, array_format=rr.Box2DFormat.XYXY, colors=colors, labels=labels
            )
            self._rec.log(f"{at}/boxes", boxes)
        for number, scan in enumerate(result.scans):
            ended = np.nonzero(np.isfinite(scan.distance))[0]
            points = np.column_stack([scan.points(ended), np.full(len(ended), 0.5)])
            self._rec.log(f"scan/{number}", rr.Points3D(points, colors=[SCAN], radii=0.04))
        cars = [view.cars for view in result.views if len(view.cars)]
        self._rec.log(
            "cars",
            rr.Boxes3D(
                centers=np.concatenate([np.column_stack([c.xy, np.full(len(c), 0.75)]) for c in cars]),
                sizes=np.concatenate([np.column_stack([c.size, np.full(len(c), 1.5)]) for c in cars]),
                rotations=[
                    rr.RotationAxisAngle(axis=(0, 0, 1), radians=a) for c in cars for a in c.yaw.tolist()
                ],
                colors=[SIDE],
            )
            if cars
            else rr.Clear(recursive=False),
        )
        self._n_captures += 1

    def moment(self, moment: Moment) -> None:
        """Record the arrival or a step of a search: the captures on the way, and the belief."""
        if not moment.info:
            self.begin()
            self._arrival = moment.time
        for result in moment.captures:
            self.capture(result.captured.time - self._arrival, result)
        self.slots(moment.belief.p_occupied.astype(np.float64))

    def slots(self, p_occupied: FloatArray, known: NDArray[np.bool_] | None = None) -> None:
        """Record P(taken) of every slot, (n_slots,); slots that are not `known` are grey."""
        import rerun as rr

        colors = (255.0 * colormaps["cividis"](p_occupied)).astype(np.uint8)
        if known is not None:
            colors[~known] = (*INK, 255)
        self._rec.log("lot/slots", rr.LineStrips3D(self._outlines, colors=colors, radii=0.07))
        labels = [f"{name} {p:.0%}" for name, p in zip(self._lot.slot_ids, p_occupied, strict=True)]
        centers = np.column_stack([self._lot.slot_xy, np.zeros(self._lot.n_slots)])
        self._rec.log(
            "lot/beliefs", rr.Points3D(centers, colors=colors, radii=0.35, labels=labels, show_labels=False)
        )

    def grid(self, grid: OccupancyGrid) -> None:
        """Record the occupancy grid at every `GRID_EVERY`-th capture."""
        if (self._n_captures - 1) % GRID_EVERY:
            return
        import rerun as rr

        rows, columns = grid.log_odds.shape
        low = np.array([*grid.low, -0.02])
        side = grid.cell * np.array([columns, rows])
        corners = low + np.array([[0, 0, 0], [side[0], 0, 0], [side[0], side[1], 0], [0, side[1], 0]])
        picture = (255.0 * colormaps["cividis"](grid.probability)[..., :3]).astype(np.uint8)
        picture[~grid.seen] = UNOBSERVED_GREY
        self._rec.log(
            "grid",
            rr.Mesh3D(
                vertex_positions=corners,
                triangle_indices=[[0, 1, 2], [0, 2, 3]],
                vertex_texcoords=[[0, 1], [1, 1], [1, 0], [0, 0]],
                albedo_texture=picture[::-1],
            ),
        )

    def _draw_lot(self) -> None:
        import rerun as rr

        lot = self._lot
        self._rec.log("lot", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        xy = np.column_stack([lot.vertex_xy, np.zeros(len(lot.vertex_xy))])
        start, direction = np.nonzero(lot.neighbors >= 0)
        lanes = np.stack([xy[start], xy[lot.neighbors[start, direction]]], axis=1)
        self._rec.log("lot/lanes", rr.LineStrips3D(lanes, colors=[INK], radii=0.03), static=True)
        goals = np.column_stack([lot.goals, np.full(len(lot.goals), 0.5)])
        marks = rr.Points3D(goals, radii=0.8, labels=["goal"] * len(goals), colors=[GOAL])
        self._rec.log("lot/goal", marks, static=True)

    def _draw_rig(self) -> None:
        import rerun as rr

        self._rec.log(
            "car/body",
            rr.Boxes3D(centers=[[0, 0, 0.75]], sizes=[[4.4, 1.8, 1.5]], colors=[PATH]),
            static=True,
        )
        rig = self._rig
        cameras = [
            *rig.cameras,
            *((name, stereo.camera, mount) for name, stereo, mount in rig.stereo_cameras),
        ]
        for name, camera, mount in cameras:
            pose = mount.camera_pose(np.zeros(3))
            self._rec.log(
                f"car/{name}", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]),
                rr.Pinhole(
                    focal_length=(camera.fx, camera.fy), principal_point=(camera.cx, camera.cy),
                    width=camera.width, height=camera.height, camera_xyz=rr.ViewCoordinates.RDF,
                    image_plane_distance=2.0,
                ),
                static=True,
            )  # fmt: skip


def require_viewer() -> None:
    """Check that the Rerun SDK is installed.

    Raises:
        InputError: the SDK is missing.
    """
    if find_spec("rerun") is None:
        raise InputError(needs_extra("a recording", "viewer"))


@contextmanager
def sensor_log(path: str | Path, lot: ParkingLot, rig: SensorRig) -> Iterator[SensorLog]:
    """Open a log that is written to `path` (.rrd) at the end of the block.

    Raises:
        InputError: the extra `viewer` is not installed, or the file cannot be written.
    """
    require_viewer()
    import rerun as rr
    import rerun.blueprint as rrb

    names = [name for name, _, _ in (*rig.cameras, *rig.stereo_cameras)]
    low_x, low_y, high_x, high_y = lot.bounds()
    middle, size = (0.5 * (low_x + high_x), 0.5 * (low_y + high_y)), max(high_x - low_x, high_y - low_y)
    above = rrb.EyeControls3D(
        position=(middle[0], middle[1] - 0.5 * size, 0.7 * size), look_target=(*middle, 0.0), eye_up=(0, 0, 1)
    )
    boxes = [f"- /car/{name}/boxes" for name in names]
    layout = rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(
                name="Lot", origin="/", contents=["$origin/**", *boxes], eye_controls=above, line_grid=False
            ),
            rrb.Vertical(*(rrb.Spatial2DView(name=name, origin=f"/car/{name}") for name in names)),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        collapse_panels=True,
    )
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as beside:
        recording = rr.RecordingStream("parkenv", recording_id=Path(path).stem, send_properties=False)
        try:
            recording.save(beside, default_blueprint=layout)
        except RuntimeError as error:
            raise InputError(f"{path}: cannot be written: {error}") from error
        try:
            yield SensorLog(recording, lot, rig)
        finally:
            recording.flush()
            recording.disconnect()


def record_session(survey: Survey, number: int, log: SensorLog) -> None:
    """Drive a survey session, as for the map, and record it.

    Args:
        survey: the survey.
        number: number of the session.
        log: a log for the survey's lot and rig.
    """
    log.begin()
    begun: list[float] = []

    def keep(frame: SurveyFrame) -> None:
        time = frame.result.captured.time
        begun[:] = begun or [time]
        log.capture(time - begun[0], frame.result)
        states = frame.slots.states()
        log.slots(states.p_occupied, states.in_view)
        log.grid(frame.grid)

    survey.drive(number, on_frame=keep)


def record_search(env: SearchPerceptionEnv, agent: Agent, seed: int, log: SensorLog) -> None:
    """Run one search with simulated sensors, and record it.

    Args:
        env: the environment.
        agent: an agent made for its scenario.
        seed: seed of the world.
        log: a log for the environment's lot and rig.
    """
    simulate(TimeLimit(env, STEP_LIMIT), agent, seed, (SearchRecorder(keep=log.moment),))


def record_trip(search: DrivenSearch, seed: int, log: SensorLog) -> Trip:
    """Drive a trip with sensors, and record it.

    Args:
        search: a search with a rig.
        seed: seed of the world.
        log: a log for the lot and rig of `search`.

    Raises:
        InputError: the search has no rig.
    """
    if search.env.perception is None:
        raise InputError("a recorded trip needs sensors: give it a rig")
    return search.run(seed, (SearchRecorder(keep=log.moment),))


def _jpeg(image: NDArray[np.uint8]) -> bytes:
    _, encoded = cv2.imencode(
        ".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    )
    return encoded.tobytes()
