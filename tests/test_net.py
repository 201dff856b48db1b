"""The packaged network `net`: the shipped file, how it is read, and what it finds."""

import json
import pickle
import zipfile

import cv2
import numpy as np
import pytest
from command_line import ran, rows_in
from onnx import load as load_onnx
from onnx import numpy_helper

from parkenv.perception.detector_registry import MODELS, detector_version, make_detector
from parkenv.perception.onnx_detector import OnnxDetector, OnnxSettings, decode_centers
from sim_sensors.camera.models import PinholeCamera, camera_pose
from sim_sensors.camera.weather import Weather
from sim_sensors.ground_truth import View, vehicle_boxes
from sim_sensors.scene import Fleet, Scene
from sim_sensors.surroundings import Surroundings
from sim_sensors.vehicles.vehicle import VehicleModel

FILE = MODELS / "net.onnx"


@pytest.fixture(scope="module")
def net():
    return make_detector("net")


def with_settings(settings):
    return OnnxDetector(FILE.read_bytes(), "net", settings, is_known=True)


def drawn(poses):
    """Return a picture of three parked cars, with their true boxes."""
    models = tuple(VehicleModel.from_seed(body, 3) for body in ("hatchback", "estate", "sedan"))
    fleet = Fleet(models, Surroundings(paved=[[[-12, -2], [12, -2], [12, 16], [-12, 16]]]))
    scene = Scene(np.array(poses), np.arange(3), fleet)
    camera, pose = PinholeCamera(), camera_pose(0.0, 0.0, 1.4, np.pi / 2, -0.05)
    frame = camera.render(scene, pose, Weather.draw("overcast", 1), 1)
    return frame.image, vehicle_boxes(camera, scene, pose, frame)


@pytest.fixture(scope="module")
def street():
    """Two cars along the street and one across."""
    return drawn([[-5.0, 8.0, 0.0], [0.6, 8.0, 0.0], [5.5, 8.5, np.pi / 2]])


def overlap(a, b):
    inner = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    common = np.clip(inner, 0, None).prod()
    return common / ((a[2:] - a[:2]).prod() + (b[2:] - b[:2]).prod() - common)


def test_the_shipped_file_is_small_and_holds_nothing_but_a_network(net):
    data = FILE.read_bytes()
    assert len(data) < 2_000_000
    assert data[:1] != b"\x80"
    assert not zipfile.is_zipfile(str(FILE))
    model = load_onnx(str(FILE))
    kinds = {node.op_type for node in model.graph.node}
    assert kinds <= set(
        "Add Cast Clip Concat Conv Exp GlobalAveragePool Mul Pow Relu Resize Sigmoid Slice Softmax".split()
    )
    assert all(np.isfinite(numpy_helper.to_array(t)).all() for t in model.graph.initializer)
    card = {p.key: json.loads(p.value) for p in model.metadata_props}
    slope, offset = card["calibration"]
    assert slope > 0.0
    assert np.isfinite(offset)
    assert "seed 0" in card["trained_on"]
    assert detector_version("net") == "net"
    assert isinstance(net, OnnxDetector)


def test_it_finds_the_cars_of_a_picture_with_windows_around_them_and_a_copy_the_same(net, street):
    image, truth = street
    found, again = net.detect(image), pickle.loads(pickle.dumps(net)).detect(image)
    assert np.array_equal(found.boxes, again.boxes)
    assert np.array_equal(found.probability, again.probability)
    assert (np.diff(found.probability, prepend=1.0, append=0.0) <= 0.0).all()
    sure = found.select(found.probability > 0.5)
    assert len(sure) == 3
    for box, view in zip(truth.visible_box, truth.view, strict=True):
        best = max(range(3), key=lambda i: overlap(sure.boxes[i], box))
        assert overlap(sure.boxes[best], box) > 0.7
        if view != View.OBLIQUE:
            assert sure.view[best] == view
            assert sure.end_on[best] == (view == View.END)
    found = net.detect(street[0])
    side = ~found.end_on
    size = found.regions[:, 2:] - found.regions[:, :2]
    side |= found.boxes[:, 2] - found.boxes[:, 0] > 2.0 * (found.boxes[:, 3] - found.boxes[:, 1])
    assert size[side, 0] == pytest.approx(2.5 * size[side, 1], rel=1e-4)
    assert size[~side, 0] == pytest.approx(size[~side, 1], rel=1e-4)
    assert (found.regions[:, 0] <= found.boxes[:, 0]).all()


