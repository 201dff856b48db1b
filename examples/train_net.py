"""Train a network that finds cars, on simulated streets alone; any command takes it as its detector.

Cars stand in rows along streets of random width, in random weather, before random textures (domain randomization,
Tobin et al. 2017). The network scores in every 8×8 pixels whether a car's centre is there, with the car's box, view and
visible fraction (CenterNet: Zhou, Wang and Krähenbühl, *Objects as Points*, 2019). It is written as ONNX of the layout
`centers`, with its settings beside it; PyTorch (extra `detector`) is only needed to train it.

    python examples/train_net.py
    parkenv survey --scenario mini --sessions 1 --detector my_net.onnx

The packaged network `net` was trained in this way for 25 minutes with more of everything: occluders, repainted cars,
other sizes of pictures, averaged weights, and scores that are calibrated on held-out streets.
"""

import math
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import nn

from parkenv.perception.detector import overlaps
from parkenv.perception.detector_registry import make_detector
from sim_sensors.camera.models import PinholeCamera, camera_pose
from sim_sensors.camera.weather import PRESETS, Weather
from sim_sensors.ground_truth import vehicle_boxes
from sim_sensors.scene import Fleet, Scene
from sim_sensors.surroundings import Surroundings
from sim_sensors.vehicles.vehicle import VehicleModel

STREETS, PICTURES = 60, 12  # pictures of each street
STEPS, BATCH, RATE = 3_000, 8, 2e-3
SIZE = (320, 256)  # px, width and height of a training example
FILE = Path("my_net.onnx")
SEED = 0

STRIDE, REACH = 8, 16.0  # px: a cell, and exp(0) of the distance to a side of the box
GREY_MEAN, GREY_STD = 114.0, 64.0
BODIES = ("hatchback", "sedan", "estate", "suv", "van")
WIDTHS, NECK, OUTPUTS = (
    (24, 48, 80, 96),
    64,
    9,
)  # channels at 1/4, 1/8, 1/16 and 1/32, on the way back, and at the end


def row_of_cars(rng, y, across):
    """Return poses (x, y, yaw) and models of cars in a row along x, side by side (`across`) or one after the other."""
    poses, models, x = [], [], -24.0
    while x < 24.0:
        model = VehicleModel.from_seed(str(rng.choice(BODIES)), int(rng.integers(1 << 20)))
        length = model.width if across else model.length
        if rng.random() < 0.8:
            yaw = (math.pi / 2 if across else 0.0) + math.pi * rng.integers(2) + rng.normal(0.0, 0.03)
            poses.append((x + length / 2, y + rng.normal(0.0, 0.15), yaw))
            models.append(model)
        x += length + rng.uniform(0.6, 2.0)
    return poses, models


