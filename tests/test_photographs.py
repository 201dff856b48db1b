"""Videos and folders of anybody's photographs: boxes with frame and time, films, and training from labels."""

import json

import cv2
import numpy as np
import pytest
from command_line import parkenv, ran, refused, rows_in, summary_of

from parkenv import InputError
from parkenv.files.videos import Video, film
from parkenv.perception.car_model import CarModel
from parkenv.perception.detector import Detections
from parkenv.perception.labelled_folders import crops_of, read_labels

SIZE = (160, 120)


class Bright:
    """Finds the bright rectangle."""

    def detect(self, image):
        grey = image if image.ndim == 2 else image.mean(axis=2)
        rows, columns = np.nonzero(grey > 200)
        if not len(rows):
            return Detections(np.zeros((0, 4)), np.zeros(0))
        box = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        return Detections(np.array([box], float), np.array([0.9]))


BRIGHT = f"{__name__}:Bright"


def drawn(k):
    image = np.full((SIZE[1], SIZE[0], 3), 40, np.uint8)
    if k != 3:
        image[40:70, 10 + 5 * k : 70 + 5 * k] = 250
    return image


@pytest.fixture
def folder(tmp_path):
    """A folder with a video of ten frames and a picture."""
    (tmp_path / "in").mkdir()
    with film(tmp_path / "in" / "drive.mp4", SIZE, 10.0) as append:
        for k in range(10):
            append(drawn(k))
    cv2.imwrite(str(tmp_path / "in" / "photo.png"), drawn(2))
    return tmp_path / "in"


def test_a_folder_of_pictures_and_videos_becomes_boxes_and_films(folder, tmp_path):
    out = tmp_path / "out"
    done = ran("detect --step 2", folder, "--detector", BRIGHT, "--out", out)
    rows = rows_in(out / "boxes.csv")
    frames = [r for r in rows if r["frame"]]
    assert [int(r["frame"]) for r in frames] == [0, 2, 4, 6, 8]
    assert [float(r["time_s"]) for r in frames] == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8])
    assert [float(r["left"]) for r in frames] == pytest.approx([10, 20, 30, 40, 50], abs=3)
    (picture,) = [r for r in rows if not r["frame"]]
    assert (picture["left"], picture["view"], picture["time_s"]) == ("20.0", "side", "")
    assert picture["visible_fraction"] == ""  # this detector does not know
    summary = summary_of(out)
    assert [row["file"] for row in summary["rows"]] == [str(folder / "photo.png")]
    (video,) = summary["videos"]
    assert (video["frames"], video["boxes"], video["most_cars"]) == (5, 5, 1)
    assert "drive.mp4: 5 frames of 0.9 s, 5 boxes, at most 1 car in a frame" in done.stdout
    film = Video.of(out / "drive_cars.mp4")
    assert (film.width, film.height, film.frames, film.fps) == (*SIZE, 5, pytest.approx(5.0))
    assert (out / "photo_cars.png").is_file()


@pytest.mark.parametrize("content", [b"I am no video", None])
def test_a_video_without_frames_is_refused_in_a_line_before_any_work(folder, tmp_path, content, capfd):
    whole = (folder / "drive.mp4").read_bytes()
    (folder / "z.mp4").write_bytes(whole[:200] if content is None else content)
    said = refused("detect", folder, "--detector", BRIGHT, "--out", tmp_path / "out")
    assert "z.mp4: is not a video with readable frames, want .mp4, .mov" in " ".join(said.split())
    assert not (tmp_path / "out").exists()
    assert not capfd.readouterr().err