def test_a_hidden_car_is_less_visible_than_the_one_before_it(net):
    image, truth = drawn([[-1.5, 7.0, 0.0], [-0.2, 12.0, 0.0], [5.5, 8.5, np.pi / 2]])
    found = net.detect(image)
    best = [max(range(len(found)), key=lambda i: overlap(found.boxes[i], b)) for b in truth.visible_box]
    hidden, front = np.argmin(truth.visible_fraction), np.argmin(truth.distance)
    assert truth.visible_fraction[hidden] < 0.6
    assert found.visible_fraction[best[hidden]] < found.visible_fraction[best[front]] - 0.05


def test_grey_pictures_and_other_sizes(net, street):
    image, truth = street
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    assert np.array_equal(net.detect(image).boxes, net.detect(grey).boxes)  # it looks at grey levels only
    for width, height in ((1280, 960), (320, 240), (640, 400)):
        found = net.detect(cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA))
        sure = found.select(found.probability > 0.4)
        for box in truth.visible_box:
            scaled = box * np.tile([width / 640, height / 480], 2)
            assert max(overlap(b, scaled) for b in sure.boxes) > 0.6, (width, height)
    assert len(net.detect(np.full((20, 30), 90, np.uint8)).select(slice(0, 1)).boxes) in (0, 1)
    assert not (net.detect(np.full((480, 640), 90, np.uint8)).probability > 0.3).any()


def test_centers_are_decoded_cell_by_cell():
    rng = np.random.default_rng(0)
    cells = rng.uniform(0.0, 1.0, (1, 9, 12, 16)).astype(np.float32)
    cells[0, 1:5] *= 40.0
    cells[0, 0, 3:5, 3:6] = 0.99  # equal neighbours: one car
    found = decode_centers(cells, (128, 96), 0.2)
    wanted, score = [], np.pad(cells[0, 0], 1, constant_values=-1.0)
    for row in range(12):
        for column in range(16):
            s = cells[0, 0, row, column]
            around = [score[row + dy, column + dx] for dy in range(3) for dx in range(3)]
            if s >= 0.2 and all(s > v for v in around[:4]) and all(s >= v for v in around[5:]):
                left, top, right, bottom, *views, visible = cells[0, 1:, row, column]
                x, y = 8 * column + 4, 8 * row + 4
                view, is_end = np.argmax(views), views[View.END] > views[View.SIDE]
                wanted.append([x - left, y - top, x + right, y + bottom, s, view, is_end, visible])
    wanted = np.array(wanted)
    assert len(wanted) > 5
    assert np.allclose(found.boxes, wanted[:, :4], atol=1e-4)
    assert np.array_equal(found.score, wanted[:, 4].astype(np.float32))
    assert np.array_equal(found.view, wanted[:, 5])
    assert np.array_equal(found.end_on, wanted[:, 6] == 1.0)
    assert np.allclose(found.visible, wanted[:, 7])


def test_small_pictures_are_enlarged_no_more_than_told(street):
    image = cv2.resize(street[0], (160, 120), interpolation=cv2.INTER_AREA)
    settings = OnnxSettings(size=(640, 480), channels="grey", threshold=0.3)
    framed = cv2.copyMakeBorder(image, 180, 180, 240, 240, cv2.BORDER_CONSTANT, value=(114, 114, 114))
    found = with_settings(settings.changed(enlarge=1.0)).detect(image)
    within = with_settings(settings).detect(framed)
    assert np.allclose(found.boxes, within.boxes - (240, 180, 240, 180), atol=1e-3)