def pictures_of_a_street(seed):
    """Yield grey pictures of a street, the depth of their pixels, and the true boxes of the cars."""
    rng = np.random.default_rng([SEED, seed])
    across = rng.random() < 0.5
    poses, models = row_of_cars(rng, 0.0, across)
    more = row_of_cars(rng, rng.uniform(6.0, 12.0), rng.random() < 0.5)
    poses, models = poses + more[0], models + more[1]
    n_trees, n_people = rng.integers(15), rng.integers(5)
    trees = rng.uniform((-35, 14, 3), (35, 30, 10), (n_trees, 3))  # x, y, height
    people = rng.uniform((-18, -4, -3, 0), (18, -3, 3, 1), (n_people, 4))
    road = [[[-45, -45], [45, -45], [45, 16], [-45, 16]]]
    fleet = Fleet(tuple(models), Surroundings(paved=road, trees=trees, pedestrians=people))
    for i in range(PICTURES):
        there = np.flatnonzero(rng.random(len(poses)) < (0.0 if i == 0 else rng.uniform(0.3, 1.0)))
        scene = Scene(np.array(poses)[there], there, fleet)
        camera = PinholeCamera.from_field_of_view(640, 480, horizontal=rng.uniform(0.5, 1.6))
        pose = camera_pose(
            rng.uniform(-14, 14), -rng.uniform(4, 14), rng.uniform(0.8, 2.2),
            math.pi / 2 + rng.normal(0.0, 0.3), rng.uniform(-0.15, 0.05),
        )  # fmt: skip
        weather = Weather.draw(str(rng.choice(PRESETS)), int(rng.integers(1 << 20)))
        frame = camera.render(scene, pose, weather, int(rng.integers(1 << 20)))
        grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        yield grey, frame.depth.astype(np.float32), vehicle_boxes(camera, scene, pose, frame)


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
    grey, depth, truth = picture
    boxes, visible = truth.visible_box.astype(float), truth.visible_fraction
    values, clear = grey.astype(np.float32), visible > 0.8
    if rng.random() < 0.7:
        behind = (truth.distance[clear].min() if clear.any() else 8.0) + rng.uniform(2.0, 6.0)
        values = np.where(depth > behind, values + rng.uniform(8, 50) * texture(rng, grey.shape), values)
    scale = math.exp(rng.uniform(math.log(0.5), math.log(1.6)))
    middle = rng.uniform((100, 150), (540, 400))
    if clear.any():
        box = boxes[rng.choice(np.flatnonzero(clear))]
        middle = (box[:2] + box[2:]) / 2
        scale = np.clip(math.exp(rng.uniform(math.log(30), math.log(250))) / (box[2] - box[0]), 0.3, 3.0)
    corner = middle * scale - rng.uniform(0.2, 0.8, 2) * SIZE
    to_example = np.array([[scale, 0, -corner[0]], [0, scale, -corner[1]]])
    values = cv2.warpAffine(values, to_example, SIZE, flags=cv2.INTER_AREA, borderValue=GREY_MEAN)
    boxes = boxes * scale - np.tile(corner, 2)
    # Another camera: exposure, blur, noise.
    values = 128 + (values - values.mean()) * rng.uniform(0.5, 1.5) + rng.normal(0.0, 25.0)
    values = cv2.GaussianBlur(values, (0, 0), rng.uniform(0.3, 1.2)) + rng.normal(
        0, rng.uniform(0, 8), SIZE[::-1]
    )
    inside = np.clip(boxes, 0, np.tile(SIZE, 2))
    size, kept = inside[:, 2:] - inside[:, :2], inside[:, 2:] - inside[:, :2] > (0, 0)
    wanted = (visible > 0.3) & (size > (11, 8)).all(axis=1)
    wanted &= size.prod(axis=1) > 0.6 * (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    image, other = np.clip(values, 0, 255).astype(np.uint8), kept.all(axis=1) & ~wanted
    return image, inside[wanted], truth.view[wanted], visible[wanted], inside[other]


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
    settings = f'size = [640, 480]\nchannels = "grey"\nmean = {GREY_MEAN}\nstd = {GREY_STD}\nenlarge = 2.0\n'
    file.with_suffix(".toml").write_text(settings)


if __name__ == "__main__":
    torch.manual_seed(SEED)
    torch.set_num_threads(1)
    pictures = [picture for street in range(STREETS) for picture in pictures_of_a_street(street)]
    write(train(pictures), FILE)
    detector, found, cars = make_detector(str(FILE)), 0, 0
    for image, _, truth in pictures_of_a_street(STREETS):  # a street that it has not seen
        boxes = detector.detect(image)
        boxes = boxes.boxes[boxes.probability > 0.3]
        clear = (truth.visible_fraction > 0.6) & (truth.distance < 15.0)
        best = [overlaps(box.astype(float), boxes).max(initial=0.0) for box in truth.visible_box[clear]]
        found, cars = found + int((np.array(best) > 0.5).sum()), cars + len(best)
    print(f"{FILE}: {found} of {cars} cars of a held-out street")
