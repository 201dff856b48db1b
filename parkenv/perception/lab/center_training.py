"""Train the network `net` on simulated pictures alone."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from parkenv.compiled.arrays import Float32Array
from parkenv.errors import InputError, require_whole
from parkenv.perception.detector import overlaps
from parkenv.perception.lab.center_network import GREY_MEAN, GREY_STD, STRIDE, CenterNetwork, sides, to_onnx
from parkenv.perception.lab.simulated_scenes import SimulatedScene, simulated_scenes
from parkenv.perception.lab.simulated_streets import FRAMES
from parkenv.perception.lab.training_crops import Example, ExampleMaker, draw_size

Progress = Callable[[str], None]

_SPREAD = 0.13  # standard deviation of a centre's peak, as a fraction of its box
_LEAST_SPREAD = 0.45  # cells
_BOX_FROM = 0.25  # height of the peak from which a cell learns the box
_VIEWS = 3
_BOX_WEIGHT, _VIEW_WEIGHT, _VISIBLE_WEIGHT = 3.0, 0.3, 0.3
_MOMENTUM = 0.9
_HELD_OUT = 25  # every how many-th street is held out
_SETTINGS = """\
# How parkenv feeds and reads the network of the same name.
layout = "centers"
channels = "grey"
mean = [{mean:.1f}]
std = [{std:.1f}]
enlarge = 2.0  # small pictures, at most
mirror = true
overlap = 0.45
"""


@dataclass(frozen=True)
class CenterTrainingSettings:
    """Parameters of the training."""

    steps: int = 9_000
    batch: int = 16
    rate: float = 0.02  # greatest learning rate of the kernels, reached after a twentieth of the steps
    other_rate: float = 2e-3  # the same for biases, normalizations and the last layer
    decay: float = 0.02  # weight decay of the kernels
    averaging: float = 0.998  # of the weights over the steps; the averages are the result
    held_out: int = 400  # examples of other streets on which the scores are calibrated
    textures: int = 160  # that backgrounds are cut from
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "held_out", "textures"):
            require_whole(name, getattr(self, name), least=1)
        require_whole("seed", self.seed)


@dataclass(frozen=True, eq=False)
class _Batch:
    """A batch of inputs and targets; cells are 8×8 px."""

    images: Tensor  # (b, 1, h, w)
    peak: Tensor  # (b, h/8, w/8), 1 in the centres of cars, less around them
    counts: Tensor  # (b, h/8, w/8), 0 where a car may be found or not
    sides: (
        Tensor  # (b, 4, h/8, w/8) px, from the cell's centre to the box of the car whose peak is the highest
    )
    view: Tensor  # (b, h/8, w/8)
    visible: Tensor  # (b, h/8, w/8)


@dataclass(frozen=True, eq=False)
class BuiltNetwork:
    """A trained network as files."""

    data: bytes  # the ONNX file
    settings: str  # the file beside it, see `parkenv.perception.onnx_detector.OnnxSettings`
    card: dict[str, object]  # the model card, also in the ONNX file's metadata


def build_network(
    streets: int,
    settings: CenterTrainingSettings,
    cache: Path | None = None,
    progress: Progress = lambda _: None,
) -> BuiltNetwork:
    """Draw the simulated pictures, train, calibrate on streets that are held out, and return the files.

    Args:
        streets: number of simulated streets, 2 or more; one in 25 is held out.
        settings: parameters of the training.
        cache: folder in which the pictures are kept.
        progress: called with one line now and then.

    Raises:
        InputError: fewer than 2 streets, or a damaged file in the folder.
    """
    if streets < 2:
        raise InputError(f"simulated is {streets}, want at least 2 streets")
    begun = time.monotonic()
    scenes = []
    for scene in simulated_scenes(streets, settings.seed, cache):
        scenes.append(scene)
        if len(scenes) % FRAMES == 0:
            progress(f"drawing pictures: street {len(scenes) // FRAMES} of {streets}")
    kept = FRAMES * math.ceil(streets / _HELD_OUT)
    network = train_centers(scenes[kept:], settings, progress)
    progress("calibrating scores")
    rng = np.random.default_rng([settings.seed, 3])
    maker = ExampleMaker(scenes[:kept], rng)
    calibration = calibrated(network, [maker.draw(draw_size(rng)) for _ in range(settings.held_out)])
    card: dict[str, object] = {
        "trained_on": f"{len(scenes) - kept} simulated pictures, {settings.steps} steps of {settings.batch} examples, "
        f"seed {settings.seed}",
        "calibration": calibration,
        "calibrated_on": f"{settings.held_out} examples of {kept} other simulated pictures",
        "minutes": round((time.monotonic() - begun) / 60.0, 1),
    }
    return BuiltNetwork(
        to_onnx(network, calibration, card), _SETTINGS.format(mean=GREY_MEAN, std=GREY_STD), card
    )


def train_centers(
    scenes: Sequence[SimulatedScene],
    settings: CenterTrainingSettings,
    progress: Progress = lambda _: None,
) -> CenterNetwork:
    """Train the network; equal arguments give equal weights on one machine.

    Args:
        scenes: the simulated pictures.
        settings: the parameters.
        progress: called with one line now and then.
    """
    torch.manual_seed(settings.seed)
    maker = ExampleMaker(scenes, np.random.default_rng([settings.seed, 1]), settings.textures)
    rng = np.random.default_rng([settings.seed, 2])
    network: CenterNetwork = CenterNetwork().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    averaged: CenterNetwork = copy.deepcopy(network)
    inner = [p for name, p in network.named_parameters() if p.ndim > 1 and not name.startswith("head")]
    others = [p for name, p in network.named_parameters() if p.ndim == 1 or name.startswith("head")]
    optimizers = [_Muon(inner, settings.decay), torch.optim.AdamW(others, weight_decay=0.0)]
    begun, losses = time.monotonic(), np.zeros(4)
    network.train()
    for step in range(settings.steps):
        for optimizer, rate in zip(optimizers, (settings.rate, settings.other_rate), strict=True):
            for group in optimizer.param_groups:
                group["lr"] = rate * _lr_factor(step / settings.steps)
        size = draw_size(rng, small=step < 0.5 * settings.steps)
        batch = _batched([maker.draw(size) for _ in range(settings.batch)])
        with torch.autocast("cpu", torch.bfloat16):
            made = network(batch.images)
        parts = _losses(made.float(), batch)
        network.zero_grad(set_to_none=True)
        torch.stack(parts).sum().backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        for optimizer in optimizers:
            optimizer.step()
        _average(averaged, network, min(settings.averaging, (step + 1) / (step + 10)))
        losses += 0.01 * (np.array([float(part.detach()) for part in parts]) - losses)
        if (step + 1) % 100 == 0:
            loss_text = ", ".join(f"{loss:.3f}" for loss in losses)
            progress(
                f"step {step + 1} of {settings.steps}, {time.monotonic() - begun:.0f} s: losses {loss_text}"
            )
    averaged.eval()
    return averaged


@torch.no_grad()
def _average(averaged: CenterNetwork, network: CenterNetwork, kept: float) -> None:
    """Move the averaged weights, and the statistics of the normalizations, towards the network's."""
    for mean, value in zip(averaged.state_dict().values(), network.state_dict().values(), strict=True):
        if mean.is_floating_point():
            mean.lerp_(value, 1.0 - kept)
        else:
            mean.copy_(value)


