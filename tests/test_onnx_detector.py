"""Detectors from ONNX files: parity with plain NumPy, settings beside them, and files that are none."""

import copy
import json
import math
import pickle

import cv2
import numpy as np
import pytest
from command_line import parkenv
from onnx import TensorProto, helper, numpy_helper
from tiny_networks import SIZE, Tiny

from parkenv import InputError, make_scenario
from parkenv.files import known_names
from parkenv.files.onnx_file import parse_onnx
from parkenv.perception import detector_registry
from parkenv.perception.detector_registry import detector_version, make_detector
from parkenv.perception.onnx_detector import OnnxDetector
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.studies.compare.comparison import Comparison
from parkenv.studies.results import SETTINGS
from parkenv.studies.sensing.survey_study import SurveyStudy

CARS = [0, 2]
NAMES = ("Car", "person", "truck")
IMAGENET = np.array([[123.675, 116.28, 103.53], [58.395, 57.12, 57.375]])


def photo(width=90, height=50, seed=0):
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 256, (5, 9, 3), dtype=np.uint8)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_NEAREST)


def plain_input(image, layout, grey=False):
    """The network's input, one pixel after another; and scale and offset of the image in it."""
    height, width = image.shape[:2]
    scale_x, scale_y = SIZE / width, SIZE / height
    left = top = 0
    if layout != "detr":
        scale_x = scale_y = min(scale_x, scale_y)
        left, top = (SIZE - round(width * scale_x)) // 2, (SIZE - round(height * scale_y)) // 2
    new = (round(width * scale_x), round(height * scale_y))
    scale_x, scale_y = new[0] / width, new[1] / height
    image = cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if grey else image, new)
    image = image.reshape(new[1], new[0], -1)
    fed = np.full((1, image.shape[2], SIZE, SIZE), 114.0)
    for c in range(image.shape[2]):
        for y in range(new[1]):
            for x in range(new[0]):
                fed[0, c, top + y, left + x] = image[y, x, c]
    mean, std = (
        IMAGENET[:, :, None, None] if layout == "detr" else (np.zeros((1, 1, 1)), np.full((1, 1, 1), 255.0))
    )
    return ((fed - mean) / std).astype(np.float32), (scale_x, scale_y), (left, top)


def plain_detect(tiny, image, threshold, overlap, grey=False):
    """What the adapter should find, candidate by candidate: rows left, top, right, bottom, score, by score."""
    fed, (scale_x, scale_y), (left, top) = plain_input(image, tiny.layout, grey)
    found = []
    for row in tiny.rows(fed).tolist():
        if tiny.layout == "boxes":
            x0, y0, x1, y1 = row[:4]
            score = row[4] if row[5] in CARS else 0.0
        else:
            x, y, w, h = (v * (SIZE if tiny.layout == "detr" else 1) for v in row[:4])
            x0, y0, x1, y1 = x - w / 2, y - h / 2, x + w / 2, y + h / 2
            if tiny.layout == "detr":
                total = sum(math.exp(v) for v in row[4:])
                score = max(math.exp(row[4 + c]) / total for c in CARS)
            elif tiny.layout == "yolo5":
                score = row[4] * max(row[5 + c] for c in CARS)
            else:
                score = max(row[4 + c] for c in CARS)
        box = [(x0 - left) / scale_x, (y0 - top) / scale_y, (x1 - left) / scale_x, (y1 - top) / scale_y]
        if score >= threshold and box[2] > box[0] and box[3] > box[1]:
            found.append([*box, score])
    found.sort(key=lambda r: -r[4])
    kept = []
    for one in found:
        if all(iou(one, other) <= overlap for other in kept):
            kept.append(one)
    return np.array(kept)


def iou(a, b):
    wide, high = (min(a[i + 2], b[i + 2]) - max(a[i], b[i]) for i in (0, 1))
    common = max(wide, 0.0) * max(high, 0.0)
    return common / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - common)


@pytest.mark.parametrize(
    ("layout", "options", "settings"),
    [
        ("yolo", {"names": NAMES}, {}),
        ("yolo", {"channels": 1, "names": NAMES}, {}),
        ("yolo", {"is_open": True, "names": NAMES}, {"size": [64, 64], "overlap": 0.3}),
        ("yolo5", {}, {"cars": CARS, "threshold": 0.3}),
        ("boxes", {"names": NAMES}, {}),
        ("detr", {"classes": 5}, {"cars": CARS, "scores": "softmax"}),
    ],
)
def test_boxes_are_those_of_a_plain_decoding(tmp_path, layout, options, settings):
    tiny = Tiny(layout, **options)
    file = tmp_path / "tiny.onnx"
    tiny.save(file)
    if settings:
        (tmp_path / "tiny.json").write_text(json.dumps(settings))
    detector = make_detector(str(file))
    overlap = settings.get("overlap", 1.0 if layout == "boxes" else 0.5)
    for image in (photo(), photo(40, 70, seed=1)):
        found = detector.detect(image)
        wanted = plain_detect(tiny, image, settings.get("threshold", 0.08), overlap, "channels" in options)
        assert len(wanted) > 1
        np.testing.assert_allclose(
            np.column_stack([found.boxes, found.probability]), wanted, rtol=1e-3, atol=2e-2
        )
        width, height = (found.boxes[:, 2:] - found.boxes[:, :2]).T
        np.testing.assert_array_equal(found.end_on, width < 1.8 * height)


