"""A user-defined detector, everywhere a detector is accepted."""

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from command_line import ran, summary_of
from onnx import TensorProto, helper, numpy_helper

from parkenv import InputError, make_scenario
from parkenv.mapping.survey import Survey, SurveySettings
from parkenv.perception.detector import Detections
from parkenv.perception.detector_registry import detector_version, make_detector
from parkenv.perception.hog_detector import HogDetector
from sim_sensors.ground_truth import View

EXAMPLES = Path(__file__).parents[1] / "examples"
OWN = "ground_detector:GroundDetector"


@pytest.fixture(autouse=True)
def in_examples(monkeypatch):
    """Run where the example's module is: the module is looked up in the working directory."""
    monkeypatch.chdir(EXAMPLES)
    monkeypatch.setattr(sys, "path", list(sys.path))


class RandomBoxes:
    """As many boxes of a car's shape, anywhere in the lower half of the image."""

    def detect(self, image):
        rng = np.random.default_rng(int(image[::40, ::40].sum()))
        height, width = image.shape[:2]
        size = rng.uniform((100, 60), (360, 180), (3, 2))
        corner = rng.uniform((0, 0.3 * height), (width - 100, 0.6 * height), (3, 2))
        return Detections(np.hstack([corner, corner + size]), np.full(3, 0.5))


def drive(detector):
    settings = SurveySettings(every=3.0, weather="overcast", detector=detector)
    boxes = []
    result = Survey(make_scenario("mini"), settings).drive(
        0, on_frame=lambda frame: boxes.append(frame.result.views[0].detections.boxes)
    )
    return result, boxes


def test_a_survey_with_a_detector_of_ones_own_beats_chance_and_is_not_hog():
    own, own_boxes = drive(OWN)
    hog, hog_boxes = drive("hog")
    random, _ = drive(f"{__name__}:RandomBoxes")
    own_precision, chance = (r.score.right / r.score.detections for r in (own, random))
    assert own.found >= 0.5 * own.parked
    assert own_precision > max(0.4, 2.0 * chance)
    assert own.slot_accuracy >= 0.9
    assert not all(np.array_equal(a, b) for a, b in zip(own_boxes, hog_boxes, strict=True))
    assert own.session.key != hog.session.key, "a map file keeps sessions of different detectors apart"


def test_the_environment_observes_slots_with_it():
    scenario, seen = make_scenario("mini"), {}
    for detector in ("hog", OWN, make_detector(OWN)):
        options = {"scenario": scenario, "weather": "overcast", "detector": detector}
        env = gym.make("parkenv/SearchPerception-v2", **options)
        env.reset(seed=0)
        env.step(3)
        (*_, result) = env.unwrapped.perception.results
        seen[str(detector)] = result.views[0].detections
    hog, by_name, by_object = seen.values()
    np.testing.assert_array_equal(by_name.boxes, by_object.boxes)
    assert len(by_name) > 0
    assert not np.array_equal(hog.boxes, by_name.boxes)


def test_the_command_line_takes_it(tmp_path):
    out = tmp_path / "s"
    ran("survey --scenario mini --sessions 1 --every 15 --jobs 1", "--detector", OWN, "--out", out)
    (row,) = summary_of(out)["rows"]
    assert row["detector"] == OWN
    assert detector_version(OWN) in (out / "sessions.csv").read_text()


def test_a_class_of_ones_own_runs_a_network_of_another_layout(monkeypatch, tmp_path):
    """The network puts out its only box: a car, a dog and a car that is unlikely."""
    rows = [[64, 128, 192, 256, 0.9, 2], [0, 0, 90, 90, 0.9, 16], [0, 0, 90, 90, 0.01, 2]]
    image = helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, 640, 640])
    output = helper.make_tensor_value_info("output0", TensorProto.FLOAT, [1, 3, 6])
    given = {"rows": np.array([rows], np.float32), "zero": np.zeros(1, np.float32)}
    nodes = [
        helper.make_node("GlobalMaxPool", ["images"], ["top"]),
        helper.make_node("ReduceMax", ["top"], ["most"], axes=[1, 2], keepdims=0),
        helper.make_node("Mul", ["most", "zero"], ["nothing"]),
        helper.make_node("Add", ["rows", "nothing"], ["output0"]),
    ]
    tensors = [numpy_helper.from_array(value, name) for name, value in given.items()]
    graph = helper.make_graph(nodes, "g", [image], [output], tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    (tmp_path / "a.onnx").write_bytes(model.SerializeToString())
    detector = make_detector(OWN)  # the module
    monkeypatch.setattr(sys.modules[type(detector).__module__], "NETWORK", str(tmp_path / "a.onnx"))
    found = make_detector("ground_detector:NetworkDetector").detect(np.zeros((480, 1280, 3), np.uint8))
    assert found.boxes.tolist() == [[128, 256, 384, 512]]
    assert (found.probability.tolist(), found.end_on.tolist()) == ([pytest.approx(0.9)], [True])


def test_detectors_are_made_by_name(tmp_path):
    assert [len(make_detector(name).models) for name in ("hog", "side", "front", None)] == [2, 1, 1, 2]
    file = tmp_path / "mine.npz"
    make_detector("side").models[0].save(file)
    loaded = make_detector(str(file))
    assert isinstance(loaded, HogDetector)
    np.testing.assert_array_equal(loaded.models[0].weights, make_detector("side").models[0].weights)
    before = detector_version(str(file))
    make_detector("front").models[0].save(file)
    assert detector_version(str(file)) != before, "another model under the same name is another detector"
    assert detector_version("hog") == "hog"
    for wrong, message in (
        ("yolo", "unknown detector 'yolo'; want hog, net, side, front"),
        ("no_such_module:Mine", "detector 'no_such_module:Mine': no module"),
        (f"{__name__}:Nothing", "has no 'Nothing'"),
        (f"{__name__}:Path", r"has no method detect\(image\)"),
        (3, r"detector is a int without a method detect\(image\)"),
    ):
        with pytest.raises(InputError, match=message):
            make_detector(wrong)


def test_what_a_detector_does_not_know_is_side_or_end_and_nan():
    found = Detections([[0, 0, 1, 1], [2, 2, 4, 4]], [0.5, 0.6], [False, True])
    assert found.view.tolist() == [View.SIDE, View.END]
    assert np.isnan(found.visible_fraction).all()
    known = Detections(found.boxes, found.probability, view=[1, 2], visible_fraction=[0.3, np.nan])
    one = known.select(np.array([True, False]))
    assert (one.view.tolist(), one.visible_fraction.tolist()) == ([View.OBLIQUE], [pytest.approx(0.3)])
