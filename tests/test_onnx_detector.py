"""Detectors as ONNX files, a stranger's and the packaged one: how they are read and what they find."""

import copy
import json
import pickle
import zipfile

import cv2
import numpy as np
import pytest
from command_line import ran, refused, rows_in, summary_of
from numba import config, get_num_threads, set_num_threads
from onnx import TensorProto, helper, numpy_helper
from onnx import load as load_onnx
from tiny_networks import SIZE, Tiny

from parkenv import InputError, make_scenario
from parkenv.compiled.threads import ahead_in_threads
from parkenv.perception.detector_registry import MODELS, detector_version, make_detector
from parkenv.perception.onnx_detector import OnnxDetector, OnnxSettings, decode_centers
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.studies.compare.comparison import Comparison
from parkenv.studies.results import SETTINGS
from parkenv.studies.sensing.survey_study import SurveyStudy
from sim_sensors.camera.models import PinholeCamera, camera_pose
from sim_sensors.camera.weather import Weather
from sim_sensors.ground_truth import View, vehicle_boxes
from sim_sensors.scene import Fleet, Scene
from sim_sensors.surroundings import Surroundings
from sim_sensors.vehicles.vehicle import VehicleModel

CARS = [0, 2]
TOML = "size = [64, 64]\ncars = [0, 2]\n"
GOOD = Tiny().model().SerializeToString()
FILE = MODELS / "net.onnx"


def photo(width=90, height=50, seed=0):
    small = np.random.default_rng(seed).integers(0, 256, (5, 9, 3), dtype=np.uint8)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_NEAREST)


def plain_input(image, grey=False):
    """The network's input, one pixel after another; and scale and offset of the image in it."""
    height, width = image.shape[:2]
    scale = min(SIZE / width, SIZE / height)
    new = (round(width * scale), round(height * scale))
    left, top = (SIZE - new[0]) // 2, (SIZE - new[1]) // 2
    image = cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if grey else image, new)
    image = image.reshape(new[1], new[0], -1)
    fed = np.full((1, image.shape[2], SIZE, SIZE), 114.0)
    for c in range(image.shape[2]):
        for y in range(new[1]):
            for x in range(new[0]):
                fed[0, c, top + y, left + x] = image[y, x, c]
    return (fed / 255.0).astype(np.float32), (new[0] / width, new[1] / height), (left, top)


def plain_detect(tiny, image, threshold, most, grey=False):
    """What the adapter should find, candidate by candidate: rows left, top, right, bottom, score, by score."""
    fed, (scale_x, scale_y), (left, top) = plain_input(image, grey)
    found = []
    for x, y, w, h, *scores in tiny.rows(fed).tolist():
        score = max(scores[c] for c in CARS)
        box = [(x - w / 2 - left) / scale_x, (y - h / 2 - top) / scale_y]
        box += [(x + w / 2 - left) / scale_x, (y + h / 2 - top) / scale_y]
        if score >= threshold and box[2] > box[0] and box[3] > box[1]:
            found.append(np.array([*box, score]))
    found.sort(key=lambda r: -r[4])
    kept = []
    for one in found:
        if all(overlap(one, other) <= most for other in kept):
            kept.append(one)
    return np.array(kept)


def test_threads_share_a_network_and_leave_opencv_as_it_was(tmp_path):
    detector = make_detector(str(Tiny().save(tmp_path / "tiny.onnx")))
    pictures, threads = [photo(seed=seed) for seed in range(12)], cv2.getNumThreads()
    before = get_num_threads()
    set_num_threads(min(2, config.NUMBA_NUM_THREADS))
    found = list(ahead_in_threads(detector.detect, iter(pictures)))
    set_num_threads(before)
    assert [picture is one for (picture, _), one in zip(found, pictures, strict=True)] == [True] * 12
    for picture, of_threads in found:
        np.testing.assert_array_equal(of_threads.boxes, detector.detect(picture).boxes)
    assert cv2.getNumThreads() == threads


