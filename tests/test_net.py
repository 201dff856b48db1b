"""The packaged network `net`: the shipped file, how it is read, its training pictures, and a training of seconds."""

import csv
import json
import pickle
import zipfile

import cv2
import numpy as np
import pytest
from command_line import parkenv
from onnx import load as load_onnx
from onnx import numpy_helper

from parkenv import InputError
from parkenv.files.onnx_file import read_onnx
from parkenv.perception.detector import Detections
from parkenv.perception.detector_registry import MODELS, detector_version, make_detector
from parkenv.perception.lab.car_datasets import Crops, LabelledImage
from parkenv.perception.lab.simulated_scenes import SimulatedScene, simulated_scenes
from parkenv.perception.lab.simulated_streets import FRAMES
from parkenv.perception.lab.training_crops import SIZES, ExampleMaker
from parkenv.perception.onnx_detector import OnnxDetector, OnnxSettings
from parkenv.perception.onnx_outputs import class_columns, decode_centers, guess_layout
from parkenv.studies.sensing.detector_drives import DrivePicture, score_on_drives
from parkenv.studies.sensing.detector_scores import recall_on_crops, score_on
from sim_sensors.camera.models import PinholeCamera, camera_pose
from sim_sensors.camera.weather import Weather
from sim_sensors.ground_truth import VehicleBoxes, View, vehicle_boxes
from sim_sensors.scene import Fleet, Scene
from sim_sensors.surroundings import Surroundings
from sim_sensors.vehicles.vehicle import VehicleModel

FILE = MODELS / "net.onnx"


@pytest.fixture(scope="module")
def net():
    return make_detector("net")


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
    assert kinds <= {
        "Add",
        "Cast",
        "Clip",
        "Concat",
        "Conv",
        "Exp",
        "Mul",
        "Relu",
        "Resize",
        "Sigmoid",
        "Softmax",
    }
    assert all(np.isfinite(numpy_helper.to_array(t)).all() for t in model.graph.initializer)
    card = {key: json.loads(value) for key, value in read_onnx(str(FILE)).metadata.items()}
    slope, offset = card["calibration"]
    assert slope > 0.0
    assert np.isfinite(offset)
    assert "seed 0" in card["trained_on"]
    assert detector_version("net") == "net"
    assert isinstance(net, OnnxDetector)


def test_it_finds_the_cars_of_a_picture(net, street):
    image, truth = street
    found = net.detect(image)
    sure = found.select(found.probability > 0.5)
    assert len(sure) == 3
    for box, view in zip(truth.visible_box, truth.view, strict=True):
        best = max(range(3), key=lambda i: overlap(sure.boxes[i], box))
        assert overlap(sure.boxes[best], box) > 0.7
        if view != View.OBLIQUE:
            assert sure.view[best] == view
            assert sure.end_on[best] == (view == View.END)


def test_a_hidden_car_is_less_visible_than_the_one_before_it(net):
    image, truth = drawn([[-1.5, 7.0, 0.0], [-0.2, 12.0, 0.0], [5.5, 8.5, np.pi / 2]])
    found = net.detect(image)
    best = [max(range(len(found)), key=lambda i: overlap(found.boxes[i], b)) for b in truth.visible_box]
    hidden, front = np.argmin(truth.visible_fraction), np.argmin(truth.distance)
    assert truth.visible_fraction[hidden] < 0.6
    assert found.visible_fraction[best[hidden]] < found.visible_fraction[best[front]] - 0.05


def test_equal_pictures_give_equal_boxes(net, street):
    image, _ = street
    found, again = net.detect(image), pickle.loads(pickle.dumps(net)).detect(image)
    assert np.array_equal(found.boxes, again.boxes)
    assert np.array_equal(found.probability, again.probability)
    assert (found.probability[:-1] >= found.probability[1:]).all()
    assert ((found.probability >= 0.0) & (found.probability <= 1.0)).all()


def test_grey_pictures_and_other_sizes(net, street):
    image, truth = street
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    colored, plain = net.detect(image), net.detect(grey)
    assert np.array_equal(colored.boxes, plain.boxes)  # it looks at grey levels only
    for width, height in ((1280, 960), (320, 240), (640, 400)):
        small = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
        found = net.detect(small)
        sure = found.select(found.probability > 0.4)
        for box in truth.visible_box:
            scaled = box * np.tile([width / 640, height / 480], 2)
            assert max(overlap(b, scaled) for b in sure.boxes) > 0.6, (width, height)
    assert len(net.detect(np.full((20, 30), 90, np.uint8)).select(slice(0, 1)).boxes) in (0, 1)
    assert not (net.detect(np.full((480, 640), 90, np.uint8)).probability > 0.3).any()


