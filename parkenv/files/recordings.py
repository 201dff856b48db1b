"""Read messages, and the pictures among them, from MCAP files and rosbags, by the library rosbags."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from parkenv.compiled.arrays import Image
from parkenv.errors import InputError
from parkenv.files.images import decode_image
from parkenv.files.videos import USUAL_FPS, VideoFrame

Messages = Callable[[set[str]], Iterator[tuple[str, int, Any]]]

SUFFIXES = (".mcap", ".db3", ".bag")
IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


def is_recording(path: Path) -> bool:
    """Whether a path is named like a recording: by its suffix, or as the folder of a rosbag of ROS 2."""
    return path.suffix.lower() in SUFFIXES or (path / "metadata.yaml").is_file()


def require_rosbags() -> None:
    """Check that the library rosbags is installed.

    Raises:
        InputError: it is not; the message says how to install it.
    """
    try:
        import rosbags.rosbag2  # noqa: F401
    except ImportError as error:
        raise InputError("recorded drives need the extra bags: pip install 'parkenv[bags]'") from error


@contextmanager
def open_recording(path: Path) -> Iterator[tuple[dict[str, str], Messages]]:
    """Open an MCAP file, a rosbag of ROS 2 (folder, .mcap or .db3) or of ROS 1 (.bag).

    Yields:
        The type of each topic, and a function that reads the messages of some topics in order: topic, time of the
        recording in ns, message.

    Raises:
        InputError: the recording cannot be read whole.
    """
    require_rosbags()
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.typesys import Stores, get_typestore

    if not path.exists():
        raise InputError(f"{path}: No such file or directory")
    is_ros1 = path.suffix == ".bag"
    # Types are those of ROS, not what the file says they are.
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    deserialize = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr

    with _in_words(path):
        reader: Any = (Reader1 if is_ros1 else Reader2)(path)
        reader.open()
    try:

        def messages(topics: set[str]) -> Iterator[tuple[str, int, Any]]:
            chosen = [c for c in reader.connections if c.topic in topics]
            found = reader.messages(connections=chosen) if chosen else iter(())
            while True:
                with _in_words(path):
                    one = next(found, None)
                    message = None if one is None else deserialize(one[2], one[0].msgtype)
                if one is None:
                    return
                yield one[0].topic, one[1], message

        yield {c.topic: c.msgtype for c in reader.connections}, messages
    finally:
        reader.close()


@contextmanager
def _in_words(path: Path) -> Iterator[None]:
    """Turn errors of the library, which are of many kinds for damaged files, into one."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(
            f"{path}: is not a complete recording ({reason:.200}); want {', '.join(SUFFIXES)} or a rosbag's folder"
        ) from error


def stamp_of(message: Any, recorded: int) -> int:
    """Return the time of a message, ns: its header's, or that of the recording."""
    header = getattr(message, "header", None)
    return recorded if header is None else int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def picture_in(message: Any, where: str) -> Image:
    """Return the picture of an image message, (h, w) grey or (h, w, 3) RGB, uint8.

    Raises:
        InputError: it cannot be read; the message starts with `where`.
    """
    return decode_image(bytes(message.data), where) if hasattr(message, "format") else _raw(message, where)


def _raw(message: Any, where: str) -> Image:
    """Return an uncompressed image."""
    channels = {"rgb8": 3, "bgr8": 3, "mono8": 1, "8UC1": 1, "8UC3": 3}.get(message.encoding)
    height, width, step = int(message.height), int(message.width), int(message.step)
    if channels is None:
        raise InputError(f"{where}: encoding is {message.encoding!r:.40}, want rgb8, bgr8 or mono8")
    data = np.frombuffer(bytes(message.data), np.uint8)
    if step < width * channels or height * step > len(data) or not height * width:
        raise InputError(f"{where}: has {len(data):,} bytes for {width}×{height} px of {message.encoding}")
    image = (
        data[: height * step].reshape(height, step)[:, : width * channels].reshape(height, width, channels)
    )
    if channels == 1:
        return image[..., 0]
    return np.ascontiguousarray(image[..., ::-1] if message.encoding in ("bgr8", "8UC3") else image)


@dataclass(frozen=True)
class Footage:
    """The pictures of one camera in a recording, as a video.

    Attributes:
        path: the file or folder.
        topic: of the pictures.
        width, height: px.
        fps: pictures per second, on average.
        frames: number of pictures.
    """

    path: Path
    topic: str
    width: int
    height: int
    fps: float
    frames: int

    @property
    def name(self) -> str:
        """The file and the topic."""
        return f"{self.path}:{self.topic}"

    @property
    def file(self) -> Path:
        """A path beside the recording that names the camera; there is no such file."""
        camera = self.topic.removesuffix("/compressed").replace("/", "_")
        return self.path.with_name(f"{self.path.stem}{camera}{self.path.suffix}")

    def read(self, step: int = 1) -> Iterator[VideoFrame]:
        """Yield every `step`-th picture, the first one included, at its time since the first.

        Raises:
            InputError: see `footage_in`; or a picture is of another size than the first.
        """
        start, last = None, 0.0
        for number, (stamp, message) in enumerate(_pictures(self.path, self.topic)):
            start = stamp if start is None else start
            last = max(last, (stamp - start) / 1e9)
            if number % step == 0:
                where = f"{self.path}: {self.topic}: image {number + 1}"
                image = picture_in(message, where)
                if image.shape[:2] != (self.height, self.width):
                    size = f"{image.shape[1]}×{image.shape[0]}"
                    raise InputError(f"{where} is {size} px, the first {self.width}×{self.height}")
                yield VideoFrame(number, last, image if image.ndim == 3 else np.stack([image] * 3, axis=2))


def footage_in(path: Path) -> list[Footage]:
    """Return the footage of every camera in a recording that has pictures, by topic.

    Raises:
        InputError: the recording or a first picture cannot be read, or there are no pictures.
    """
    with open_recording(path) as (types, _):
        topics = sorted(topic for topic, kind in types.items() if kind in (IMAGE, COMPRESSED_IMAGE))
    found = []
    for topic in topics:
        pictures = _pictures(path, topic)
        first = next(pictures, None)
        if first is None:
            continue
        height, width = picture_in(first[1], f"{path}: {topic}: image 1").shape[:2]
        stamps = [first[0], *(stamp for stamp, _ in pictures)]
        seconds = (stamps[-1] - stamps[0]) / 1e9
        fps = (len(stamps) - 1) / seconds if seconds > 0.0 else USUAL_FPS
        found.append(Footage(path, topic, width, height, fps, len(stamps)))
    if not found:
        there = ", ".join(sorted(f"{topic} ({kind})" for topic, kind in types.items())[:12]) or "nothing"
        raise InputError(f"{path}: has no pictures, want {IMAGE} or {COMPRESSED_IMAGE}; it has {there}")
    return found


def _pictures(path: Path, topic: str) -> Iterator[tuple[int, Any]]:
    with open_recording(path) as (_, messages):
        for _, recorded, message in messages({topic}):
            yield stamp_of(message, recorded), message
