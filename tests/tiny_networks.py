"""Tiny ONNX networks of the YOLO kind, and what they put out, in plain NumPy."""

import numpy as np
from onnx import TensorProto, helper, numpy_helper

SIZE = 64  # px, of their square input
STRIDES = (8, 16, 32)


class Tiny:
    """A convolution for each stride and a sigmoid, scaled: numbers of each cell, (1, 4 + classes, n).

    Args:
        classes: number of class scores.
        channels: of the input.
        is_transposed: put out (1, n, 4 + classes).
        last: a value by which the outputs are multiplied, such as NaN.
    """

    def __init__(self, classes=3, channels=3, is_transposed=False, last=None):
        self.channels, self.is_transposed, self.last = channels, is_transposed, last
        self.scale = np.array([64.0, 64.0, 48.0, 24.0] + [1.0] * classes, np.float32)
        rng = np.random.default_rng(0)
        shapes = [(len(self.scale), channels, stride, stride) for stride in STRIDES]
        self.weights = [rng.normal(0, 1.2, shape).astype(np.float32) / shape[2] for shape in shapes]

    def rows(self, fed):
        """Return the candidates, (n, numbers), of an input, (1, channels, SIZE, SIZE)."""
        found = []
        for weights, stride in zip(self.weights, STRIDES, strict=True):
            n = fed.shape[2] // stride
            patches = fed[0].reshape(self.channels, n, stride, n, stride)
            found.append(np.einsum("kchw,cihjw->ijk", weights, patches).reshape(n * n, -1))
        return 1.0 / (1.0 + np.exp(-np.concatenate(found))) * self.scale

    def save(self, path):
        """Write the network, with the settings that it needs beside it."""
        path.write_bytes(self.model().SerializeToString())
        path.with_suffix(".toml").write_text(f"size = [{SIZE}, {SIZE}]\ncars = [0, 2]\n")
        return str(path)

    def model(self):
        """Return the network as ONNX."""
        numbers = len(self.scale)
        given = {"scale": self.scale.reshape(1, -1, 1), "columns": np.array([1, numbers, -1])}
        nodes, parts = [], []
        for i, (weights, stride) in enumerate(zip(self.weights, STRIDES, strict=True)):
            given[f"w{i}"] = weights
            nodes += [
                helper.make_node("Conv", ["images", f"w{i}"], [f"c{i}"], strides=[stride, stride]),
                helper.make_node("Reshape", [f"c{i}", "columns"], [f"r{i}"]),
            ]
            parts.append(f"r{i}")
        nodes += [
            helper.make_node("Concat", parts, ["all"], axis=2),
            helper.make_node("Sigmoid", ["all"], ["between"]),
            helper.make_node("Mul", ["between", "scale"], ["scaled"]),
        ]
        given["last"] = np.full(1, 1.0 if self.last is None else self.last, np.float32)
        nodes.append(helper.make_node("Mul", ["scaled", "last"], ["made"]))
        order = [0, 2, 1] if self.is_transposed else [0, 1, 2]
        nodes.append(helper.make_node("Transpose", ["made"], ["output0"], perm=order))
        shape = (1, "n", numbers) if self.is_transposed else (1, numbers, "n")
        graph = helper.make_graph(
            nodes,
            "tiny",
            [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, self.channels, SIZE, SIZE])],
            [helper.make_tensor_value_info("output0", TensorProto.FLOAT, shape)],
            [numpy_helper.from_array(np.asarray(value), name) for name, value in given.items()],
        )
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
