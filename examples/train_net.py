"""Train a network that finds cars, on simulated streets alone; any command takes it as its detector.

The streets are those of `net_streets.py`, with random textures, shadows and cameras (domain randomization, Tobin et al.
2017). The network scores in every 8×8 pixels whether a car's centre is there, with the car's box, view and visible
fraction (CenterNet: Zhou, Wang and Krähenbühl, *Objects as Points*, 2019). It is written as ONNX of the layout
`centers`, with its settings beside it; PyTorch (extra `detector`) is only needed to train it.

    python examples/train_net.py
    parkenv survey --scenario mini --sessions 1 --detector my_net.onnx

It takes about 20 minutes. The packaged network `net` was trained in this way for longer, with more of everything, see
its card (`parkenv/perception/models/net.md`): streets seen from across, occluders, repainted cars, averaged weights,
and scores that are calibrated on held-out streets.
"""

import math
from pathlib import Path

import cv2
import numpy as np
import torch
from net_streets import pictures_of_a_street
from torch import nn

from parkenv.perception.detector import overlaps
from parkenv.perception.detector_registry import make_detector

STREETS, PICTURES = 60, 12  # pictures of each street
STEPS, BATCH, RATE = 3_000, 8, 2e-3
SIZE = (320, 256)  # px, width and height of a training example
FILE = Path("my_net.onnx")
SEED = 0

STRIDE, REACH = 8, 16.0  # px: a cell, and exp(0) of the distance to a side of the box
GREY_MEAN, GREY_STD = 114.0, 64.0
WIDTHS, NECK, OUTPUTS = (
    (24, 48, 80, 96),
    64,
    9,
)  # channels at 1/4, 1/8, 1/16 and 1/32, on the way back, and at the end


