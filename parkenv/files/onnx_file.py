"""Read what an ONNX file says of itself: its inputs, outputs and metadata; the network is left to a runtime."""

from __future__ import annotations

import inspect
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from parkenv.errors import InputError
from parkenv.files import onnx_content
from parkenv.files.limited_reading import parse_json, read_bytes

MAX_ONNX_BYTES = 256_000_000
"""Maximum size of an ONNX file."""
MAX_HERE = 4_000_000
"""Maximum size of an ONNX file that is parsed in this process, which takes up to a hundred times its size in memory."""

LONGEST_S = 120
"""Maximum time of a process that reads a network, s."""
MOST_BYTES = 8 << 30
"""Maximum address space of such a process; where the system knows no such limit (Windows), there is none."""
_LIMITS = f"""
try:
    import resource
    resource.setrlimit(resource.RLIMIT_AS, ({MOST_BYTES}, {MOST_BYTES}))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except (ImportError, OSError, ValueError):
    pass
"""


@dataclass(frozen=True)
class OnnxValue:
    """An input or output of a network."""

    name: str
    is_float: bool  # whether it holds float32
    shape: tuple[int | None, ...]  # None for a size that the file leaves open


@dataclass(frozen=True)
class OnnxFile:
    """The content of an ONNX file, and what it says of itself."""

    name: str  # the file, for messages
    data: bytes  # the network, without what our reader does not know
    inputs: tuple[OnnxValue, ...]  # without those that have a value in the file
    outputs: tuple[OnnxValue, ...]
    metadata: dict[str, str]


def read_onnx(path: str | Path) -> OnnxFile:
    """Read an ONNX file of at most `MAX_ONNX_BYTES`.

    Raises:
        InputError: the file cannot be read, is no whole ONNX file, or keeps its weights in other files.
    """
    return parse_onnx(read_bytes(path, MAX_ONNX_BYTES), str(path))


def parse_onnx(data: bytes, name: str) -> OnnxFile:
    """Parse the content of an ONNX file; see `read_onnx`."""
    described, data = _content_apart(data, name) if len(data) > MAX_HERE else onnx_content.content_of(data)
    if "fault" in described:
        raise InputError(f"{name}: {described['fault']}")
    inputs, outputs = (
        tuple(OnnxValue(value["name"], value["is_float"], tuple(value["shape"])) for value in described[kind])
        for kind in ("inputs", "outputs")
    )
    return OnnxFile(name, data, inputs, outputs, described["metadata"])


def _content_apart(data: bytes, name: str) -> tuple[dict[str, Any], bytes]:
    """Return what `content_of` returns, in a process of its own."""
    try:
        done = run_apart(f"{inspect.getsource(onnx_content)}\nmain()\n", data)
    except subprocess.TimeoutExpired as error:
        raise InputError(f"{name}: takes more than {LONGEST_S} s to read") from error
    if done.returncode:
        raise InputError(f"{name}: cannot be read as an ONNX file: {last_words(done):.300}")
    described, _, content = done.stdout.partition(b"\n")
    return parse_json(described, name), content


def run_apart(code: str, data: bytes, *words: object) -> subprocess.CompletedProcess[bytes]:
    """Run Python code that reads `data` from its standard input; a crash ends its process only.

    Args:
        code: the code; it finds installed packages, and nothing in the working folder.
        data: what is read.
        words: the code's `sys.argv[1:]`.

    Raises:
        subprocess.TimeoutExpired: it takes too long.
    """
    command = [sys.executable, "-I", "-c", _LIMITS + code, *map(str, words)]
    return subprocess.run(command, input=data, capture_output=True, timeout=LONGEST_S, check=False)


def last_words(done: subprocess.CompletedProcess[bytes]) -> str:
    """Return why code has failed: the last line of its exception, or that it has crashed."""
    said = done.stderr.decode(errors="replace").strip().splitlines()
    # An exception ends with 1, a crash with a signal.
    return said[-1] if said and done.returncode == 1 else "it crashes; is the file whole?"