def test_a_grey_image_is_one_of_three_equal_channels_and_bgr_is_the_reverse(tmp_path):
    file = Tiny("yolo", names=NAMES).save(tmp_path / "a.onnx")
    grey = photo()[..., 0]
    seen, as_color = (make_detector(file).detect(i) for i in (grey, np.dstack([grey] * 3)))
    np.testing.assert_array_equal(seen.boxes, as_color.boxes)
    rgb = make_detector(file).detect(photo())
    (tmp_path / "a.toml").write_text('channels = "bgr"\n')
    bgr = make_detector(file).detect(np.ascontiguousarray(photo()[..., ::-1]))
    np.testing.assert_array_equal(rgb.boxes, bgr.boxes)


def test_a_detector_is_copied_and_equal_runs_are_equal_on_any_number_of_threads(tmp_path):
    detector = make_detector(Tiny("yolo", names=NAMES).save(tmp_path / "a.onnx"))
    first = detector.detect(photo())
    threads = cv2.getNumThreads()
    try:
        for again, count in (
            (detector, 2),
            (pickle.loads(pickle.dumps(detector)), 1),
            (copy.deepcopy(detector), 4),
        ):
            cv2.setNumThreads(count)
            second = again.detect(photo())
            np.testing.assert_array_equal(first.boxes, second.boxes)
            np.testing.assert_array_equal(first.probability, second.probability)
            assert cv2.getNumThreads() == count
    finally:
        cv2.setNumThreads(threads)


def test_a_network_that_crashes_opencv_is_refused_in_a_line(tmp_path):
    model = Tiny("yolo", names=NAMES).model()
    (pads,) = (
        a for n in model.graph.node if n.op_type == "Conv" for a in n.attribute[:1] if n.output[0] == "c0"
    )
    pads.ints[:] = [0, 0]
    (tmp_path / "a.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(
        InputError, match=r"a\.onnx: OpenCV cannot run this network with an input of shape \(1, 3"
    ):
        make_detector(str(tmp_path / "a.onnx"))


def two_inputs():
    model = Tiny("yolo", names=NAMES).model()
    model.graph.input.append(helper.make_tensor_value_info("sizes", TensorProto.FLOAT, [1, 2]))
    return model


def external():
    model = Tiny("yolo", names=NAMES).model()
    model.graph.initializer[-1].data_location = TensorProto.EXTERNAL
    return model


def classifier():
    given = [numpy_helper.from_array(np.array([1, -1]), "shape")]
    image = helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, 64, 64])
    flat = helper.make_tensor_value_info("class", TensorProto.FLOAT, [1, 12288])
    graph = helper.make_graph(
        [helper.make_node("Reshape", ["images", "shape"], ["class"])], "g", [image], [flat], given
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)


def unknown_operator():
    model = Tiny("yolo", names=NAMES).model()
    model.graph.node[0].op_type = "Bewitch"
    return model


GOOD = Tiny("yolo", names=NAMES).model().SerializeToString()


