"""Finding cars: training, files, the sliding window, and scores by UIUC's rule."""

import dataclasses
import json
import os
import zipfile

import cv2
import numpy as np
import pytest
from command_line import parkenv

from parkenv import InputError
from parkenv.perception.car_datasets import Crops, LabelledImage, read_uiuc_test, read_uiuc_training
from parkenv.perception.car_model import CarModel
from parkenv.perception.detection_scores import matches, recall_on_crops, recall_precision, score_on
from parkenv.perception.detector import Detections, GroundBand
from parkenv.perception.hog import Descriptor
from parkenv.perception.hog_detector import HogDetector, best_boxes
from parkenv.perception.training import TrainingSettings, train


def toy_car(rng, size=(100, 40)):
    """Two wheels under a box: enough of a car for a linear model."""
    image = rng.integers(90, 120, (40, 100)).astype(np.uint8)
    shade = int(rng.integers(150, 230))
    cv2.rectangle(image, (8, 16), (92, 32), shade, -1)
    cv2.rectangle(image, (28, 7), (70, 18), shade - 40, -1)
    for x in (24, 76):
        cv2.circle(image, (x, 32), 6, 20, -1)
    return cv2.resize(image, size)


def clutter(rng):
    image = rng.integers(60, 160, (12, 30)).astype(np.uint8)
    way = cv2.INTER_NEAREST if rng.random() < 0.5 else cv2.INTER_CUBIC
    return cv2.resize(image, (150, 60), None, 0, 0, way)


@pytest.fixture(scope="module")
def crops():
    rng = np.random.default_rng(0)
    return [toy_car(rng) for _ in range(40)], [clutter(rng) for _ in range(60)]


@pytest.fixture(scope="module")
def model(crops):
    return train(*crops, settings=TrainingSettings(rounds=2, seed=1), trained_on="toys")


def street(rng, places):
    image = cv2.resize(rng.integers(80, 130, (24, 40)).astype(np.uint8), (400, 240))
    for x, y, width in places:
        car = toy_car(rng, (width, round(0.4 * width)))
        image[y : y + car.shape[0], x : x + width] = car
    return image


def test_cars_on_the_ground_are_those_of_the_whole_image(model):
    image = street(np.random.default_rng(8), [(20, 20, 100), (150, 100, 130), (290, 180, 90)])
    detector = HogDetector((model, model), scale_step=1.1, threshold=0.01)
    band = GroundBand.of(110.0, 1.3, 0.7, (0.8, 3.2), 1.5)
    assert (band.least, band.most) == pytest.approx((0.24, 4 / 3))
    everything, near = detector.scan(model, image), detector.scan(model, image, band)
    height = everything.boxes[:, 3] - everything.boxes[:, 1]
    below = (everything.boxes[:, 3] - band.horizon) / height
    inside = (below > band.least - 1e-4) & (below < band.most + 1e-4)
    assert 0 < inside.sum() < len(inside)
    np.testing.assert_allclose(near.boxes, everything.boxes[inside], atol=1e-3)
    np.testing.assert_allclose(near.score, everything.score[inside], atol=1e-5)
    assert detector.detect_on_ground(image, band).probability.max() == near.probability.max()
    assert not len(detector.detect_on_ground(image, GroundBand(-1000.0, 0.24, 1.3)))


def test_cars_are_found_where_they_are_at_every_size(model):
    rng = np.random.default_rng(5)
    places = [(20, 30, 100), (200, 20, 180), (60, 120, 130)]
    found = HogDetector((model,), scale_step=1.1, threshold=0.5).detect(street(rng, places))
    truth = np.array([[x, y, x + w, y + 0.4 * w] for x, y, w in places], float)
    assert matches(found.regions.astype(float), truth)[:3].all()
    assert (np.diff(found.probability) <= 0).all()
    assert not len(HogDetector((model,), threshold=0.5).detect(street(rng, [])))


def test_equal_training_gives_equal_files_from_which_a_model_comes_back(crops, model, tmp_path):
    again = train(*crops, settings=TrainingSettings(rounds=2, seed=1), trained_on="toys")
    model.save(tmp_path / "a.npz")
    again.save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    one, two = (train(*crops, settings=TrainingSettings(rounds=0, seed=seed)).weights for seed in (1, 2))
    assert not np.array_equal(one, two)
    back = CarModel.load(tmp_path / "a.npz")
    np.testing.assert_array_equal(back.weights, model.weights)
    for name in ("bias", "calibration", "car", "trained_on"):
        assert getattr(back, name) == getattr(model, name)


def test_bad_model_files_are_told_apart(model, tmp_path):
    (tmp_path / "text.npz").write_text("hello")
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    model.save(tmp_path / "new.npz")
    with zipfile.ZipFile(tmp_path / "new.npz") as archive:
        weights, raw = archive.read("weights.npy"), archive.read("settings.npy")
    start = raw.index(b'{"bias"')  # the header of the array is a dict, too
    text = raw[start:].replace(b'"version": 2', b'"version": 9')
    assert json.loads(text)["version"] == 9
    with zipfile.ZipFile(tmp_path / "new.npz", "w") as archive:
        archive.writestr("weights.npy", weights)
        archive.writestr("settings.npy", raw[:start] + text)
    for name, message in (
        ("text.npz", "not a zip archive"),
        ("other.npz", "not a car model"),
        ("new.npz", "format version 9, want 2"),
        ("none.npz", "no such model; want side, front, or an .npz file"),
    ):
        with pytest.raises(InputError, match=message):
            CarModel.load(tmp_path / name)


