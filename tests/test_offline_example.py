"""The estimators of the example on offline learning, where all that can happen is enumerated."""

import importlib.util
import itertools
from pathlib import Path

import numpy as np
import pytest

FILE = Path(__file__).parents[1] / "examples" / "offline" / "offline_learning.py"


@pytest.fixture(scope="module")
def example():
    """The example as a module."""
    spec = importlib.util.spec_from_file_location(FILE.stem, FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_estimators_are_exact_where_every_course_is_as_frequent_as_probable(example):
    """Two decisions between two actions, drawn evenly: with all four courses, sampling errs by nothing."""
    target, rewards = np.array([[0.8, 0.2], [0.3, 0.7]]), np.array([[-3.0, -1.0], [-2.0, -10.0]])
    expected = (target * rewards).sum()
    courses = np.array(list(itertools.product((0, 1), repeat=2)))
    steps = np.arange(2)
    ratios, got = target[steps, courses] / 0.5, rewards[steps, courses]
    assert example.per_decision(got, ratios) == pytest.approx(expected)
    assert example.weighted(got, ratios) == pytest.approx(expected)
    # Wrong values do no harm, as long as those of states follow from those of actions.
    q = np.array([[4.0, -2.0], [1.0, 7.0]])
    v = np.broadcast_to((target * q).sum(axis=1), courses.shape)
    assert example.doubly_robust(got, ratios, q[steps, courses], v) == pytest.approx(expected)


def test_a_model_takes_the_best_action_of_those_that_are_possible(example, tmp_path):
    weights = np.zeros((5, 91)), np.array([5.0, 1.0, 2.0, 4.0, 3.0])
    np.savez(tmp_path / "net.npz", **{f"{i:02}": layer for i, layer in enumerate(weights)})
    agent = example.Learned(None, str(tmp_path / "net.npz"))
    observation = {"local": np.zeros((2, 86)), "action_mask": np.array([[1, 1, 0, 1, 1], [0, 1, 1, 0, 0]])}
    actions, _ = agent.predict(observation)
    assert actions.tolist() == [0, 2]