class _Muon(torch.optim.Optimizer):
    """Momentum, each step made orthogonal so that all directions of a kernel learn equally (Jordan et al. 2024)."""

    def __init__(self, params: Sequence[Tensor], decay: float) -> None:
        super().__init__(params, {"lr": 0.0, "decay": decay})

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        for group in self.param_groups:
            for weights in group["params"]:
                momentum = self.state[weights].setdefault("momentum", torch.zeros_like(weights))
                momentum.mul_(_MOMENTUM).add_(weights.grad)
                turned = _orthogonal((weights.grad + _MOMENTUM * momentum).flatten(1))
                size = max(1.0, turned.shape[0] / turned.shape[1]) ** 0.5
                weights.mul_(1.0 - group["lr"] * group["decay"])
                weights.add_(turned.view_as(weights), alpha=-group["lr"] * size)


def _orthogonal(matrix: Tensor) -> Tensor:
    """Return about the nearest matrix whose rows or columns are orthonormal, by Newton and Schulz's iteration."""
    x: Tensor = matrix / (matrix.norm() + 1e-7)
    wide = x.shape[0] <= x.shape[1]
    x = x if wide else x.T
    for _ in range(5):
        gram = x @ x.T
        x = 3.4445 * x + (-4.7750 * gram + 2.0315 * gram @ gram) @ x
    return x if wide else x.T


def _lr_factor(done: float) -> float:
    """Return the learning rate as a fraction of the greatest: a short rise, then down along a cosine."""
    return min(done / 0.05 + 0.01, 1.0) * (0.5 + 0.5 * math.cos(math.pi * done)) + 1e-3


def as_input(images: Sequence[NDArray[np.uint8]]) -> Tensor:
    """Return grey pictures of one size as the network's input."""
    stacked = torch.from_numpy(np.stack(images))[:, None].float()
    return ((stacked - GREY_MEAN) / GREY_STD).contiguous(memory_format=torch.channels_last)


def _batched(examples: Sequence[Example]) -> _Batch:
    targets = [_targets(example) for example in examples]
    peak, counts, distances, view, visible = (
        torch.from_numpy(np.stack(arrays)) for arrays in zip(*targets, strict=True)
    )
    return _Batch(as_input([e.image for e in examples]), peak, counts, distances, view, visible)


