"""Run an unknown network once in a process of its own: OpenCV does not survive every damaged file."""

from __future__ import annotations

import hashlib
import subprocess

from parkenv.errors import InputError
from parkenv.files.onnx_file import LONGEST_S, last_words, run_apart

_CODE = """
import sys
import cv2, numpy
shape = [int(word) for word in sys.argv[1:]]
cv2.setNumThreads(1)
net = cv2.dnn.readNetFromONNX(numpy.frombuffer(sys.stdin.buffer.read(), numpy.uint8))
net.setInput(numpy.full(shape, 0.5, numpy.float32))
net.forward(list(net.getUnconnectedOutLayersNames()))
"""
_passed: set[tuple[str, tuple[int, ...]]] = set()


def require_runs(data: bytes, name: str, shape: tuple[int, ...]) -> None:
    """Check that OpenCV runs a network, once for each network and process.

    Args:
        data: the content of its file.
        name: of the file, for messages.
        shape: of the input.

    Raises:
        InputError: OpenCV refuses it or crashes, or it takes too much time or memory.
    """
    key = hashlib.sha256(data).hexdigest(), shape
    if key in _passed:
        return
    try:
        done = run_apart(_CODE, data, *shape)
    except subprocess.TimeoutExpired as error:
        raise InputError(f"{name}: takes more than {LONGEST_S} s for an image of shape {shape}") from error
    if done.returncode:
        raise InputError(
            f"{name}: OpenCV cannot run this network with an input of shape {shape}: {last_words(done):.300}"
        )
    _passed.add(key)
