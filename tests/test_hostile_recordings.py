"""Recordings of a stranger: they unpack within limits, no pipe is waited for, and nothing is computed for them."""

import os
import sqlite3

import numpy as np
import pytest

from parkenv import InputError
from parkenv.files import recordings
from parkenv.files.recordings import footage_in, open_recording

pytest.importorskip("rosbags")
from rosbags.rosbag1 import Writer as WriterOfRos1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

KIND = "sensor_msgs/msg/CompressedImage"
LARGE = 3_000_000
"""Bytes of a message that hardly take room when they are packed."""
PACKED = [("MCAP", "STORAGE"), ("MCAP", "MESSAGE"), ("SQLITE3", "MESSAGE"), ("ROS1", "BZ2"), ("ROS1", "LZ4")]


def message(store, size, *first):
    """A message whose header has `first` fields of its own."""
    of = store.types
    header = of["std_msgs/msg/Header"](*first, of["builtin_interfaces/msg/Time"](1, 0), "camera")
    return of[KIND](header=header, format="png", data=np.zeros(size, np.uint8))


def bag(folder, plugin="MCAP", mode="STORAGE", size=LARGE, stamps=(1,)):
    """A rosbag of ROS 2 with messages of so many bytes."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin[plugin])
    if mode != "NONE":
        writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with writer:
        camera = writer.add_connection("/camera", KIND, typestore=store)
        for stamp in stamps:
            writer.write(camera, stamp * 10**9, store.serialize_cdr(message(store, size), KIND))
    return folder


def bag_of_ros1(file, compression):
    store, writer = get_typestore(Stores.ROS1_NOETIC), WriterOfRos1(file)
    writer.set_compression(WriterOfRos1.CompressionFormat[compression])
    with writer:
        camera = writer.add_connection("/camera", KIND, typestore=store)
        writer.write(camera, 10**9, store.serialize_ros1(message(store, LARGE, 0), KIND))
    return file


def sizes(path):
    """The sizes of all messages' data."""
    with open_recording(path) as (types, messages):
        return [len(message.data) for _, _, message in messages(set(types))]


@pytest.mark.parametrize(("plugin", "mode"), PACKED)
def test_a_chunk_or_message_is_unpacked_up_to_a_limit(tmp_path, monkeypatch, plugin, mode):
    ros1 = plugin == "ROS1"
    path = bag_of_ros1(tmp_path / "1.bag", mode) if ros1 else bag(tmp_path / "bag", plugin, mode)
    assert sizes(path) == [LARGE]
    monkeypatch.setattr(recordings, "MAX_PART_BYTES", LARGE - 1)
    with pytest.raises(InputError, match=r"bag: .* unpacks to more than 2,999,999 bytes"):
        sizes(path)


def test_a_packed_file_grows_a_hundredfold_at_most(tmp_path):
    assert sizes(bag(tmp_path / "small", "SQLITE3", "FILE", size=500_000)) == [500_000]
    path = bag(tmp_path / "bag", "SQLITE3", "FILE")
    with pytest.raises(InputError, match=r"bag\.db3\.zstd: has more than [\d,]+ bytes, the most"):
        sizes(path)


@pytest.mark.parametrize("name", ["a.mcap", "a.db3", "a.bag", "bag/bag.mcap", "bag/metadata.yaml"])
def test_a_pipe_is_not_waited_for(tmp_path, name):
    path = tmp_path / name
    if "/" in name:
        bag(path.parent, size=10)
        path.unlink()
    os.mkfifo(path)
    with pytest.raises(InputError, match=r"is a pipe or a device, want a file"):
        footage_in(tmp_path / "bag" if "/" in name else path)


def test_columns_that_are_computed_are_refused(tmp_path):
    folder = bag(tmp_path / "bag", "SQLITE3", "NONE", size=10)
    file = folder / "bag.db3"
    assert sizes(folder) == sizes(file) == [10]
    with sqlite3.connect(file) as database:
        database.executescript(
            "ALTER TABLE messages RENAME TO old;"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
            " data BLOB AS (zeroblob(200000000)));"
            "INSERT INTO messages SELECT id, topic_id, timestamp FROM old; DROP TABLE old;"
        )
    for path in (file, folder):
        with pytest.raises(InputError, match="column 'data' of 'messages' is computed"):
            sizes(path)
