"""Run an unknown network once in a process of its own: OpenCV does not survive every damaged file."""

from __future__ import annotations

import hashlib
import subprocess
import sys

from parkenv.errors import InputError

LONGEST_S = 120
"""Maximum time of the process, s."""
MOST_BYTES = 8 << 30
"""Maximum address space of the process; where the system knows no such limit (Windows), there is none."""
_CODE = f"""
try:
    import resource
    resource.setrlimit(resource.RLIMIT_AS, ({MOST_BYTES}, {MOST_BYTES}))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except (ImportError, OSError, ValueError):
    pass
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
    """
    key = hashlib.sha256(data).hexdigest(), shape
    if key in _passed:
        return
    # -I: the process finds installed packages, and nothing in the working folder.
    command = [sys.executable, "-I", "-c", _CODE, *map(str, shape)]
    try:
        done = subprocess.run(command, input=data, capture_output=True, timeout=LONGEST_S, check=False)
    except subprocess.TimeoutExpired as error:
        raise InputError(f"{name}: takes more than {LONGEST_S} s for an image of shape {shape}") from error
    if done.returncode:
        lines = done.stderr.decode(errors="replace").strip().splitlines()
        # An exception ends with 1, a crash with a signal.
        reason = lines[-1] if lines and done.returncode == 1 else "it crashes; is the file whole?"
        raise InputError(
            f"{name}: OpenCV cannot run this network with an input of shape {shape}: {reason:.300}"
        )
    _passed.add(key)