def test_windows_of_labelled_crops_surround_the_cars(net, street):
    found = net.detect(street[0])
    side = ~found.end_on
    size = found.regions[:, 2:] - found.regions[:, :2]
    side |= found.boxes[:, 2] - found.boxes[:, 0] > 2.0 * (found.boxes[:, 3] - found.boxes[:, 1])
    assert size[side, 0] == pytest.approx(2.5 * size[side, 1], rel=1e-4)
    assert size[~side, 0] == pytest.approx(size[~side, 1], rel=1e-4)
    assert (found.regions[:, 0] <= found.boxes[:, 0]).all()


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
    assert guess_layout([(1, 9, 60, 80)], (640, 480)) == "centers"
    with pytest.raises(InputError, match=r"want one output \(1, 9, rows, columns\)"):
        class_columns("centers", [(1, 8, 60, 80)], False)


def test_small_pictures_are_enlarged_no_more_than_told(street):
    image = cv2.resize(street[0], (160, 120), interpolation=cv2.INTER_AREA)
    file = read_onnx(str(FILE))
    settings = OnnxSettings(layout="centers", mean=(114.0,), std=(64.0,), threshold=0.3)
    framed = cv2.copyMakeBorder(image, 180, 180, 240, 240, cv2.BORDER_CONSTANT, value=(114, 114, 114))
    found = OnnxDetector(file, settings.changed(enlarge=1.0)).detect(image)
    within = OnnxDetector(file, settings).detect(framed)
    assert np.allclose(found.boxes, within.boxes - (240, 180, 240, 180), atol=1e-3)


def test_small_pictures_are_looked_at_mirrored_too(net, street):
    small = np.ascontiguousarray(cv2.resize(street[0], (288, 216), interpolation=cv2.INTER_AREA)[:200])
    found, other = net.detect(small), net.detect(np.ascontiguousarray(small[:, ::-1]))
    turned = other.boxes[:, [2, 1, 0, 3]] * (-1, 1, -1, 1) + (288, 0, 288, 0)
    sure = np.flatnonzero(found.probability > 0.3)
    assert len(sure) >= 3
    for i in sure:
        j = np.abs(turned - found.boxes[i]).max(axis=1).argmin()
        assert turned[j] == pytest.approx(found.boxes[i], abs=0.01)
        assert other.probability[j] == pytest.approx(found.probability[i], abs=1e-4)
        assert (other.view[j], other.end_on[j]) == (found.view[i], found.end_on[i])
    once = OnnxDetector(read_onnx(str(FILE)), net.settings.changed(mirror=False))
    assert not np.array_equal(once.detect(small).probability, found.probability)
    assert np.array_equal(
        once.detect(street[0]).boxes, net.detect(street[0]).boxes
    )  # this one fills the input


def test_a_wide_box_is_no_front_where_photographs_of_sides_are_judged():
    class Fixed:
        def detect(self, image):
            boxes = np.array([[10, 10, 94, 40], [110, 5, 194, 80]], float)  # wide; as high as a front
            return Detections(boxes, np.array([0.9, 0.8]), end_on=np.array([True, True]))

    photo = LabelledImage("photo", np.zeros((90, 210), np.uint8), np.array([[8.0, 5.0, 98.0, 45.0]]))
    score = score_on(Fixed(), [photo], "single")
    assert (score.row["recall"], score.row["precision"]) == (1.0, 1.0)