def texture(rng, shape):
    """Return noise of several scales, for what stands behind the cars: leaves, stone, posters."""
    noise = np.zeros(shape, np.float32)
    for size in (2, 4, 8, 16, 32):
        coarse = rng.standard_normal((shape[0] // size + 2, shape[1] // size + 2)).astype(np.float32)
        noise += cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC) * size ** rng.uniform(
            -0.3, 0.5
        )
    return noise / noise.std()


def example(rng, picture):
    """Cut a part out of a picture at another scale; return it, its cars' boxes, view and visible fraction, and others.

    The others are boxes of cars that the network may find or not: small, hidden, or cut off.
    """
    grey, car, depth, visible = picture.grey.astype(np.float32), picture.car, picture.depth, picture.visible
    clear = np.flatnonzero((visible > 0.5) & (picture.inside > 0.2))
    if rng.random() < 0.7:  # what stands behind the cars
        behind = (picture.distance[clear].min() if len(clear) else 8.0) + rng.uniform(0.5, 6.0)
        there = (depth > behind) & (car == 0)
        grey = np.where(there, grey + rng.uniform(8, 50) * texture(rng, grey.shape), grey)
    if rng.random() < 0.35:  # shadows of houses and trees
        dark = cv2.GaussianBlur(
            (texture(rng, grey.shape) > rng.uniform(-0.5, 1.0)).astype(np.float32), (0, 0), 1.5
        )
        grey *= 1.0 - rng.uniform(0.25, 0.8) * dark
    scale, middle = math.exp(rng.uniform(-0.9, 0.4)), rng.uniform(0.2, 0.8, 2) * grey.shape[::-1]
    if len(clear) and rng.random() < 0.8:
        left, top, width, height = cv2.boundingRect((car == 1 + rng.choice(clear)).astype(np.uint8))
        middle = np.array([left + width / 2, top + height / 2])
        scale = np.clip(math.exp(rng.uniform(math.log(28), math.log(300))) / width, 0.3, 3.0)
    corner = middle * scale - rng.uniform(0.15, 0.85, 2) * SIZE
    to_example = np.array([[scale, 0, -corner[0]], [0, scale, -corner[1]]])
    values = cv2.warpAffine(grey, to_example, SIZE, flags=cv2.INTER_AREA, borderValue=GREY_MEAN)
    before = np.bincount(car.ravel(), minlength=256) * scale**2
    car = cv2.warpAffine(car, to_example, SIZE, flags=cv2.INTER_NEAREST)
    # Another camera: exposure, blur, noise.
    values = 128 + (values - values.mean()) * rng.uniform(0.5, 1.8) + rng.normal(0.0, 25.0)
    noise = rng.normal(0, rng.uniform(0, 8), SIZE[::-1])
    values = cv2.GaussianBlur(values, (0, 0), rng.uniform(0.3, 1.2)) + noise
    boxes, rows = [], np.flatnonzero(np.bincount(car.ravel())[1:])
    for row in rows:
        left, top, width, height = cv2.boundingRect((car == row + 1).astype(np.uint8))
        boxes.append([left, top, left + width, top + height])
    boxes = np.array(boxes, np.float64).reshape(-1, 4)
    part = picture.inside[rows] * np.bincount(car.ravel(), minlength=256)[rows + 1] / before[rows + 1]
    wanted = (visible[rows] > 0.3) & (boxes[:, 2:] - boxes[:, :2] >= (13, 12)).all(axis=1) & (part > 0.25)
    image, mine = np.clip(values, 0, 255).astype(np.uint8), rows[wanted]
    return image, boxes[wanted], picture.view[mine], visible[mine], boxes[~wanted]


def targets(boxes, views, visible, others):
    """Return what the cells should be, (8, h/8, w/8): peak, weight, four sides in px, view, visible fraction."""
    width, height = SIZE[0] // STRIDE, SIZE[1] // STRIDE
    x, y = np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5
    cells = np.ones((8, height, width), np.float32)
    cells[[0, 6, 7]] = 0.0
    for left, top, right, bottom in others / STRIDE:
        cells[1, int(top) : math.ceil(bottom), int(left) : math.ceil(right)] = 0.0
    for (left, top, right, bottom), view, fraction in zip(boxes / STRIDE, views, visible, strict=True):
        # The peak is 1 in the cell of the centre.
        at_x = min(int((left + right) / 2), width - 1) + 0.5
        at_y = min(int((top + bottom) / 2), height - 1) + 0.5
        off = ((x - at_x) / max(0.13 * (right - left), 0.45)) ** 2
        peak = np.exp(-0.5 * (off + ((y - at_y) / max(0.13 * (bottom - top), 0.45)) ** 2))
        mine = peak > cells[0]
        around = np.broadcast_arrays(x - left, y - top, right - x, bottom - y)
        cells[0, mine], cells[6, mine], cells[7, mine] = peak[mine], view, fraction
        cells[2:6, mine] = STRIDE * np.stack(around)[:, mine]
        cells[1, peak > 0.25] = 1.0
    return cells


def layer(inputs, outputs, kernel=3, stride=1):
    """Return convolution, normalization and rectifier."""
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU())


class Network(nn.Module):
    """Down to 1/32 of the picture's size, and back up to 1/8: logits, and logarithms of the box's sides."""

    def __init__(self):
        super().__init__()
        self.stem = layer(1, 8, kernel=5, stride=2)
        pairs = zip((8, *WIDTHS), WIDTHS, strict=False)
        self.stages = nn.ModuleList(nn.Sequential(layer(a, b, stride=2), layer(b, b)) for a, b in pairs)
        self.across = nn.ModuleList(layer(width, NECK, kernel=1) for width in WIDTHS[1:])
        self.smooth = nn.ModuleList([layer(NECK, NECK), layer(NECK, NECK)])
        self.head = nn.Conv2d(NECK, OUTPUTS, 1)
        nn.init.normal_(self.head.weight, std=0.01)
        self.head.bias.data = torch.tensor([-4.0] + [0.0] * (OUTPUTS - 1))  # centres are rare

    def forward(self, x):
        """Return (b, 9, h/8, w/8) of (b, 1, h, w)."""
        x, levels = self.stem(x), []
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        x = self.across[2](levels[3])
        for level in (1, 0):
            x = nn.functional.interpolate(x, scale_factor=2, mode="nearest")
            x = self.smooth[level](x + self.across[level](levels[level + 1]))
        return self.head(x)