def test_the_input_follows_a_pictures_proportions(net, street, monkeypatch):
    image, truth = street
    detector, seen = with_settings(net.settings.changed(follow=True, mirror=False, near_from=None)), []
    run = detector._run
    monkeypatch.setattr(detector, "_run", lambda fed: seen.append(fed.shape[:1:-1]) or run(fed))
    wide = np.ascontiguousarray(image[150:342])  # 640×192
    for width, height, fed in ((1280, 384, (1024, 320)), (640, 192, (1024, 320)), (320, 96, (640, 192))):
        found = detector.detect(cv2.resize(wide, (width, height), interpolation=cv2.INTER_AREA))
        assert seen[-1] == fed
        sure = found.select(found.probability > 0.4)
        for box in truth.visible_box - (0, 150, 0, 150):
            assert max(overlap(b, np.clip(box, 0, (640, 192) * 2) * width / 640) for b in sure.boxes) > 0.6
    detector.detect(image)
    assert seen[-1] == (640, 480)


def test_cars_that_fill_the_picture_are_looked_for_at_a_smaller_size(net, monkeypatch):
    image, truth = drawn([[0.4, 3.6, 0.0], [30.0, 40.0, 0.0], [-30.0, 40.0, 0.0]])
    once, twice = (with_settings(net.settings.changed(near_from=n)) for n in (None, 40))
    seen, run = [], twice._run
    monkeypatch.setattr(twice, "_run", lambda fed: seen.append(fed.shape[:1:-1]) or run(fed))
    found, before = twice.detect(image), once.detect(image)
    assert seen == [(640, 480), (384, 288)]
    near = truth.visible_box[0]
    assert max(overlap(box, near) for box in found.select(found.probability > 0.5).boxes) > 0.8
    small = before.boxes[:, 3] - before.boxes[:, 1] < 40
    apart = [i for i in np.flatnonzero(small) if overlap(before.boxes[i], near) == 0.0]
    assert all((found.boxes == before.boxes[i]).all(axis=1).any() for i in apart)  # small ones are as before


def test_small_pictures_are_looked_at_mirrored_too(net, street):
    small = np.ascontiguousarray(cv2.resize(street[0], (200, 150), interpolation=cv2.INTER_AREA)[:140])
    net = with_settings(net.settings.changed(near_from=None))
    found, other = net.detect(small), net.detect(np.ascontiguousarray(small[:, ::-1]))
    turned = other.boxes[:, [2, 1, 0, 3]] * (-1, 1, -1, 1) + (200, 0, 200, 0)
    sure = np.flatnonzero(found.probability > 0.3)
    assert len(sure) >= 3
    for i in sure:
        j = np.abs(turned - found.boxes[i]).max(axis=1).argmin()
        assert turned[j] == pytest.approx(found.boxes[i], abs=0.01)
        assert other.probability[j] == pytest.approx(found.probability[i], abs=1e-4)
        assert (other.view[j], other.end_on[j]) == (found.view[i], found.end_on[i])
    once = with_settings(net.settings.changed(mirror=False))
    assert not np.array_equal(once.detect(small).probability, found.probability)
    # This one fills the input.
    assert np.array_equal(once.detect(street[0]).boxes, net.detect(street[0]).boxes)


def test_what_takes_detectors_takes_net(tmp_path, street):
    cv2.imwrite(str(tmp_path / "photo.png"), street[0][..., ::-1])
    done = ran("detect --detector net", tmp_path / "photo.png", "--out", tmp_path / "out")
    assert "3 cars in 1 image" in done.stdout
    rows = rows_in(tmp_path / "out" / "boxes.csv")
    assert {row["view"] for row in rows} == {"side", "oblique"}
    assert all(float(row["visible_fraction"]) > 0.8 for row in rows)
    assert (tmp_path / "out" / "photo_cars.png").is_file()
