"""Tiny ONNX networks with outputs of the YOLO and DETR kinds, and what they put out, in plain NumPy."""

import numpy as np
from onnx import TensorProto, helper, numpy_helper

SIZE = 64  # px, of their square input
STRIDES = (8, 16, 32)


class Tiny:
    """A convolution for each stride and a sigmoid, scaled: rows of numbers, one for each cell (and anchor).

    Args:
        layout: yolo, yolo5, boxes or detr.
        classes: number of class scores.
        channels: of the input.
        names: names of the classes in the metadata.
        is_open: leave the input's size open.
        last: a value that replaces the first number of the outputs, such as NaN.
    """

    def __init__(self, layout, classes=3, channels=3, names=None, is_open=False, last=None, seed=0):
        self.layout, self.channels, self.classes = layout, channels, classes
        self.names, self.is_open, self.last = names, is_open, last
        self.anchors = 3 if layout == "yolo5" else 1
        self.strides = STRIDES if layout in ("yolo", "yolo5") else (16,)
        tail = {"yolo": [1.0] * classes, "yolo5": [1.0] * (1 + classes), "boxes": [1.0, classes - 1.0]}
        corner = [30.0, 30.0, 64.0, 64.0] if layout == "boxes" else [64.0, 64.0, 48.0, 24.0]
        if layout == "detr":
            corner = [1.0, 1.0, 0.6, 0.4]
        self.scale = np.array(corner + tail.get(layout, [4.0] * classes), np.float32)
        width = len(self.scale) * self.anchors
        rng = np.random.default_rng(seed)
        self.weights = [
            rng.normal(0, 1.2, (width, channels, s, s)).astype(np.float32) / s for s in self.strides
        ]

    def rows(self, fed):
        """Return the candidates, (n, numbers), of an input, (1, channels, SIZE, SIZE)."""
        found = []
        for weights, stride in zip(self.weights, self.strides, strict=True):
            n = fed.shape[2] // stride
            patches = fed[0].reshape(self.channels, n, stride, n, stride)
            made = np.einsum("kchw,cihjw->kij", weights, patches).reshape(
                self.anchors, len(self.scale), n * n
            )
            found.append(made.transpose(0, 2, 1).reshape(-1, len(self.scale)))
        rows = 1.0 / (1.0 + np.exp(-np.concatenate(found))) * self.scale
        if self.layout == "boxes":
            rows[:, 5] = np.floor(rows[:, 5] + 0.5)
        return rows

    def save(self, path):
        """Write the network."""
        path.write_bytes(self.model().SerializeToString())
        return str(path)

    def model(self):
        """Return the network as ONNX."""
        numbers = len(self.scale)
        given = {"scale": self.scale.reshape(1, 1, -1), "split": np.array([1, self.anchors, numbers, -1])}
        given["rows"] = np.array([1, -1, numbers])
        nodes, parts = [], []
        for i, (weights, stride) in enumerate(zip(self.weights, self.strides, strict=True)):
            given[f"w{i}"] = weights
            nodes += [
                helper.make_node("Conv", ["images", f"w{i}"], [f"c{i}"], strides=[stride, stride]),
                helper.make_node("Reshape", [f"c{i}", "split"], [f"s{i}"]),
                helper.make_node("Transpose", [f"s{i}"], [f"t{i}"], perm=[0, 1, 3, 2]),
                helper.make_node("Reshape", [f"t{i}", "rows"], [f"r{i}"]),
            ]
            parts.append(f"r{i}")
        nodes += [
            helper.make_node("Concat", parts, ["all"], axis=1),
            helper.make_node("Sigmoid", ["all"], ["between"]),
            helper.make_node("Mul", ["between", "scale"], ["scaled"]),
        ]
        if self.last is not None:
            given["last"] = np.full(1, self.last, np.float32)
            nodes.append(helper.make_node("Mul", ["scaled", "last"], ["spoilt"]))
        made = "scaled" if self.last is None else "spoilt"
        outputs = {"output0": (1, "n", numbers)}
        if self.layout == "yolo":
            nodes.append(helper.make_node("Transpose", [made], ["output0"], perm=[0, 2, 1]))
            outputs = {"output0": (1, numbers, "n")}
        elif self.layout == "yolo5":
            nodes.append(helper.make_node("Identity", [made], ["output0"]))
        elif self.layout == "boxes":
            given["sizes"] = np.array([5, 1])
            nodes += [
                helper.make_node("Split", [made, "sizes"], ["front", "class"], axis=2),
                helper.make_node("Round", ["class"], ["whole"]),
                helper.make_node("Concat", ["front", "whole"], ["output0"], axis=2),
            ]
        else:
            given["sizes"] = np.array([4, self.classes])
            nodes.append(helper.make_node("Split", [made, "sizes"], ["pred_boxes", "logits"], axis=2))
            outputs = {"pred_boxes": (1, "n", 4), "logits": (1, "n", self.classes)}
        sides = ["height", "width"] if self.is_open else [SIZE, SIZE]
        shape = ["batch" if self.is_open else 1, self.channels, *sides]
        graph = helper.make_graph(
            nodes,
            "tiny",
            [helper.make_tensor_value_info("images", TensorProto.FLOAT, shape)],
            [helper.make_tensor_value_info(name, TensorProto.FLOAT, its) for name, its in outputs.items()],
            [numpy_helper.from_array(np.asarray(value), name) for name, value in given.items()],
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
        if self.names is not None:
            helper.set_model_props(model, {"names": str(dict(enumerate(self.names)))})
        return model
