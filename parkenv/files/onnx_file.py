"""Read what an ONNX file says of itself: its inputs, outputs and metadata; the network is left to a runtime."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from parkenv.errors import InputError
from parkenv.files.limited_reading import read_bytes

MAX_ONNX_BYTES = 256_000_000
"""Maximum size of an ONNX file."""


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
    """Parse the content of an ONNX file, a protobuf message of numbers and text; see `read_onnx`."""
    from google.protobuf.message import DecodeError
    from onnx import ModelProto, TensorProto

    try:
        model = ModelProto.FromString(data)
    except DecodeError as error:
        raise InputError(f"{name}: is no whole ONNX file; want an exported network") from error
    graph = model.graph
    if not graph.input or not graph.output:
        raise InputError(f"{name}: has a graph without input or output; want an exported network")
    attributes = (attribute.t for node in graph.node for attribute in node.attribute)
    if any(tensor.data_location == TensorProto.EXTERNAL for tensor in (*graph.initializer, *attributes)):
        raise InputError(f"{name}: keeps its weights in other files; export it as a single file")
    given = {tensor.name for tensor in graph.initializer}
    return OnnxFile(
        name,
        data,
        inputs=_values(value for value in graph.input if value.name not in given),
        outputs=_values(graph.output),
        metadata={pair.key: pair.value for pair in model.metadata_props},
    )


def _values(protos: Iterable[Any]) -> tuple[OnnxValue, ...]:
    from onnx import TensorProto

    found = []
    for proto in protos:
        tensor = proto.type.tensor_type
        sizes = (dimension.dim_value for dimension in tensor.shape.dim)
        shape = tuple(size if 0 < size < 1 << 31 else None for size in sizes)
        found.append(OnnxValue(proto.name, tensor.elem_type == TensorProto.FLOAT, shape))
    return tuple(found)
