"""Recordings of simulated drives: MCAP files of images, scans and poses, as `parkenv survey --record` writes them."""

import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.files.atomic_write import atomic_write, check_writable
from parkenv.files.recordings import COMPRESSED_IMAGE, POSE_2D, SCAN, require_rosbags
from parkenv.files.spec_file import Spec
from parkenv.mapping.survey import Survey
from sim_sensors.rig import SensorRig, TimedCapture

HEAD = "/parkenv/drive"
RECORDED_MONDAY_S = 1_704_067_200  # 2024-01-01; drives are recorded as if in the week from this Monday on
_STRING = "std_msgs/msg/String"


class Head(Spec, extra="ignore"):
    """What identifies a session: its key, start (s since Monday 00:00), rig and weather."""

    key: str
    time: float
    rig: str
    weather: str


def topics_of(rig: SensorRig) -> dict[str, str]:
    """Return the topics of a rig's recording: `pose`, `image:NAME:SIDE` and `scan:NAME`."""
    topics = {f"image:{name}:mono": f"/{name}/image/compressed" for name, _, _ in rig.cameras}
    for name, _, _ in rig.stereo_cameras:
        topics |= {f"image:{name}:{side}": f"/{name}/{side}/image/compressed" for side in ("left", "right")}
    return {"pose": "/pose"} | topics | {f"scan:{name}": f"/{name}/scan" for name, _, _ in rig.lasers}


class DriveWriter:
    def __init__(self, writer: Any, rig: SensorRig, store: Any) -> None:
        self._writer, self._rig, self._store, self._last = writer, rig, store, 0
        self._connections: dict[str, Any] = {}
        self._topics = topics_of(rig) | {"head": HEAD}

    def add(self, captured: TimedCapture, vehicle: FloatArray) -> None:
        """Append a capture and the pose of the vehicle by its odometry, (3,)."""
        stamp = RECORDED_MONDAY_S * 10**9 + round(captured.time * 1e9)
        x, y, yaw = (float(v) for v in vehicle)
        self._send("pose", POSE_2D, stamp, x=x, y=y, theta=yaw)
        capture = captured.capture
        for name, _, _ in self._rig.cameras:
            self._send_image(f"image:{name}:mono", stamp, capture.images[name].image)
        for name, _, _ in self._rig.stereo_cameras:
            self._send_image(f"image:{name}:left", stamp, capture.pairs[name].left.image)
            self._send_image(f"image:{name}:right", stamp, capture.pairs[name].right.image)
        for name, laser, _ in self._rig.lasers:
            self._send(
                f"scan:{name}", SCAN, stamp, header=self._header(stamp, name), angle_min=laser.start,
                angle_max=laser.start + (laser.n_beams - 1) * laser.step, angle_increment=laser.step,
                time_increment=0.0, scan_time=0.0, range_min=0.0, range_max=laser.max_range, ranges=capture.scans[name],
                intensities=np.zeros(0, np.float32),
            )  # fmt: skip

    def close(self, head: Head) -> None:
        self._send("head", _STRING, self._last, data=json.dumps(head.model_dump()))

    def _send_image(self, key: str, stamp: int, image: NDArray[np.uint8]) -> None:
        data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].ravel()
        header = self._header(stamp, self._topics[key])
        self._send(key, COMPRESSED_IMAGE, stamp, header=header, format="png", data=data)

    def _send(self, key: str, kind: str, stamp: int, **parts: Any) -> None:
        topic = self._topics[key]
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        message = self._store.types[kind](**parts)
        self._last = max(self._last, stamp)
        self._writer.write(self._connections[topic], stamp, self._store.serialize_cdr(message, kind))

    def _header(self, stamp: int, frame: str) -> Any:
        types = self._store.types
        time = types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
        return types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


@contextmanager
def recording(path: Path, rig: SensorRig) -> Iterator[DriveWriter]:
    """Write a drive to an MCAP file, atomically; images are stored without loss."""
    require_recordable(path)
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    with atomic_write(path) as beside:
        folder = Path(tempfile.mkdtemp(prefix=".drive", dir=path.absolute().parent))
        try:
            with Writer(folder / "drive", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
                yield DriveWriter(writer, rig, get_typestore(Stores.ROS2_HUMBLE))
            (recording,) = (folder / "drive").glob("*.mcap")
            recording.replace(beside)
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def require_recordable(path: Path) -> None:
    require_rosbags()
    if path.suffix != ".mcap":
        raise InputError(f"{path}: want a name that ends in .mcap")
    check_writable(path)


def record_drive(survey: Survey, number: int, path: Path) -> None:
    """Record what the sensors measure in a session, which is driven again; nothing is detected."""
    drive = survey.draw(number)
    with recording(path, drive.rig) as writer:
        for i, time in enumerate(drive.times.tolist()):
            writer.add(TimedCapture(time, drive.capture(i)[1]), drive.odometry[i])
        key, rig = survey.key_of(number), survey.settings.rig
        writer.close(Head(key=key, time=drive.arrival.time, rig=rig, weather=drive.preset))
