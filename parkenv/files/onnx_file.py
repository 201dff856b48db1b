"""Read what an ONNX file says of itself: its inputs, outputs and metadata; the network is left to a runtime.

An ONNX file is a protobuf message: fields, each with a number, a wire type and a value, of which some are messages.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from parkenv.errors import InputError
from parkenv.files.limited_reading import read_bytes

MAX_ONNX_BYTES = 256_000_000
"""Maximum size of an ONNX file."""
_MOST_FIELDS = 1_000_000  # of one message

# Numbers of fields in onnx.proto.
_GRAPH, _METADATA = 7, 14  # of a model
_NODE, _INITIALIZER, _INPUT, _OUTPUT = 1, 5, 11, 12  # of a graph
_ATTRIBUTES, _TENSOR = 5, 5  # of a node, and of an attribute
_TENSOR_NAME, _DATA_LOCATION = 8, 14  # of a tensor
_EXTERNAL = 1
_FLOAT = 1  # element type


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
    data: bytes
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
    graphs: list[memoryview] = []
    metadata: dict[str, str] = {}
    inputs: list[OnnxValue] = []
    outputs: list[OnnxValue] = []
    given: set[str] = set()
    external = False
    try:
        for number, value in _fields(memoryview(data)):
            if number == _GRAPH:
                graphs.append(_message(value))
            elif number == _METADATA:
                pair = dict(_fields(_message(value)))
                metadata[_text(pair.get(1, b""))] = _text(pair.get(2, b""))
        if len(graphs) != 1:
            raise ValueError(f"{len(graphs)} graphs")
        for number, value in _fields(graphs[0]):
            if number == _INPUT:
                inputs.append(_value(_message(value)))
            elif number == _OUTPUT:
                outputs.append(_value(_message(value)))
            elif number == _INITIALIZER:
                tensor = dict(_fields(_message(value)))
                given.add(_text(tensor.get(_TENSOR_NAME, b"")))
                external |= tensor.get(_DATA_LOCATION) == _EXTERNAL
            elif number == _NODE:
                external |= _has_external_tensor(_message(value))
        if not inputs or not outputs:
            raise ValueError("a graph without input or output")
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError(f"{name}: is no whole ONNX file ({error}); want an exported network") from error
    if external:
        raise InputError(f"{name}: keeps its weights in other files; export it as a single file")
    return OnnxFile(name, data, tuple(v for v in inputs if v.name not in given), tuple(outputs), metadata)


def _fields(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Yield number and value of each field of a message: a whole number, or bytes."""
    at = 0
    for _ in range(_MOST_FIELDS):
        if at == len(data):
            return
        key, at = _varint(data, at)
        number, wire = key >> 3, key & 7
        if wire == 0:
            whole, at = _varint(data, at)
            yield number, whole
            continue
        if wire == 2:
            size, at = _varint(data, at)
        elif wire in (1, 5):
            size = 8 if wire == 1 else 4
        else:
            raise ValueError(f"byte {at} is of no known type")
        if number == 0 or at + size > len(data):
            raise ValueError(
                f"it ends within a part of {size:,} bytes" if number else "a part without number"
            )
        yield number, data[at : at + size]
        at += size
    raise ValueError(f"more than {_MOST_FIELDS:,} parts")


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """Return a whole number, and where it ends."""
    value = 0
    for k in range(10):
        if at + k >= len(data):
            raise ValueError("it ends within a number")
        byte = data[at + k]
        value |= (byte & 0x7F) << 7 * k
        if byte < 0x80:
            return value, at + k + 1
    raise ValueError("a number of more than 10 bytes")


def _message(value: int | memoryview) -> memoryview:
    if isinstance(value, int):
        raise ValueError("a number in place of a message")
    return value


def _text(value: int | memoryview | bytes) -> str:
    if isinstance(value, int):
        raise ValueError("a number in place of text")
    return bytes(value).decode()


def _value(data: memoryview) -> OnnxValue:
    """Return a `ValueInfoProto`."""
    info = dict(_fields(data))
    name = _text(info.get(1, b""))
    kind = dict(_fields(_message(info.get(2, memoryview(b"")))))
    tensor = dict(_fields(_message(kind.get(1, memoryview(b"")))))
    sizes: list[int | None] = []
    for number, dimension in _fields(_message(tensor.get(2, memoryview(b"")))):
        size = dict(_fields(_message(dimension))).get(1) if number == 1 else None
        sizes.append(size if isinstance(size, int) and 0 < size < 1 << 31 else None)
    return OnnxValue(name, tensor.get(1) == _FLOAT, tuple(sizes))


def _has_external_tensor(node: memoryview) -> bool:
    return any(
        number == _ATTRIBUTES
        and any(
            part == _TENSOR and dict(_fields(_message(tensor))).get(_DATA_LOCATION) == _EXTERNAL
            for part, tensor in _fields(_message(attribute))
        )
        for number, attribute in _fields(node)
    )