def test_crops_are_judged_by_a_box_in_their_middle(tmp_path):
    """Grey levels say what the toy detector finds in a crop: nothing, a car, a small one, or one aside."""
    places = {10: [4, 4, 60, 50], 20: [25, 25, 45, 45], 30: [-40, 0, 24, 60]}

    class Toy:
        def detect(self, image):
            box = places.get(int(image[0, 0]))
            if box is None:
                return Detections(np.zeros((0, 4)), np.zeros(0))
            return Detections(np.array([box], float), np.array([0.9]))

    def crops(*levels):
        return [np.full((64, 64), level, np.uint8) for level in levels]

    cars, others = crops(*[10] * 30, *[20] * 15, *[30] * 15), crops(*[0] * 19, 10)
    low, high = recall_on_crops(Toy(), Crops(cars, others))
    assert (low["false_positives"], low["recall"], low["cars"], low["others"]) == (0.01, 0.0, 60, 20)
    assert (high["recall"], high["interval"]) == (0.5, pytest.approx(1.96 * np.sqrt(7.5 / 29 / 30)))
    with pytest.raises(InputError, match="20 crops of cars, want at least 30"):
        recall_on_crops(Toy(), Crops(others, cars))
    for name, images in (("positives", cars[:30]), ("negatives", others)):
        (tmp_path / name).mkdir()
        for i, image in enumerate(images):
            cv2.imwrite(str(tmp_path / name / f"{i}.png"), image)
    done = parkenv("evaluate-detector", "--crops", tmp_path, "--model", "front", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "out" / "summary.json").read_text())["rows"]
    assert [row["cars"] for row in rows] == [30, 30]


def test_detectors_are_compared_at_equal_false_positives():
    truth = VehicleBoxes(
        ids=np.array([1, 2, 3], np.int32),
        box=np.array([[10, 20, 60, 50], [0, 20, 40, 60], [70, 20, 90, 24]], np.int32),
        visible_box=np.array([[10, 20, 60, 50], [0, 20, 40, 60], [70, 20, 90, 24]], np.int32),
        visible_fraction=np.array([1.0, 0.5, 0.9]),
        view=np.array([2, 0, 2], np.int8),
        distance=np.array([5.0, 10.0, 19.0]),
    )
    picture = DrivePicture(np.zeros((80, 100, 3), np.uint8), "rain", truth)

    class Fixed:
        def __init__(self, boxes, probability):
            self.found = Detections(np.array(boxes, float), np.array(probability))

        def detect(self, image):
            return self.found

    detectors = {
        # The second car reaches beyond the border; the low one need not be found.
        "good": Fixed(
            [[10, 20, 60, 50], [-15, 20, 40, 60], [70, 20, 90, 24], [0, 70, 9, 79]], [0.3, 0.2, 0.9, 0.1]
        ),
        # A false positive is surer than the first car, and a second box on a car is one, too.
        "bad": Fixed(
            [[10, 20, 60, 50], [70, 60, 95, 79], [0, 20, 40, 60], [2, 20, 40, 60]], [0.3, 0.5, 0.9, 0.8]
        ),
    }
    rows = {row["part"]: row for row in score_on_drives(detectors, [picture], 0.0)}
    assert rows["all"] == {"part": "all", "cars": 2, "good": 1.0, "bad": 0.5}
    assert rows["rain"] == rows["all"] | {"part": "rain"}
    assert rows["dusk"] == {"part": "dusk", "cars": 0, "good": None, "bad": None}
    assert rows["whole and clear"] == {"part": "whole and clear", "cars": 1, "good": 1.0, "bad": 0.0}
    assert rows["9 to 12 m"]["bad"] == rows["30% to 60% visible"]["bad"] == 1.0
    more = {row["part"]: row for row in score_on_drives(detectors, [picture], 2.0)}
    assert more["all"]["bad"] == 1.0


