"""Read messages, and the pictures among them, from MCAP files and rosbags, by the library rosbags."""

import bz2
import functools
import io
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from itertools import accumulate
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO

import numpy as np

from parkenv.compiled.arrays import Image
from parkenv.errors import InputError, with_extra
from parkenv.files.images import decode_image
from parkenv.files.limited_reading import Counted, read_yaml, require_file
from parkenv.files.videos import USUAL_FPS, VideoFrame

# Selects columns that take no room in the file, whatever they hold: generated ones, and those of virtual tables.
_COMPUTED = """
SELECT of.name, "column".name FROM sqlite_master AS of, pragma_table_xinfo(of.name) AS "column"
WHERE of.type = 'table' AND "column".hidden
"""

Messages = Callable[[set[str]], Iterator[tuple[str, int, Any]]]

SUFFIXES = (".mcap", ".db3", ".bag")
MAX_PART_BYTES = 256_000_000  # maximum size of a chunk or a message, unpacked
# Maximum size, unpacked, of chunks that overlap in time, which are read at the same time.
MAX_MERGED_BYTES = 1_000_000_000
# Maximum size of a packed file of a rosbag, unpacked, as a multiple of its own size, beside 1 MB.
MAX_GROWTH = 100
_NO_PICTURE = re.compile(r"(?i)16|32|64|mono16|bayer|h26|hevc|av1|vp9")  # depth, colour mosaics, films
_OTHER_PICTURES = re.compile(r"(?i)image|video|packet")  # in names of types of other transports of pictures
IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
SCAN, CLOUD = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2"
CAMERA_INFO, IMU, NAV_FIX = (f"sensor_msgs/msg/{name}" for name in ("CameraInfo", "Imu", "NavSatFix"))
TRANSFORMS = "tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"
POSE_2D = "geometry_msgs/msg/Pose2D"
POSES = (
    POSE_2D, "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/Odometry",
)  # fmt: skip


