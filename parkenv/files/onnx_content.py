"""What an ONNX file says of itself. This module also runs in a process of its own, and imports nothing of parkenv."""

import sys
from json import dumps
from typing import Any


def content_of(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return a description of a network, and the network with nothing in its data that is not part of the description.

    What the reader here does not know, another reader may understand: it is left out.

    Args:
        data: content of the file, a protobuf message of numbers and text.

    Returns:
        `inputs` (without those that have a value in the file) and `outputs`, each with `name`, `is_float` and `shape`
        (None for a size that is left open), and `metadata`; or `fault`, why the file is refused. And the data.
    """
    from google.protobuf.message import DecodeError
    from onnx import ModelProto

    try:
        model = ModelProto.FromString(data)
    except DecodeError:
        return {"fault": "is no whole ONNX file; want an exported network"}, b""
    graph = model.graph
    if not graph.input or not graph.output:
        return {"fault": "has a graph without input or output; want an exported network"}, b""
    if _uses_other_files(model):
        return {"fault": "keeps its weights in other files; export it as a single file"}, b""
    given = {tensor.name for tensor in graph.initializer}
    described = {
        "inputs": [_described(value) for value in graph.input if value.name not in given],
        "outputs": [_described(value) for value in graph.output],
        "metadata": {pair.key: pair.value for pair in model.metadata_props},
    }
    model.DiscardUnknownFields()
    return described, model.SerializeToString()


def _uses_other_files(model: Any) -> bool:
    """Whether any tensor, in whatever part of the model, has its numbers in another file."""
    from google.protobuf.message import Message
    from onnx import TensorProto

    waiting = [model]
    while waiting:
        message = waiting.pop()
        if isinstance(message, TensorProto) and (message.data_location or message.external_data):
            return True
        for field, value in message.ListFields():
            if isinstance(value, Message):
                waiting.append(value)
            elif field.message_type is not None:
                waiting.extend(value)
    return False


def _described(proto: Any) -> dict[str, Any]:
    from onnx import TensorProto

    tensor = proto.type.tensor_type
    sizes = (dimension.dim_value for dimension in tensor.shape.dim)
    shape = [size if 0 < size < 1 << 31 else None for size in sizes]
    return {"name": proto.name, "is_float": tensor.elem_type == TensorProto.FLOAT, "shape": shape}


def main() -> None:
    """Describe the network on standard input: a line of JSON, then its data."""
    described, data = content_of(sys.stdin.buffer.read())
    sys.stdout.buffer.write(dumps(described).encode() + b"\n" + data)