def test_weights_of_another_shape_are_refused(model):
    with pytest.raises(InputError, match=r"weights are \(3,\), want finite \(8, 9, 16\)"):
        dataclasses.replace(model, descriptor=Descriptor(), weights=np.zeros(3, np.float32))


def test_the_shipped_models_are_small_and_say_what_they_know():
    side, front = CarModel.load("side"), CarModel.load("front")
    assert (side.descriptor.size, front.descriptor.size) == (1152, 2304)
    assert front.end_on
    assert not side.end_on
    assert "simulated" in side.trained_on


def test_any_size_and_colour_is_looked_at(model):
    detector = HogDetector((model,))
    assert len(detector.detect(np.zeros((3, 5), np.uint8))) == 0
    assert len(detector.detect(np.zeros((9, 9, 3), np.uint8))) == 0
    detector.detect(np.zeros((1500, 2000), np.uint8))
    for bad in (np.zeros((9, 9), np.uint16), np.zeros((9, 9, 4), np.uint8), np.zeros((0, 9), np.uint8)):
        with pytest.raises(InputError, match="image is"):
            detector.detect(bad)


def test_of_boxes_that_overlap_the_best_is_kept_and_a_part_of_a_car_is_no_second_one():
    boxes = np.array([[0, 0, 10, 10], [1, 0, 11, 10], [20, 0, 30, 10]], np.float32)
    assert best_boxes(boxes, np.array([0.5, 0.9, 0.1], np.float32), 0.4).tolist() == [1, 2]
    # A car, its front wheel, a neighbour that hides a tenth of it, and a far car above its bonnet.
    boxes = np.array([[0, 0, 200, 80], [10, 40, 75, 66], [180, 0, 380, 80], [0, -20, 90, 16]], np.float32)
    by_overlap = best_boxes(boxes, np.array([0.9, 0.8, 0.7, 0.6], np.float32), 0.4)
    assert by_overlap.tolist() == [0, 1, 2, 3]
    assert best_boxes(boxes, np.array([0.9, 0.8, 0.7, 0.6], np.float32), 0.4, 0.6).tolist() == [0, 2, 3]
    # The better one is kept, whichever is larger.
    assert best_boxes(boxes, np.array([0.5, 0.8, 0.7, 0.6], np.float32), 0.4, 0.6).tolist() == [1, 2, 3]