def test_what_takes_detectors_takes_net(tmp_path, street):
    cv2.imwrite(str(tmp_path / "photo.png"), street[0][..., ::-1])
    done = parkenv("detect", tmp_path / "photo.png", "--detector", "net", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "3 cars in 1 image" in done.stdout
    with (tmp_path / "out" / "boxes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["view"] for row in rows} == {"side", "oblique"}
    assert all(float(row["visible_fraction"]) > 0.8 for row in rows)
    assert (tmp_path / "out" / "photo_cars.png").is_file()


def made_scene(seed=0):
    """A picture with a light car, half of it behind the border, and a dark one."""
    rng = np.random.default_rng(seed)
    grey = rng.integers(80, 120, (96, 128), dtype=np.uint8)
    car = np.zeros((96, 128), np.uint8)
    car[40:70, 30:90], car[50:66, 0:20] = 1, 2
    grey[car == 1], grey[car == 2] = 200, 20
    depth = np.where(car > 0, 64, 120).astype(np.uint8)
    visible, view = np.array([0.9, 1.0], np.float32), np.array([View.SIDE, View.END], np.int8)
    return SimulatedScene(grey, car, depth, visible, view, np.array([7.0, 9.0], np.float32))


@pytest.mark.parametrize("size", SIZES)
def test_examples_have_the_boxes_of_their_cars(size):
    maker = ExampleMaker([made_scene()], np.random.default_rng(1), textures=3)
    again = ExampleMaker([made_scene()], np.random.default_rng(1), textures=3)
    found = 0
    for _ in range(30):
        example, same = maker.draw(size), again.draw(size)
        assert np.array_equal(example.image, same.image)
        assert example.image.shape == size[::-1]
        assert example.image.dtype == np.uint8
        for boxes in (example.boxes, example.either):
            assert (boxes[:, :2] >= 0).all()
            assert (boxes[:, 2:] <= size).all()
            assert (boxes[:, 2:] > boxes[:, :2]).all()
        assert len(example.boxes) == len(example.view) == len(example.visible)
        assert (example.view == View.SIDE).all()  # the other car is cut off by its picture
        assert ((example.visible >= 0.3) & (example.visible <= 1.0)).all()
        found += len(example.boxes)
    assert found > 15


def test_pictures_are_kept_and_read_again(tmp_path):
    folder = tmp_path / "pictures"
    folder.mkdir()
    (folder / "street_0_0.npz").write_bytes(b"no pictures")
    with pytest.raises(InputError, match=r"street_0_0\.npz"):
        next(simulated_scenes(1, 0, folder))
    np.savez(folder / "street_0_0.npz", grey_0=np.zeros((4, 4), np.uint8))
    with pytest.raises(
        InputError, match=r"street_0_0\.npz: holds no array 'car_0', want pictures of a street"
    ):
        next(simulated_scenes(1, 0, folder))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--simulated", 2, "--out", "net.npz"], "--out net.npz: want a name that ends in .onnx"),
        (["--simulated", 2, "--uiuc", ".", "--out", "net.onnx"], "give one of --uiuc FOLDER"),
    ],
)
def test_a_training_that_cannot_be_is_refused_in_one_line(tmp_path, words, message):
    done = parkenv("train-detector", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert message in " ".join(done.stderr.split())
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_short_training_repeats_and_its_file_gives_the_same(tmp_path):
    torch = pytest.importorskip("torch")
    from parkenv.perception.lab.center_network import INPUT, CenterNetwork, to_onnx
    from parkenv.perception.lab.center_training import CenterTrainingSettings, as_input, train_centers

    scenes = [*simulated_scenes(1, 0, tmp_path)]
    assert len(scenes) == FRAMES
    read = [*simulated_scenes(1, 0, tmp_path)]
    assert all(
        np.array_equal(a.grey, b.grey) and np.array_equal(a.car, b.car)
        for a, b in zip(scenes, read, strict=True)
    )
    told = []
    settings = CenterTrainingSettings(steps=4, batch=2, averaging=0.5, textures=4)
    network = train_centers(scenes, settings, told.append)
    again = train_centers(scenes, settings)
    assert all(torch.equal(a, b) for a, b in zip(network.parameters(), again.parameters(), strict=True))
    # The file gives what the network gives, but for weights of 16 bits.
    (tmp_path / "net.onnx").write_bytes(to_onnx(network, (0.5, -1.0), {"steps": 4}))
    image = cv2.resize(scenes[0].grey, INPUT)
    with torch.no_grad():
        made = network(as_input([image]))[0].numpy()
    runner = cv2.dnn.readNetFromONNX(str(tmp_path / "net.onnx"))
    runner.setInput(as_input([image]).contiguous().numpy())
    cells = runner.forward()[0]
    assert cells[0] == pytest.approx(1.0 / (1.0 + np.exp(-(0.5 * made[0] - 1.0))), abs=2e-3)
    assert cells[1:5] == pytest.approx(16.0 * np.exp(made[1:5].clip(-4, 4)), rel=2e-2)
    assert cells[5:8].sum(axis=0) == pytest.approx(np.ones((60, 80)), abs=1e-5)
    untrained = CenterNetwork()
    assert sum(p.numel() for p in untrained.parameters()) < 1_000_000
