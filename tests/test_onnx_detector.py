"""Detectors from ONNX files: parity with plain NumPy, settings beside them, and files that are none."""

import copy
import json
import pickle

import cv2
import numpy as np
import pytest
from command_line import parkenv
from numba import config, get_num_threads, set_num_threads
from onnx import TensorProto, helper, numpy_helper
from tiny_networks import SIZE, Tiny

from parkenv import InputError, make_scenario
from parkenv.compiled.threads import ahead_in_threads
from parkenv.perception.detector_registry import detector_version, make_detector
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.studies.compare.comparison import Comparison
from parkenv.studies.results import SETTINGS
from parkenv.studies.sensing.survey_study import SurveyStudy

CARS = [0, 2]
TOML = "size = [64, 64]\ncars = [0, 2]\n"


def photo(width=90, height=50, seed=0):
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 256, (5, 9, 3), dtype=np.uint8)
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


def plain_detect(tiny, image, threshold, overlap, grey=False):
    """What the adapter should find, candidate by candidate: rows left, top, right, bottom, score, by score."""
    fed, (scale_x, scale_y), (left, top) = plain_input(image, grey)
    found = []
    for x, y, w, h, *scores in tiny.rows(fed).tolist():
        score = max(scores[c] for c in CARS)
        box = [(x - w / 2 - left) / scale_x, (y - h / 2 - top) / scale_y]
        box += [(x + w / 2 - left) / scale_x, (y + h / 2 - top) / scale_y]
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
    [
        (1, 'channels = "grey"\n', 0.08, 0.5),
        (3, "overlap = 0.3\nthreshold = 0.3\n", 0.3, 0.3),
    ],
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
    file = Tiny().save(tmp_path / "a.onnx")
    grey = photo()[..., 0]
    seen, as_color = (make_detector(file).detect(i) for i in (grey, np.dstack([grey] * 3)))
    np.testing.assert_array_equal(seen.boxes, as_color.boxes)
    rgb = make_detector(file).detect(photo())
    (tmp_path / "a.toml").write_text(TOML + 'channels = "bgr"\n')
    bgr = make_detector(file).detect(np.ascontiguousarray(photo()[..., ::-1]))
    np.testing.assert_array_equal(rgb.boxes, bgr.boxes)


def test_a_detector_is_copied_and_equal_runs_are_equal_on_any_number_of_threads(tmp_path):
    detector = make_detector(Tiny().save(tmp_path / "a.onnx"))
    first = detector.detect(photo())
    threads = cv2.getNumThreads()
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


GOOD = Tiny().model().SerializeToString()


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


@pytest.mark.parametrize(
    "outputs", [["output0"], ["output0", "between"], ["masks", "output0"], ["masks", "between"]]
)
def test_one_of_several_outputs_is_read(tmp_path, outputs):
    """The file's size counts, where none is set; rows of mask coefficients are no classes."""
    model = two_outputs()
    given = numpy_helper.from_array(np.zeros((1, 2, 16, 16), np.float32), "masks")
    model.graph.node.append(helper.make_node("Constant", [], ["masks"], value=given))
    model.graph.output.append(helper.make_tensor_value_info("masks", TensorProto.FLOAT, [1, 2, 16, 16]))
    (tmp_path / "a.onnx").write_bytes(model.SerializeToString())
    (tmp_path / "a.toml").write_text(f'layout = "yolo"\noutputs = {json.dumps(outputs)}\nthreshold = 0.01\n')
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
    file = Tiny(classes).save(tmp_path / "a.onnx")
    found = []
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
    file = Tiny().save(tmp_path / "a.onnx")
    totals = []
    for jobs in (2, 1):
        out = tmp_path / str(jobs)
        words = "compare --scenario mini --agents first-free -n 2 --occupancy-levels none --no-figures --rig laser"
        done = parkenv(words, "--detector", file, "--jobs", jobs, "--out", out)
        assert done.returncode == 0, done.stderr
        totals.append((out / "episodes.csv").read_text())
        assert detector_version(file) in (out / SETTINGS).read_text()
    assert totals[0] == totals[1]


def test_photographs_are_searched_and_scored_with_it(tmp_path):
    file = Tiny().save(tmp_path / "a.onnx")
    cv2.imwrite(str(tmp_path / "photo.png"), photo())
    words = ("detect", tmp_path / "photo.png", "--detector", file)
    done = parkenv(*words, "--threshold", 0.5, "--out", tmp_path / "d")
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "d" / "summary.json").read_text())["rows"]
    assert rows
    assert min(row["probability"] for row in rows) >= 0.5
    refused = parkenv(*words, "--model", "side")
    assert "excludes --model" in refused.stderr