def test_parts_of_cars_are_mined_where_there_are_no_photographs(crops):
    plain, closer = (train(*crops, settings=TrainingSettings(rounds=2, enlarged=by)) for by in (0.0, 2.0))
    rng = np.random.default_rng(3)
    wheels = [cv2.resize(toy_car(rng), (300, 120))[60:120, 75 * (k // 20) :][:, :150] for k in range(60)]
    windows = np.stack([cv2.resize(w, (128, 64)) for w in wheels])
    cars = np.stack([cv2.resize(toy_car(rng), (128, 64)) for _ in range(20)])
    assert closer.scores(windows).max() < plain.scores(windows).max()
    assert closer.scores(cars).min() > closer.scores(windows).max()


def test_recall_and_precision_of_a_known_case():
    truth = [np.array([[0, 0, 100, 40], [200, 0, 300, 40]], float), np.array([[0, 0, 100, 40]], float)]
    boxes = [[2, 1, 102, 41], [3, 0, 103, 40], [0, 100, 100, 140]], [[5, 0, 105, 40]]
    found = [np.array(its, float) for its in boxes]
    curve = recall_precision(found, [np.array([0.9, 0.8, 0.1]), np.array([0.7])], truth)
    # 0.9 right, 0.8 a second box on the same car, 0.7 right, 0.1 nothing there.
    np.testing.assert_allclose(curve.recall, [1 / 3, 1 / 3, 2 / 3, 2 / 3])
    np.testing.assert_allclose(curve.precision, [1, 1 / 2, 2 / 3, 1 / 2])
    assert min(curve.at_equal_error) == pytest.approx(2 / 3)
    assert curve.average_precision == pytest.approx(1 / 3 + 1 / 3 * 2 / 3)


def test_the_ellipse_is_a_quarter_of_the_box():
    truth = np.array([[100, 100, 200, 140]], float)
    cases = (24, 0, 0, 1), (26, 0, 0, 0), (0, 9.9, 0, 1), (18, 8, 0, 0), (0, 0, 24, 1), (0, 0, 26, 0)
    for dx, dy, dw, inside in cases:
        box = np.array([[100 + dx - dw / 2, 100 + dy, 200 + dx + dw / 2, 140 + dy]], float)
        assert matches(box, truth)[0] == bool(inside), (dx, dy, dw)
    assert matches(np.array([[75, 100, 225, 140]], float), truth, scales=False)[0]


def test_a_wide_box_is_no_front_where_photographs_of_sides_are_judged():
    class Fixed:
        def detect(self, image):
            boxes = np.array([[10, 10, 94, 40], [110, 5, 194, 80]], float)  # wide; as high as a front
            return Detections(boxes, np.array([0.9, 0.8]), end_on=np.array([True, True]))

    photo = LabelledImage("photo", np.zeros((90, 210), np.uint8), np.array([[8.0, 5.0, 98.0, 45.0]]))
    score = score_on(Fixed(), [photo], "single")
    assert (score["recall"], score["precision"]) == (1.0, 1.0)


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


def write_uiuc(folder, rng):
    (folder / "TrainImages").mkdir(parents=True)
    for i in range(25):
        cv2.imwrite(str(folder / f"TrainImages/pos-{i}.pgm"), toy_car(rng))
        cv2.imwrite(str(folder / f"TrainImages/neg-{i}.pgm"), clutter(rng)[:40, :100])
    for name, places in (("TestImages", [(30, 50, 100)]), ("TestImages_Scale", [(30, 50, 140)])):
        (folder / name).mkdir()
        for n in range(4):
            cv2.imwrite(str(folder / name / f"test-{n}.pgm"), street(rng, places))
    (folder / "trueLocations.txt").write_text("".join(f"{n}: (50,30)\n" for n in range(4)))
    (folder / "trueLocations_Scale.txt").write_text("".join(f"{n}: (50,30,140)\n" for n in range(4)))


def test_uiuc_is_read_as_published_trained_on_and_judged(tmp_path):
    data = tmp_path / "CarData"
    write_uiuc(data, np.random.default_rng(7))
    assert len(read_uiuc_training(data).positives) == 25
    np.testing.assert_array_equal(read_uiuc_test(data, "multi")[0].boxes, [[30, 50, 170, 106]])

    done = parkenv("train-detector", "--uiuc", data, "--out", tmp_path / "m.npz", "--rounds", 1)
    assert done.returncode == 0, done.stderr
    done = parkenv(
        "evaluate-detector --uiuc", data, "--model", tmp_path / "m.npz", "--out", tmp_path / "scores"
    )
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "scores" / "summary.json").read_text())["rows"]
    assert [r["test_set"] for r in rows] == ["single", "multi"]
    assert rows[0]["cars"] == 4
    assert min(r["eer"] for r in rows) >= 0.75


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda f: (f / "trueLocations.txt").write_text("0: (1,2,3)\n"), "line '0: .1,2,3.', want n:"),
        (lambda f: (f / "trueLocations.txt").unlink(), "trueLocations.txt: no such file"),
        (lambda f: os.truncate(f / "TestImages/test-0.pgm", 900), "test-0.pgm: is not a complete image"),
    ],
)
def test_a_damaged_set_is_named(tmp_path, break_it, message):
    write_uiuc(tmp_path, np.random.default_rng(7))
    break_it(tmp_path)
    with pytest.raises(InputError, match=message):
        read_uiuc_test(tmp_path, "single")


def test_too_little_to_train_on_and_bad_settings_are_named(model, crops):
    def hog(**settings):
        return lambda: HogDetector(**{"models": (model,), **settings})

    for make, message in (
        (lambda: train(crops[0][:3], crops[1]), "3 positives and 60 negatives, want at least 20 and 1"),
        (lambda: TrainingSettings(penalty=0.0), "penalty is 0"),
        (lambda: TrainingSettings(enlarged=0.5), r"enlarged is 0\.5, want 0 or 1 to 8"),
        (hog(models=()), "models is empty"),
        (hog(scale_step=1.0), "scale_step is 1.0"),
        (hog(inside=1.2), "inside is 1.2, want a finite number from 0 to 1"),
    ):
        with pytest.raises(InputError, match=message):
            make()


def grey_image(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(path.suffix, np.zeros((70, 140), np.uint8))[1].tobytes())
    return path


def test_a_damaged_image_is_refused_first_and_a_picture_never_replaces_an_image_that_is_searched(tmp_path):
    os.truncate(grey_image(tmp_path / "photos" / "b.png"), 40)
    grey_image(tmp_path / "photos" / "a.png")
    refused = parkenv("detect", tmp_path / "photos", "--out", tmp_path / "out")
    assert (refused.returncode, refused.stdout, (tmp_path / "out").exists()) == (2, "", False)
    assert f"{tmp_path / 'photos' / 'b.png'}: is not a complete image" in refused.stderr
    own = tmp_path / "own"
    a, before = grey_image(own / "a.png"), grey_image(own / "a_cars.png").read_bytes()
    refused = parkenv("detect", own, "--out", own)
    assert (refused.returncode, refused.stdout) == (2, "")
    assert "a_cars.png would replace an image that is searched" in refused.stderr
    assert (own / "a_cars.png").read_bytes() == before
    assert parkenv("detect", a, "--model", "side", "--out", own).returncode == 0