class Cells(nn.Module):
    """The network with its last functions: what the layout `centers` wants."""

    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, x):
        """Return (b, 9, h/8, w/8) of (b, 1, h, w)."""
        made = self.network(x)
        parts = [made[:, :1].sigmoid(), sides(made), made[:, 5:8].softmax(dim=1), made[:, 8:].sigmoid()]
        return torch.cat(parts, dim=1)


def sides(made):
    """Return the distances from a cell's centre to its box's sides, px."""
    return REACH * made[:, 1:5].clamp(-4.0, 4.0).exp()


def loss(made, cells):
    """Return the focal loss of the centres, and the losses of boxes (generalized overlap), views and fractions."""
    peak, counts, wanted = cells[:, 0], cells[:, 1], cells[:, 2:6]
    logit, p = made[:, 0], made[:, 0].sigmoid()
    hit = -((1 - p) ** 2) * nn.functional.logsigmoid(logit)
    miss = -((1 - peak) ** 4) * p**2 * nn.functional.logsigmoid(-logit)
    centres = peak == 1.0
    score = (torch.where(centres, hit, miss) * counts).sum() / centres.sum().clamp(min=1)
    weight = peak * (peak > 0.25) * (wanted.amin(dim=1) > 0.0)
    mine, wanted = sides(made), wanted.clamp(min=0.1)
    inner, outer = torch.minimum(mine, wanted), torch.maximum(mine, wanted)
    common, around, a, b = ((s[:, 0] + s[:, 2]) * (s[:, 1] + s[:, 3]) for s in (inner, outer, mine, wanted))
    either = a + b - common
    box = 1 - common / either + (around - either) / around
    view = nn.functional.cross_entropy(made[:, 5:8], cells[:, 6].long(), reduction="none")
    seen = nn.functional.binary_cross_entropy_with_logits(made[:, 8], cells[:, 7], reduction="none")
    return score + (weight * (3 * box + 0.3 * view + 0.3 * seen)).sum() / weight.sum().clamp(min=1)


def train(pictures):
    """Train the network."""
    rng, network = np.random.default_rng([SEED, 1 << 20]), Network()
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=0.02)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, STEPS)
    for step in range(STEPS):
        drawn = [example(rng, pictures[rng.integers(len(pictures))]) for _ in range(BATCH)]
        images = torch.from_numpy(np.stack([image for image, *_ in drawn]))[:, None]
        cells = torch.from_numpy(np.stack([targets(*cars) for _, *cars in drawn]))
        value = loss(network((images - GREY_MEAN) / GREY_STD), cells)
        optimizer.zero_grad()
        value.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimizer.step()
        schedule.step()
        if (step + 1) % 100 == 0:
            print(f"step {step + 1} of {STEPS}: loss {value.item():.3f}")
    return network.eval()


def write(network, file):
    """Write the network as ONNX, and how it is fed beside it."""
    torch.onnx.export(Cells(network), (torch.zeros(1, 1, 480, 640),), file, dynamo=False, opset_version=13)
    settings = f'size = [640, 480]\nchannels = "grey"\nmean = {GREY_MEAN}\nstd = {GREY_STD}\n'
    file.with_suffix(".toml").write_text(settings + "enlarge = 2.0\nfollow = true\nnear_from = 40\n")


if __name__ == "__main__":
    torch.manual_seed(SEED)
    torch.set_num_threads(1)
    pictures = [
        picture for street in range(STREETS) for picture in pictures_of_a_street(SEED, street, PICTURES)
    ]
    write(train(pictures), FILE)
    detector, found, cars = make_detector(str(FILE)), 0, 0
    for picture in pictures_of_a_street(SEED, STREETS, PICTURES):  # a street that it has not seen
        boxes = detector.detect(picture.grey)
        boxes = boxes.boxes[boxes.probability > 0.3]
        for row in np.flatnonzero(
            (picture.visible > 0.6) & (picture.inside > 0.6) & (picture.distance < 15.0)
        ):
            left, top, width, height = cv2.boundingRect((picture.car == row + 1).astype(np.uint8))
            true = np.array([left, top, left + width, top + height], np.float64)
            found, cars = found + int(overlaps(true, boxes).max(initial=0.0) > 0.5), cars + 1
    print(f"{FILE}: {found} of {cars} cars of a held-out street")