@pytest.mark.parametrize(
    ("channels", "settings", "threshold", "overlap"),
    [(1, 'channels = "grey"\n', 0.08, 0.5), (3, "overlap = 0.3\nthreshold = 0.3\n", 0.3, 0.3)],
)
def test_boxes_are_those_of_a_plain_decoding(tmp_path, channels, settings, threshold, overlap):
    tiny = Tiny(channels=channels)
    file = tiny.save(tmp_path / "tiny.onnx")
    (tmp_path / "tiny.toml").write_text(TOML + settings)
    detector = make_detector(file)
    for image in (photo(), photo(40, 70, seed=1)):
        found = detector.detect(image)
        wanted = plain_detect(tiny, image, threshold, overlap, channels == 1)
        assert len(wanted) > 1
        rows = np.column_stack([found.boxes, found.probability])
        np.testing.assert_allclose(rows, wanted, rtol=1e-3, atol=2e-2)
        width, height = (found.boxes[:, 2:] - found.boxes[:, :2]).T
        np.testing.assert_array_equal(found.end_on, width < 1.8 * height)


def test_a_grey_image_is_one_of_three_equal_channels_and_bgr_is_the_reverse(tmp_path):
    file, grey = Tiny().save(tmp_path / "a.onnx"), photo()[..., 0]
    seen, as_color = (make_detector(file).detect(i) for i in (grey, np.dstack([grey] * 3)))
    np.testing.assert_array_equal(seen.boxes, as_color.boxes)
    rgb = make_detector(file).detect(photo())
    (tmp_path / "a.toml").write_text(TOML + 'channels = "bgr"\n')
    bgr = make_detector(file).detect(np.ascontiguousarray(photo()[..., ::-1]))
    np.testing.assert_array_equal(rgb.boxes, bgr.boxes)


def test_a_detector_is_copied_and_equal_runs_are_equal_on_any_number_of_threads(tmp_path):
    detector = make_detector(Tiny().save(tmp_path / "a.onnx"))
    first, threads = detector.detect(photo()), cv2.getNumThreads()
    try:
        for again, count in ((pickle.loads(pickle.dumps(detector)), 1), (copy.deepcopy(detector), 4)):
            cv2.setNumThreads(count)
            second = again.detect(photo())
            np.testing.assert_array_equal(first.boxes, second.boxes)
            np.testing.assert_array_equal(first.probability, second.probability)
            assert cv2.getNumThreads() == count
    finally:
        cv2.setNumThreads(threads)


def crashes_opencv():
    model = Tiny().model()
    (convolution,) = (node for node in model.graph.node if node.op_type == "Conv" and node.output[0] == "c0")
    convolution.attribute[0].ints[:] = [0, 0]
    return model


def two_outputs():
    model = Tiny().model()
    model.graph.output.append(helper.make_tensor_value_info("between", TensorProto.FLOAT, [1, 7, "n"]))
    return model


def classifier():
    given = [numpy_helper.from_array(np.array([1, -1]), "shape")]
    image = helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, 64, 64])
    flat = helper.make_tensor_value_info("class", TensorProto.FLOAT, [1, 12288])
    node = helper.make_node("Reshape", ["images", "shape"], ["class"])
    graph = helper.make_graph([node], "g", [image], [flat], given)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)


def unknown_operator():
    model = Tiny().model()
    model.graph.node[0].op_type = "Bewitch"
    return model