@pytest.mark.parametrize(
    ("content", "settings", "message"),
    [
        (b"hello, I am no network\n", "", r"a\.onnx: is no whole ONNX file; want an exported network"),
        (b"", "", r"a\.onnx: has a graph without input or output"),
        (GOOD[:2000], "", "is no whole ONNX file"),
        (GOOD[:-3], "", "is no whole ONNX file"),
        (two_inputs(), "", r"has the input images \(1, 3, 64, 64\), sizes \(1, 2\), want one image"),
        (Tiny("yolo", channels=2), "", r"images \(1, 2, 64, 64\), want one image \(1, 3 or 1, height, width\)"),
        (external(), "", "keeps its weights in other files; export it as a single file"),
        (classifier(), "", r"puts out class \(1, 12288\), of which the layout .* write layout = .* in .*a\.toml"),
        (classifier(), 'layout = "yolo"', r"layout 'yolo' does not fit .* want one output \(1, 4 \+ classes, n\)"),
        (unknown_operator(), "", r"a\.onnx: OpenCV cannot run this network"),
        (Tiny("yolo", is_open=True), "", r"images \(any, 3, any, any\) is of any size; write size = \[640, 640\]"),
        (GOOD, "size = [96, 64]", r"a\.toml: size is \[96, 64\], want \[64, 64\]"),
        (GOOD, "size = [8, 8]", r"a\.toml: size\.0 is 8, want a number of at least 16"),
        (GOOD, 'channels = "grey"', r"a\.toml: channels is 'grey', want rgb or bgr: the input of a.onnx has 3"),
        (GOOD, "mean = [1.0, 2.0]", r"a\.toml: mean has 2 numbers, want 1 or 3"),
        (GOOD, "cars = [7]", r"a\.toml: cars has 7, want classes of the network, 0 to 2"),
        (GOOD, 'outputs = ["boxes"]', r"a\.toml: outputs has 'boxes', which the network lacks; it has output0"),
        (GOOD, "treshold = 0.3", r"a\.toml: unknown key 'treshold'; did you mean 'threshold'\?"),
        (GOOD, "threshold = nan", r"a\.toml: threshold is nan, want a finite number"),
        (Tiny("yolo", names=("cat", "dog", "cow")), "", r"of its classes \(0 cat, .*\) none is known as a car; write"),
        (Tiny("yolo"), "", r"does not name its classes; write cars = \[indices from 0\] in .*a\.toml"),
    ],
)  # fmt: skip
def test_what_is_no_detector_is_refused_in_a_line(tmp_path, content, settings, message):
    content = content.model() if isinstance(content, Tiny) else content
    file = tmp_path / "a.onnx"
    file.write_bytes(content if isinstance(content, bytes) else content.SerializeToString())
    if settings:
        (tmp_path / "a.toml").write_text(settings)
    with pytest.raises(InputError, match=message) as caught:
        make_detector(str(file))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("last", "message"),
    [
        (np.nan, "put out numbers that are not finite"),
        (50.0, r'has scores from .* want 0 to 1; .* scores = "logits"'),
    ],
)
def test_numbers_that_are_no_scores_are_refused(tmp_path, last, message):
    detector = make_detector(Tiny("yolo", names=NAMES, last=last).save(tmp_path / "a.onnx"))
    with pytest.raises(InputError, match=message):
        detector.detect(photo())


def test_files_of_other_sizes_and_names_are_refused(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"none\.onnx: No such file"):
        make_detector(str(tmp_path / "none.onnx"))
    file = Tiny("yolo", names=NAMES).save(tmp_path / "a.onnx")
    monkeypatch.setattr("parkenv.files.onnx_file.MAX_ONNX_BYTES", 100)
    with pytest.raises(InputError, match="has more than 100 bytes"):
        make_detector(file)
    (tmp_path / "a.toml").touch()
    (tmp_path / "a.json").touch()
    with pytest.raises(InputError, match=r"has two files of settings, a\.toml and a\.json"):
        detector_version(file)


def test_the_header_is_read_without_a_runtime():
    read = parse_onnx(Tiny("detr", classes=4, is_open=True, names=NAMES).model().SerializeToString(), "x")
    assert [(v.name, v.is_float, v.shape) for v in read.inputs] == [("images", True, (None, 3, None, None))]
    assert {v.name: v.shape for v in read.outputs} == {"pred_boxes": (1, None, 4), "logits": (1, None, 4)}
    assert read.metadata["names"].startswith("{0: 'Car'")


def elsewhere(name="w"):
    """A tensor whose numbers are in another file."""
    tensor = TensorProto(name=name, data_type=TensorProto.FLOAT, dims=[1])
    tensor.external_data.add(key="location", value="/etc/passwd")
    return tensor


@pytest.mark.parametrize(
    "hide",
    [
        lambda model, tensor: model.graph.initializer.append(tensor),
        lambda model, tensor: model.graph.node[0].attribute.add(name="a").t.CopyFrom(tensor),
        lambda model, tensor: model.graph.node[0].attribute.add(name="a").tensors.append(tensor),
        lambda model, tensor: model.graph.node[0].attribute.add(name="a").g.initializer.append(tensor),
        lambda model, tensor: model.graph.node[0].attribute.add().graphs.add().initializer.append(tensor),
        lambda model, tensor: model.graph.node[0].attribute.add().sparse_tensor.values.CopyFrom(tensor),
        lambda model, tensor: model.graph.sparse_initializer.add().indices.CopyFrom(tensor),
        lambda model, tensor: model.functions.add().node.add().attribute.add().t.CopyFrom(tensor),
    ],
)
def test_no_tensor_has_its_numbers_in_another_file(monkeypatch, hide):
    model = Tiny("yolo", names=NAMES).model()
    hide(model, elsewhere())
    for most in (1 << 20, 0):
        monkeypatch.setattr("parkenv.files.onnx_file.MAX_HERE", most)
        with pytest.raises(InputError, match="keeps its weights in other files"):
            parse_onnx(model.SerializeToString(), "x")