def _targets(example: Example) -> tuple[Float32Array, ...]:
    height, width = (n // STRIDE for n in example.image.shape)
    x = np.arange(width, dtype=np.float32) + 0.5
    y = np.arange(height, dtype=np.float32) + 0.5
    peak, counts = np.zeros((height, width), np.float32), np.ones((height, width), np.float32)
    distances = np.ones((4, height, width), np.float32)
    view, visible = np.zeros((height, width), np.int64), np.zeros((height, width), np.float32)
    for left, top, right, bottom in example.either / STRIDE:
        counts[math.floor(top) : math.ceil(bottom), math.floor(left) : math.ceil(right)] = 0.0
    for box, its_view, fraction in zip(example.boxes, example.view, example.visible, strict=True):
        left, top, right, bottom = (box / STRIDE).tolist()
        middle_x, middle_y = 0.5 * (left + right), 0.5 * (top + bottom)
        # The peak is 1 in the cell of the centre.
        at_x, at_y = min(int(middle_x), width - 1) + 0.5, min(int(middle_y), height - 1) + 0.5
        across = ((x - at_x) / max(_SPREAD * (right - left), _LEAST_SPREAD)) ** 2
        down = ((y - at_y) / max(_SPREAD * (bottom - top), _LEAST_SPREAD)) ** 2
        its_peak = np.exp(-0.5 * (down[:, None] + across[None, :]))
        higher = its_peak > peak
        peak[higher] = its_peak[higher]
        counts[its_peak > _BOX_FROM] = 1.0
        view[higher], visible[higher] = its_view, fraction
        reach = np.stack(
            np.broadcast_arrays(x[None] - left, y[:, None] - top, right - x[None], bottom - y[:, None])
        )
        distances[:, higher] = STRIDE * reach[:, higher]
    return peak, counts, distances, view, visible


def _losses(made: Tensor, batch: _Batch) -> list[Tensor]:
    """Return the losses of scores, boxes, views and visible fractions."""
    centers = batch.peak == 1.0
    n = centers.sum().clamp(min=1.0)
    logit, sure = made[:, 0], torch.sigmoid(made[:, 0])
    hit = -((1.0 - sure) ** 2) * nn.functional.logsigmoid(logit)
    miss = -((1.0 - batch.peak) ** 4) * sure**2 * nn.functional.logsigmoid(-logit)
    score = (torch.where(centers, hit, miss) * batch.counts).sum() / n

    weight = torch.where(batch.peak >= _BOX_FROM, batch.peak, 0.0)
    # A cell outside its box cannot have it.
    weight = weight * (batch.sides.amin(dim=1) > 0.0)
    total = weight.sum().clamp(min=1.0)
    box = (weight * (1.0 - _overlap(sides(made[:, 1:5]), batch.sides.clamp(min=0.1)))).sum() / total
    views = nn.functional.cross_entropy(made[:, 5 : 5 + _VIEWS], batch.view, reduction="none")
    seen = nn.functional.binary_cross_entropy_with_logits(made[:, 8], batch.visible, reduction="none")
    return [
        score,
        _BOX_WEIGHT * box,
        _VIEW_WEIGHT * (weight * views).sum() / total,
        _VISIBLE_WEIGHT * (weight * seen).sum() / total,
    ]


def _overlap(made: Tensor, wanted: Tensor) -> Tensor:
    """Return the generalized intersection over union of boxes around the same cells (Rezatofighi et al. 2019)."""
    inner, outer = torch.minimum(made, wanted), torch.maximum(made, wanted)
    common = (inner[:, 0] + inner[:, 2]) * (inner[:, 1] + inner[:, 3])
    around = (outer[:, 0] + outer[:, 2]) * (outer[:, 1] + outer[:, 3])
    either = sum((b[:, 0] + b[:, 2]) * (b[:, 1] + b[:, 3]) for b in (made, wanted)) - common
    return common / either - (around - either) / around


def calibrated(network: CenterNetwork, examples: Sequence[Example]) -> tuple[float, float]:
    """Fit slope and offset that make the scores' logits probabilities (Platt 1999).

    Args:
        network: the trained network.
        examples: pictures that it has not seen.
    """
    from sklearn.linear_model import LogisticRegression

    logits, right = [], []
    with torch.no_grad():
        for example in examples:
            made = network(as_input([example.image]))[0]
            logit, boxes = made[0].numpy(), _boxes(made)
            tops = (logit == cv2.dilate(logit, np.ones((3, 3), np.uint8))) & (logit > -6.0)
            for row, column in np.argwhere(tops).tolist():
                box = boxes[:, row, column]
                hit = bool((overlaps(box, example.boxes) >= 0.5).any())
                if hit or not (overlaps(box, example.either) > 0.2).any():
                    logits.append(logit[row, column])
                    right.append(hit)
    if len(set(right)) < 2:
        return 1.0, 0.0
    fit = LogisticRegression(C=1e3).fit(np.array(logits)[:, None], right)
    return round(float(fit.coef_[0, 0]), 4), round(float(fit.intercept_[0]), 4)


def _boxes(made: Tensor) -> Float32Array:
    """Return the boxes of all cells, (4, h, w) px: left, top, right, bottom."""
    reach = sides(made[1:5]).numpy()
    y, x = np.mgrid[: reach.shape[1], : reach.shape[2]] * STRIDE + STRIDE / 2
    return np.stack([x - reach[0], y - reach[1], x + reach[2], y + reach[3]]).astype(np.float32)