def car(rng, image, left, top, width, height):
    """Draw a toy car."""
    image[top : top + height, left : left + width] = rng.integers(150, 220)
    image[top + height // 2 :, left : left + width][: height // 2] = rng.integers(60, 110)
    for x in (0.2, 0.8):
        cv2.circle(image, (int(left + x * width), top + height), max(height // 6, 2), 10, -1)


def street(rng):
    """A picture and its boxes: a side view, a front view and a dog."""
    image = rng.integers(90, 130, (SIZE[1], 240), dtype=np.uint8)
    width = int(rng.integers(50, 70))
    side = (10 + int(rng.integers(20)), 60, width, width // 3)
    car(rng, image, *side)
    front = (150 + int(rng.integers(20)), 40, 40, 32)
    car(rng, image, *front)
    return image, [(0, side), (0, front), (1, (120, 20, 8, 8))]


def write_coco(folder, n=14, seed=0):
    rng = np.random.default_rng(seed)
    (folder / "pictures").mkdir(parents=True)
    categories = [{"id": 3, "name": "car"}, {"id": 18, "name": "dog"}]
    tables = {"images": [], "annotations": [], "categories": categories}
    for k in range(n):
        image, boxes = street(rng)
        cv2.imwrite(str(folder / "pictures" / f"{k}.png"), image)
        tables["images"].append({"id": k, "file_name": f"{k}.png", "width": 240, "height": SIZE[1]})
        tables["annotations"] += [
            {"image_id": k, "category_id": (3, 18)[its], "bbox": list(map(float, box))} for its, box in boxes
        ]
    (folder / "labels.json").write_text(json.dumps(tables))
    return tables


def write_yolo(folder, n=14, seed=0, beside=False):
    rng = np.random.default_rng(seed)
    places = ("", "") if beside else ("images/train", "labels/train")
    for place in places:
        (folder / place).mkdir(parents=True, exist_ok=True)
    for k in range(n):
        image, boxes = street(rng)
        cv2.imwrite(str(folder / places[0] / f"{k}.png"), image)
        lines = [
            f"{its} {(x + w / 2) / 240:.8f} {(y + h / 2) / SIZE[1]:.8f} {w / 240:.8f} {h / SIZE[1]:.8f}\n"
            for its, (x, y, w, h) in boxes
        ]
        (folder / places[1] / f"{k}.txt").write_text("".join(lines))
    named = "path: .\ntrain: images/train\nnames: [car, dog]\n"
    (folder / ("classes.txt" if beside else "data.yaml")).write_text("car\ndog\n" if beside else named)


def test_coco_and_yolo_say_the_same(tmp_path):
    write_coco(tmp_path / "coco")
    write_yolo(tmp_path / "yolo")
    write_yolo(tmp_path / "beside", beside=True)
    coco = read_labels(tmp_path / "coco" / "labels.json", tmp_path / "coco" / "pictures")
    for other in (read_labels(tmp_path / "yolo"), read_labels(tmp_path / "beside")):
        assert [p.labelled.name for p in coco] == [p.labelled.name for p in other]
        for one, two in zip(coco, other, strict=True):
            assert one.labelled.boxes.shape == (2, 4)
            np.testing.assert_allclose(one.labelled.boxes, two.labelled.boxes, atol=1e-3)
    dogs = read_labels(tmp_path / "yolo", classes=("dog",))
    assert [len(p.labelled.boxes) for p in dogs] == [1] * 14


def test_sides_and_fronts_are_told_apart(tmp_path):
    write_yolo(tmp_path, n=25)
    photos = read_labels(tmp_path)
    sides, mined = crops_of(photos, end_on=False)
    fronts, _ = crops_of(photos, end_on=True)
    assert len(sides.positives) == len(fronts.positives) == len(mined) == 25
    assert {round(c.shape[1] / c.shape[0], 1) for c in sides.positives} <= {2.4, 2.5, 2.6}
    assert {c.shape for c in fronts.positives} == {(48, 48)}
    again, _ = crops_of(photos, end_on=False)
    for one, two in zip(sides.negatives, again.negatives, strict=True):
        np.testing.assert_array_equal(one, two)


def test_a_model_is_trained_on_labels_and_finds_its_cars(tmp_path):
    write_coco(tmp_path, n=30)
    words = ("--labels", tmp_path / "labels.json", "--images", tmp_path / "pictures")
    done = parkenv("train-detector --rounds 1 --jitter 1", *words, "--out", tmp_path / "a.npz")
    assert done.returncode == 0, done.stderr
    assert CarModel.load(tmp_path / "a.npz").region_aspect == 2.5
    picture, out = tmp_path / "pictures" / "0.png", tmp_path / "found"
    ran("detect --least-height 16", picture, "--model", tmp_path / "a.npz", "--out", out)
    best = max(summary_of(out)["rows"], key=lambda row: row["probability"])["box"]
    true = read_labels(tmp_path / "labels.json", tmp_path / "pictures")[0].labelled.boxes[0]
    np.testing.assert_allclose(best, true, atol=12)


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda t: t["annotations"][4].update(bbox=[200, 0, 60, 9]), r"annotations\.4: box .* is not inside 1\.png"),
        (lambda t: t["annotations"][2].update(category_id=9), r"annotations\.2\.category_id is 9, want one of 3, 18"),
        (lambda t: t["annotations"][2].update(image_id=99), r"annotations\.2\.image_id is 99, which no entry"),
        (lambda t: t["images"][2].update(file_name="lost.png"), r"images\.2: there is no picture at .*lost\.png"),
        (lambda t: t["images"][2].update(file_name="../../x.png"), r"images\.2\.file_name is '../../x.png', want"),
        (lambda t: t["categories"][0].update(name="cat"), r"of its classes \(cat, dog\) none is known as a car"),
        (lambda t: t["annotations"].clear(), "none of its 3 pictures has a label of a car"),
    ],
)  # fmt: skip
def test_damaged_coco_is_refused_in_a_line(tmp_path, break_it, message):
    tables = write_coco(tmp_path, n=3)
    break_it(tables)
    (tmp_path / "labels.json").write_text(json.dumps(tables))
    with pytest.raises(InputError, match=message) as caught:
        read_labels(tmp_path / "labels.json", tmp_path / "pictures")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("labels/train/1.txt", "0 0.9 0.5 0.4 0.1\n", r"1\.txt: line 1: box 168, .* is not inside 1\.png"),
        ("labels/train/1.txt", "\n7 0.5 0.5 0.4 0.1\n", r"1\.txt: line 2: class is 7, want one of 0 car, 1"),
        ("labels/train/1.txt", "0 0.5 half 0.4 0.1\n", r"1\.txt: line 1: '0 0\.5 half .*, want class, x, y"),
        ("labels/train/9.txt", "0 0.5 0.5 0.4 0.1\n", r"9\.txt: labels a picture that is missing"),
        ("data.yaml", "names: 3\n", r"data\.yaml: names is 3, want a list of the classes' names"),
    ],
)
def test_damaged_yolo_is_refused_in_a_line(tmp_path, name, text, message):
    write_yolo(tmp_path, n=3)
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        read_labels(tmp_path)


def test_labels_of_few_cars_or_without_names_are_refused(tmp_path):
    words = ("train-detector --labels", tmp_path, "--out", tmp_path / "m.npz")
    write_yolo(tmp_path, n=3)
    assert "the labels have 3 whole cars seen from the side of at least 36 px" in refused(*words)
    assert "has no class 'bus'; known: car, dog" in refused(*words, "--classes", "bus")
    (tmp_path / "data.yaml").unlink()
    assert "has neither data.yaml with names nor classes.txt" in refused(*words)
    assert "give one of --uiuc FOLDER, --crops FOLDER and --labels" in refused(*words, "--uiuc", tmp_path)