def is_recording(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES or (path / "metadata.yaml").is_file()


def require_rosbags() -> None:
    with with_extra("a recorded drive", "bags"):
        import rosbags.rosbag2  # noqa: F401


@contextmanager
def open_recording(path: Path) -> Iterator[tuple[dict[str, str], Messages]]:
    """Open an MCAP file, a rosbag of ROS 2 (folder, .mcap or .db3) or of ROS 1 (.bag).

    Yields the type of each topic, and a function that reads the messages of some topics in order: topic, ns, message.
    """
    require_file(path)
    require_rosbags()
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    _limit_library()
    if path.is_dir():
        for file in path.iterdir():
            require_file(file)
        read_yaml(path / "metadata.yaml")
    is_ros1 = path.suffix == ".bag"
    # Types are those of ROS, not what the file says they are.
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    for name in TRANSFORMS:
        if name not in store.types:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
    deserialize = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr

    with _in_words(path):
        reader: Any = (Reader1 if is_ros1 else Reader2)(path)
        reader.open()
    try:
        if not is_ros1:
            for storage in getattr(reader.storage, "storages", [reader.storage]):
                _require_few_overlaps(path, getattr(storage, "chunks", ()))

        def messages(topics: set[str]) -> Iterator[tuple[str, int, Any]]:
            chosen = [c for c in reader.connections if c.topic in topics]
            stored = reader.messages(connections=chosen) if chosen else iter(())
            while True:
                with _in_words(path):
                    connection, stamp, data = next(stored, (None, 0, b""))
                    message = connection and deserialize(data, connection.msgtype)
                if connection is None:
                    return
                yield connection.topic, stamp, message

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


@functools.cache
def _limit_library() -> None:
    """Let the library, wherever it unpacks, do so within limits, and read plain tables of databases only."""
    apsw, lz4 = import_module("apsw"), import_module("lz4.frame")
    folders: Any = import_module("rosbags.rosbag2.reader")
    mcap, bags = import_module("rosbags.rosbag2.storage_mcap"), import_module("rosbags.rosbag1.reader")
    zstd = folders.zstd
    makers = {"zstd": zstd.ZstdDecompressor, "lz4": lz4.LZ4FrameDecompressor, "bz2": bz2.BZ2Decompressor}
    for unpackers in (mcap.DECOMPRESSORS, bags.decompressors):
        for name in unpackers.keys() - {"", "none"}:
            unpackers[name] = functools.partial(_unpacked, makers[name])

    def open_packed(file: BinaryIO, mode: str) -> io.RawIOBase:
        most = 1_000_000 + MAX_GROWTH * os.fstat(file.fileno()).st_size
        return Counted(zstd.open(file, mode), most, file.name)

    folders.zstd = SimpleNamespace(
        open=open_packed, decompress=functools.partial(_unpacked, zstd.ZstdDecompressor)
    )

    def limit_database(connection: Any) -> None:
        connection.limit(apsw.SQLITE_LIMIT_LENGTH, MAX_PART_BYTES)
        for table, column in connection.execute(_COMPUTED):
            raise ValueError(f"column {column!r:.40} of {table!r:.40} is computed, want stored values")

    apsw.connection_hooks.append(limit_database)


def _unpacked(make: Callable[[], Any], data: bytes, most: int = MAX_PART_BYTES) -> bytes:
    """Return the content of compressed data, one or more frames, within limits, else raise ValueError."""
    most = min(most, MAX_PART_BYTES)
    content = b""
    while data:
        unpacker = make()
        content += unpacker.decompress(data, most - len(content) + 1)
        if len(content) > most:
            raise ValueError(f"a chunk or message unpacks to more than {most:,} bytes")
        if not unpacker.eof:
            raise ValueError("a chunk or message ends too soon")
        data = unpacker.unused_data or b""
    return content


def _require_few_overlaps(path: Path, chunks: Any) -> None:
    if len({chunk.chunk_start_offset for chunk in chunks}) < len(chunks):
        raise InputError(f"{path}: lists a chunk twice")
    changes = [(chunk.message_start_time, chunk.uncompressed_size) for chunk in chunks]
    changes += [(chunk.message_end_time + 1, -chunk.uncompressed_size) for chunk in chunks]
    held = max(accumulate(size for _, size in sorted(changes)), default=0)
    if held > MAX_MERGED_BYTES:
        raise InputError(
            f"{path}: has chunks of {held:,} bytes that overlap in time, want at most {MAX_MERGED_BYTES:,}"
        )


def stamp_of(message: Any, recorded: int) -> int:
    header = getattr(message, "header", None)
    return recorded if header is None else int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def picture_in(message: Any, where: str) -> Image:
    """Return the picture of an image message, (h, w) grey or (h, w, 3) RGB, uint8."""
    if not hasattr(message, "format"):
        return _raw(message, where)
    packed = message.format.partition("compressed ")
    if "compressedDepth" in message.format or _NO_PICTURE.match((packed[2] or packed[0]).strip()):
        raise InputError(
            f"{where}: format is {message.format!r:.60}, want a picture of 8 bits in colour or grey"
        )
    return decode_image(bytes(message.data), where)


def _raw(message: Any, where: str) -> Image:
    channels = {"rgb8": 3, "bgr8": 3, "mono8": 1, "8UC1": 1, "8UC3": 3}.get(message.encoding)
    height, width, step = int(message.height), int(message.width), int(message.step)
    if channels is None:
        raise InputError(f"{where}: encoding is {message.encoding!r:.40}, want rgb8, bgr8 or mono8")
    data = np.frombuffer(bytes(message.data), np.uint8)
    if step < width * channels or height * step > len(data) or not height * width:
        raise InputError(f"{where}: has {len(data):,} bytes for {width}×{height} px of {message.encoding}")
    rows = data[: height * step].reshape(height, step)
    image = rows[:, : width * channels].reshape(height, width, channels)
    if channels == 1:
        return image[..., 0]
    return np.ascontiguousarray(image[..., ::-1] if message.encoding in ("bgr8", "8UC3") else image)


@dataclass(frozen=True)
class Footage:
    """The pictures of one camera in a recording, as a video."""

    path: Path  # the file or folder
    topic: str
    width: int  # px
    height: int
    fps: float  # pictures per second, on average
    frames: int  # number of pictures

    @property
    def name(self) -> str:
        return f"{self.path}:{self.topic}"

    @property
    def file(self) -> Path:
        """A path beside the recording that names the camera; there is no such file."""
        camera = self.topic.removesuffix("/compressed").replace("/", "_")
        return self.path.with_name(f"{self.path.stem}{camera}{self.path.suffix}")

    def read(self, step: int = 1) -> Iterator[VideoFrame]:
        """Yield every `step`-th picture, the first one included, at its time since the first."""
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


def footage_in(path: Path) -> tuple[list[Footage], dict[str, str]]:
    """Return the cameras of a recording, and topics with pictures that are not read, with the reason."""
    with open_recording(path) as (types, _):
        topics = {
            topic: kind
            for topic, kind in sorted(types.items())
            if _OTHER_PICTURES.search(kind.split("/")[-1])
        }
    cameras, others = [], dict[str, str]()
    for topic, kind in topics.items():
        if kind not in (IMAGE, COMPRESSED_IMAGE):
            others[topic] = f"is a {kind}, want {IMAGE} or {COMPRESSED_IMAGE}"
            continue
        pictures = _pictures(path, topic)
        start, message = next(pictures, (0, None))
        if message is None:
            others[topic] = "has no messages"
            continue
        try:
            height, width = picture_in(message, "image 1").shape[:2]
        except InputError as error:
            others[topic] = str(error)
            continue
        stamps = [start, *(stamp for stamp, _ in pictures)]
        seconds = (stamps[-1] - stamps[0]) / 1e9
        fps = (len(stamps) - 1) / seconds if seconds > 0.0 else USUAL_FPS
        cameras.append(Footage(path, topic, width, height, fps, len(stamps)))
    if not cameras:
        there = [f"{topic} ({others.get(topic, kind)})" for topic, kind in sorted(types.items())]
        raise InputError(
            f"{path}: has no pictures, want {IMAGE} or {COMPRESSED_IMAGE}; it has {', '.join(there[:12]) or 'nothing'}"
        )
    return cameras, others


def _pictures(path: Path, topic: str) -> Iterator[tuple[int, Any]]:
    with open_recording(path) as (_, messages):
        for _, recorded, message in messages({topic}):
            yield stamp_of(message, recorded), message
