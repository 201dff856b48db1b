"""The network `net`: it scores the centre of a car in every 8×8 pixels, with the car's box, view and visible fraction.

After CenterNet (Zhou, Wang and Krähenbühl, *Objects as Points*, 2019), with TTFNet's boxes around the centre (Liu et
al., *Training-Time-Friendly Network for Real-Time Object Detection*, 2020). PyTorch is needed to train it only; it runs
as an ONNX file, see `onnx_detector`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

STRIDE = 8
"""Pixels of the input for a cell of the output."""
INPUT = (640, 480)
"""Width and height of the input in the file, px; the weights fit any multiple of 32."""
GREY_MEAN, GREY_STD = 114.0, 64.0
OUTPUTS = 9
"""Of a cell: score, left, top, right, bottom, three views (`sim_sensors.ground_truth.View`), visible fraction."""

_WIDTHS = (8, 24, 48, 80, 96)  # channels at 1/2, 1/4, ... 1/32 of the input's size
_BLOCKS = (0, 1, 2, 2)  # residual blocks at 1/4, ... 1/32
_NECK, _HEAD = 64, 48  # channels of the way back up, and of the last layer
_RARE = -4.0  # first bias of the scores: centres are rare
_REACH = 16.0  # px, exp(0) of a box's sides


class _Layer(nn.Module):
    """Convolution and batch normalization."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        made: Tensor = self.norm(self.conv(x))
        return made

    def folded(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return weights and biases of one convolution that does both."""
        norm = self.norm
        scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)  # type: ignore[arg-type, operator]
        bias = norm.bias - norm.running_mean * scale  # type: ignore[operator]
        return (self.conv.weight * scale[:, None, None, None]).detach().numpy(), bias.detach().numpy()


class _Block(nn.Module):
    """Two convolutions around which the input is carried."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = _Layer(width, width), _Layer(width, width)
        nn.init.zeros_(self.second.norm.weight)  # a block begins as nothing

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(x + self.second(torch.relu(self.first(x))))


class _Stage(nn.Module):
    """Halve the size, then blocks."""

    def __init__(self, inputs: int, outputs: int, blocks: int) -> None:
        super().__init__()
        self.down = _Layer(inputs, outputs, stride=2)
        self.blocks = nn.ModuleList(_Block(outputs) for _ in range(blocks))

    def forward(self, x: Tensor) -> Tensor:
        x = torch.relu(self.down(x))
        for block in self.blocks:
            x = block(x)
        return x


class CenterNetwork(nn.Module):
    """A small residual network down to 1/32 of the input's size, and back up to 1/8."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = _Layer(1, _WIDTHS[0], kernel=5, stride=2)
        self.stages = nn.ModuleList(
            _Stage(inputs, outputs, blocks)
            for inputs, outputs, blocks in zip(_WIDTHS[:-1], _WIDTHS[1:], _BLOCKS, strict=True)
        )
        self.across = nn.ModuleList(_Layer(width, _NECK, kernel=1) for width in _WIDTHS[2:])
        self.smooth = nn.ModuleList([_Layer(_NECK, _HEAD), _Layer(_NECK, _NECK)])
        self.head = nn.Conv2d(_HEAD, OUTPUTS, 1)
        nn.init.normal_(self.head.weight, std=0.01)
        self.head.bias = nn.Parameter(torch.tensor([_RARE] + [0.0] * (OUTPUTS - 1)))

    def forward(self, images: Tensor) -> Tensor:
        """Return the numbers of every cell before their last functions.

        Args:
            images: (b, 1, h, w) float32, grey levels less `GREY_MEAN`, divided by `GREY_STD`; h and w are multiples of
                32.

        Returns:
            (b, `OUTPUTS`, h / 8, w / 8): logit of the score, logarithms of the distances from the cell's centre to the
            box's sides in 16 px, logits of the views, logit of the visible fraction.
        """
        x, levels = torch.relu(self.stem(images)), []
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        # Back up from 1/32 over 1/16 to 1/8.
        x = torch.relu(self.across[2](levels[3]))
        for level in (1, 0):
            x = nn.functional.interpolate(x, scale_factor=2, mode="nearest")
            x = x + torch.relu(self.across[level](levels[level + 1]))
            x = torch.relu(self.smooth[level](x))
        made: Tensor = self.head(x)
        return made


def sides(logarithms: Tensor) -> Tensor:
    """Return the distances from a cell's centre to its box's sides, px."""
    return _REACH * torch.exp(torch.clamp(logarithms, -4.0, 4.0))


def to_onnx(network: CenterNetwork, calibration: tuple[float, float], card: Mapping[str, object]) -> bytes:
    """Return the trained network as an ONNX file of the layout `centers`, with weights of 16 bits.

    Args:
        network: the network.
        calibration: slope and offset of the score's logit, so that it becomes a probability.
        card: the model card, for the file's metadata.
    """
    from onnx import TensorProto, checker, helper, numpy_helper

    nodes, given = [], []

    def constant(name: str, values: NDArray[np.generic]) -> str:
        given.append(numpy_helper.from_array(values, name))
        return name

    def weights(name: str, values: NDArray[np.float32]) -> str:
        constant(f"{name}.half", values.astype(np.float16))
        nodes.append(helper.make_node("Cast", [f"{name}.half"], [name], to=TensorProto.FLOAT))
        return name

    def node(kind: str, inputs: list[str], output: str, **settings: object) -> str:
        nodes.append(helper.make_node(kind, inputs, [output], name=output, **settings))
        return output

    def layer(x: str, name: str, made_of: _Layer, *, relu: bool = True) -> str:
        kernel, bias = made_of.folded()
        size, stride = kernel.shape[2], made_of.conv.stride[0]
        inputs = [x, weights(f"{name}.weight", kernel), constant(f"{name}.bias", bias)]
        x = node("Conv", inputs, name, kernel_shape=[size, size], strides=[stride, stride],
                 pads=[size // 2] * 4)  # fmt: skip
        return node("Relu", [x], f"{name}.relu") if relu else x

    network = network.eval()
    x, levels = layer("image", "stem", network.stem), []
    for i, stage in enumerate(network.stages):
        x = layer(x, f"stage{i}", stage.down)  # type: ignore[arg-type]
        for j, block in enumerate(stage.blocks):  # type: ignore[arg-type]
            y = layer(x, f"stage{i}.{j}.first", block.first)
            y = layer(y, f"stage{i}.{j}.second", block.second, relu=False)
            x = node("Relu", [node("Add", [x, y], f"stage{i}.{j}.sum")], f"stage{i}.{j}")
        levels.append(x)
    x = layer(levels[3], "across2", network.across[2])  # type: ignore[arg-type]
    twice = constant("twice", np.array([1.0, 1.0, 2.0, 2.0], np.float32))
    for level in (1, 0):
        x = node("Resize", [x, "", twice], f"up{level}", mode="nearest", nearest_mode="floor",
                 coordinate_transformation_mode="asymmetric")  # fmt: skip
        y = layer(levels[level + 1], f"across{level}", network.across[level])  # type: ignore[arg-type]
        x = layer(node("Add", [x, y], f"sum{level}"), f"smooth{level}", network.smooth[level])  # type: ignore[arg-type]
    kernel, bias = (p.detach().numpy().copy() for p in network.head.parameters())
    kernel[0] *= calibration[0]
    bias[0] = calibration[0] * bias[0] + calibration[1]

    def part(name: str, first: int, last: int) -> str:
        inputs = [
            x,
            weights(f"{name}.weight", kernel[first:last]),
            constant(f"{name}.bias", bias[first:last]),
        ]
        return node("Conv", inputs, name, kernel_shape=[1, 1])

    score = node("Sigmoid", [part("score.logit", 0, 1)], "score")
    low, high = (constant(name, np.array(v, np.float32)) for name, v in (("least", -4.0), ("most", 4.0)))
    reach = constant("reach", np.array(_REACH, np.float32))
    grown = node("Exp", [node("Clip", [part("sides.log", 1, 5), low, high], "sides.bounded")], "sides.grown")
    views = node("Softmax", [part("view.logit", 5, 8)], "view", axis=1)
    visible = node("Sigmoid", [part("visible.logit", 8, 9)], "visible")
    node("Concat", [score, node("Mul", [grown, reach], "sides"), views, visible], "cells", axis=1)
    width, height = INPUT
    graph = helper.make_graph(
        nodes, "net",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 1, height, width])],
        [helper.make_tensor_value_info("cells", TensorProto.FLOAT, [1, OUTPUTS, height // STRIDE, width // STRIDE])],
        given,
    )  # fmt: skip
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8, producer_name="parkenv"
    )
    helper.set_model_props(model, {key: json.dumps(value) for key, value in card.items()})
    checker.check_model(model, full_check=True)
    data: bytes = model.SerializeToString()
    return data