def test_a_network_is_run_without_what_our_reader_does_not_understand(monkeypatch):
    """Field 14 of a tensor is the place of its numbers, and has no value 77; field 100 does not exist."""
    model = Tiny("yolo", names=NAMES).model()
    plain = model.SerializeToString()
    assert parse_onnx(plain, "x").data == plain
    tensor = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[1], float_data=[1.0])
    model.graph.initializer.append(tensor)
    whole = model.SerializeToString()
    model.graph.initializer[-1].MergeFromString(bytes([14 << 3, 77]) + bytes([100 << 3 & 127 | 128, 6, 1]))
    assert model.SerializeToString() != whole
    for most in (1 << 20, 0):
        monkeypatch.setattr("parkenv.files.onnx_file.MAX_HERE", most)
        assert parse_onnx(model.SerializeToString(), "x").data == whole


def test_another_packaged_network_needs_its_file_and_its_name(tmp_path, monkeypatch):
    Tiny("yolo", names=NAMES).save(tmp_path / "net.onnx")
    monkeypatch.setattr(detector_registry, "MODELS", tmp_path)
    monkeypatch.setattr(detector_registry, "DETECTORS", (*known_names.DETECTORS, "net"))
    assert isinstance(make_detector("net"), OnnxDetector)
    assert detector_version("net") == "net"


def test_specifications_name_detectors(tmp_path):
    file = tmp_path / "a.onnx"
    Tiny("yolo", names=NAMES).save(file)
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
        (
            'lot = "mini"\ndetector = "mod:Mine"',
            ScenarioSpec,
            "want hog, net, side, front or a file.*class of your own",
        ),
        (
            'lot = "mini"\ndetector = "b.onnx"',
            ScenarioSpec,
            "detector is 'b.onnx', want a file; there is none at",
        ),
        ('kind = "survey"\ndetector = 3', SurveyStudy, "detector is 3, want text"),
        ('kind = "compare"\ndetector = "side"', Comparison, "detector requires a rig"),
    ):
        (tmp_path / "bad.toml").write_text(text)
        with pytest.raises(InputError, match=message):
            kind.read(tmp_path / "bad.toml")


@pytest.mark.slow
def test_a_network_surveys(tmp_path):
    file = Tiny("yolo", names=NAMES).save(tmp_path / "a.onnx")
    (tmp_path / "a.toml").write_text("threshold = 0.6\n")
    out = tmp_path / "s"
    ran = ("--scenario", "mini", "--jobs", 1, "--detector", file, "--out", out)
    done = parkenv("survey", "--sessions", 1, "--every", 8, *ran)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads((out / "summary.json").read_text())["rows"]
    assert row["detector"] == file
    assert detector_version(file) in (out / "sessions.csv").read_text()


@pytest.mark.slow
def test_a_network_looks_in_worker_processes_too(tmp_path):
    file = Tiny("yolo", names=NAMES).save(tmp_path / "a.onnx")
    totals = []
    for jobs in (2, 1):
        out = tmp_path / str(jobs)
        words = (
            "--scenario",
            "mini",
            "--agents",
            "first-free",
            "-n",
            2,
            "--occupancy-levels",
            "none",
            "--no-figures",
        )
        done = parkenv("compare", *words, "--rig", "laser", "--detector", file, "--jobs", jobs, "--out", out)
        assert done.returncode == 0, done.stderr
        totals.append((out / "episodes.csv").read_text())
        assert detector_version(file) in (out / SETTINGS).read_text()
    assert totals[0] == totals[1]
    bad = parkenv("compare", "--scenario", "mini", "--detector", file, "--out", tmp_path / "bad")
    assert bad.returncode == 2
    assert "detector requires a rig" in bad.stderr


def test_photographs_are_searched_and_scored_with_it(tmp_path):
    file = Tiny("yolo", names=NAMES).save(tmp_path / "a.onnx")
    cv2.imwrite(str(tmp_path / "photo.png"), photo())
    done = parkenv(
        "detect", tmp_path / "photo.png", "--detector", file, "--threshold", 0.5, "--out", tmp_path / "d"
    )
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "d" / "summary.json").read_text())["rows"]
    assert rows
    assert min(row["probability"] for row in rows) >= 0.5
    refused = parkenv("detect", tmp_path / "photo.png", "--detector", file, "--model", "side")
    assert "excludes --model" in refused.stderr