@pytest.mark.parametrize(
    ("content", "settings", "message"),
    [
        (b"hello, I am no network\n", TOML, r"a\.onnx: OpenCV cannot run this network"),
        (GOOD[:-3], TOML, r"a\.onnx: OpenCV cannot run this network"),
        (crashes_opencv(), TOML, r"a\.onnx: OpenCV cannot run this network .* shape \(1, 3"),
        (unknown_operator(), TOML, r"a\.onnx: OpenCV cannot run this network"),
        (GOOD, 'channels = "grey"\n' + TOML, r"its input is 1 x 3 x 64 x 64, and size and channels in .*a\.toml"),
        (GOOD, "cars = [0]\nsize = [96, 96]", r"its input is 1 x 3 x 64 x 64, .* are for 1 x 3 x 96 x 96"),
        (two_outputs(), TOML, r"a\.onnx: puts out .*; write outputs = \['output0'\], or another"),
        (two_outputs(), TOML + 'outputs = ["output1"]', r"a\.toml: outputs has 'output1'; did you .*output0, between"),
        (two_outputs(), TOML + 'layout = "centers"', r"puts out .*, want \(1, 9, rows, columns\)"),
        (classifier(), TOML, r"puts out class \(1, 12288\), want \(1, 4 \+ classes, n\) or .* a class of your own"),
        (Tiny(is_transposed=True).model(), TOML, r"puts out output0 \(1, 84, 7\), want \(1, 4 \+ classes, n\)"),
        (GOOD, "size = [8, 8]", r"a\.toml: size\.0 is 8, want a number of at least 16"),
        (GOOD, "size = [64, 64]\ncars = [7]", r"a\.toml: cars has 7, want classes of the network, 0 to 2"),
        (GOOD, "size = [64, 64]", r"a\.onnx: has 3 classes; write cars = \[indices from 0\] in .*a\.toml"),
        (GOOD, "treshold = 0.3", r"a\.toml: unknown key 'treshold'; did you mean 'threshold'\?"),
        (GOOD, "threshold = nan", r"a\.toml: threshold is nan, want a finite number"),
    ],
)  # fmt: skip
def test_what_is_no_detector_is_refused_in_a_line(tmp_path, content, settings, message):
    (tmp_path / "a.onnx").write_bytes(content if isinstance(content, bytes) else content.SerializeToString())
    (tmp_path / "a.toml").write_text(settings)
    with pytest.raises(InputError, match=message) as caught:
        make_detector(str(tmp_path / "a.onnx"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("outputs", ["output0", "output0 between", "masks output0", "masks between"])
def test_one_of_several_outputs_is_read(tmp_path, outputs):
    """The file's size counts, where none is set; rows of mask coefficients are no classes."""
    model = two_outputs()
    given = numpy_helper.from_array(np.zeros((1, 2, 16, 16), np.float32), "masks")
    model.graph.node.append(helper.make_node("Constant", [], ["masks"], value=given))
    model.graph.output.append(helper.make_tensor_value_info("masks", TensorProto.FLOAT, [1, 2, 16, 16]))
    (tmp_path / "a.onnx").write_bytes(model.SerializeToString())
    (tmp_path / "a.toml").write_text(f'layout = "yolo"\noutputs = {outputs.split()}\nthreshold = 0.01\n')
    detector = make_detector(str(tmp_path / "a.onnx"))
    (tmp_path / "b.onnx").write_bytes(GOOD)
    (tmp_path / "b.toml").write_text("cars = [0]\nthreshold = 0.01\n")
    wanted = make_detector(str(tmp_path / "b.onnx")).detect(photo())
    found = detector.detect(photo())
    if "output0" in outputs:
        np.testing.assert_array_equal(found.boxes, wanted.boxes)
        np.testing.assert_array_equal(found.probability, wanted.probability)
    else:  # before boxes are scaled to px
        assert found.boxes[:, 2:].max() < wanted.boxes[:, 2:].max()


@pytest.mark.parametrize(
    ("last", "message"),
    [(np.nan, "put out numbers that are not finite"), (50.0, "has scores from .* want 0 to 1")],
)
def test_numbers_that_are_no_scores_are_refused(tmp_path, last, message):
    detector = make_detector(Tiny(last=last).save(tmp_path / "a.onnx"))
    with pytest.raises(InputError, match=message):
        detector.detect(photo())


@pytest.mark.parametrize(("classes", "cars"), [(1, [0]), (80, [2, 5, 7])])
def test_the_only_class_and_those_of_coco_are_known(tmp_path, classes, cars):
    file, found = Tiny(classes).save(tmp_path / "a.onnx"), []
    for line in ("", f"cars = {cars}\n"):
        (tmp_path / "a.toml").write_text(f"size = [64, 64]\n{line}")
        found.append(make_detector(file).detect(photo()).boxes)
    assert len(found[0]) > 1
    np.testing.assert_array_equal(*found)


def test_files_that_are_too_large_are_refused(tmp_path, monkeypatch):
    file = Tiny().save(tmp_path / "a.onnx")
    monkeypatch.setattr("parkenv.perception.onnx_detector.MAX_ONNX_BYTES", 100)
    with pytest.raises(InputError, match="has more than 100 bytes"):
        make_detector(file)


def elsewhere():
    """A tensor whose numbers are in another file."""
    tensor = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[1])
    tensor.external_data.add(key="location", value="/etc/passwd")
    return tensor


@pytest.mark.parametrize(
    "hide",
    [
        lambda model, tensor: model.graph.initializer.append(tensor),
        lambda model, tensor: model.graph.node[0].attribute.add(name="a").t.CopyFrom(tensor),
        lambda model, tensor: model.graph.node[0].attribute.add(name="a").g.initializer.append(tensor),
        lambda model, tensor: model.graph.node[0].attribute.add().sparse_tensor.values.CopyFrom(tensor),
        lambda model, tensor: model.functions.add().node.add().attribute.add().t.CopyFrom(tensor),
    ],
)
def test_no_tensor_has_its_numbers_in_another_file(tmp_path, hide):
    model = Tiny().model()
    hide(model, elsewhere())
    data, file = model.SerializeToString(), tmp_path / "a.onnx"
    plain = b"\x0a\x08location"
    assert plain in data
    # The numbers before the key may be written with more bytes than they need.
    for prefix in (plain, b"\x8a\x00\x08location", b"\x0a\x88\x80\x00location"):
        file.write_bytes(data.replace(plain, prefix))
        with pytest.raises(InputError, match="keeps its weights in other files"):
            make_detector(str(file))


def test_specifications_name_detectors(tmp_path):
    file = tmp_path / "a.onnx"
    file.write_bytes(GOOD)
    (tmp_path / "s.toml").write_text('lot = "mini"\ndetector = "a.onnx"\n')
    spec = ScenarioSpec.read(tmp_path / "s.toml")
    assert spec.detector == str(file)
    assert spec.files() == [file]
    (tmp_path / "a.toml").write_text("threshold = 0.2\n")
    assert spec.files() == [file, tmp_path / "a.toml"]
    assert make_scenario(tmp_path / "s.toml").detector == str(file)
    (tmp_path / "e.toml").write_text('kind = "compare"\nrig = "laser"\ndetector = "a.onnx"\n')
    assert Comparison.read(tmp_path / "e.toml").detector == str(file)
    for text, kind, message in (
        ('lot = "mini"\ndetector = "mod:Mine"', ScenarioSpec, "want hog, net, side, front or a file.*class of your"),
        ('lot = "mini"\ndetector = "b.onnx"', ScenarioSpec, "detector is 'b.onnx', want a file; there is none at"),
        ('kind = "survey"\ndetector = 3', SurveyStudy, "detector is 3, want text"),
        ('kind = "compare"\ndetector = "side"', Comparison, "detector requires a rig"),
    ):  # fmt: skip
        (tmp_path / "bad.toml").write_text(text)
        with pytest.raises(InputError, match=message):
            kind.read(tmp_path / "bad.toml")


@pytest.mark.slow
def test_a_network_looks_in_worker_processes_too(tmp_path):
    file, totals = Tiny().save(tmp_path / "a.onnx"), []
    for jobs in (2, 1):
        out = tmp_path / str(jobs)
        words = "compare --scenario mini --agents first-free -n 2 --occupancy-levels none --no-figures --rig laser"
        ran(words, "--detector", file, "--jobs", jobs, "--out", out)
        totals.append((out / "episodes.csv").read_text())
        assert detector_version(file) in (out / SETTINGS).read_text()
    assert totals[0] == totals[1]


def test_photographs_are_searched_and_scored_with_it(tmp_path):
    cv2.imwrite(str(tmp_path / "photo.png"), photo())
    words = ("detect", tmp_path / "photo.png", "--detector", Tiny().save(tmp_path / "a.onnx"))
    ran(*words, "--threshold", 0.5, "--out", tmp_path / "d")
    assert min(row["probability"] for row in summary_of(tmp_path / "d")["rows"]) >= 0.5
    assert "excludes --model" in refused(*words, "--model", "side")


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
    inner = np.minimum(a[2:4], b[2:4]) - np.maximum(a[:2], b[:2])
    common = np.clip(inner, 0, None).prod()
    return common / ((a[2:4] - a[:2]).prod() + (b[2:4] - b[:2]).prod() - common)


def test_the_shipped_file_is_small_and_holds_nothing_but_a_network(net):
    data = FILE.read_bytes()
    assert len(data) < 2_000_000
    assert data[:1] != b"\x80"
    assert not zipfile.is_zipfile(str(FILE))
    model = load_onnx(str(FILE))
    known = "Add Cast Clip Concat Conv Exp GlobalAveragePool Mul Pow Relu Resize Sigmoid Slice Softmax"
    assert {node.op_type for node in model.graph.node} <= set(known.split())
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
    side, size = ~found.end_on, found.regions[:, 2:] - found.regions[:, :2]
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
    cells = np.random.default_rng(0).uniform(0.0, 1.0, (1, 9, 12, 16)).astype(np.float32)
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
