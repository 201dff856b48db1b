"""Reeds-Shepp words against what they must be: ways to the goal, symmetric, and never longer than another way."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from parkenv.driving.vehicle import move_along
from planners.driving.reeds_shepp import (
    LEFT,
    MOST_WORDS,
    RIGHT,
    STRAIGHT,
    Words,
    reeds_shepp,
    word_cost,
    words_between,
    words_buffer,
)

poses = st.tuples(st.floats(-6.0, 6.0), st.floats(-6.0, 6.0), st.floats(-math.pi, math.pi)).map(np.array)
ORIGIN = np.zeros(3)


def end_of(lengths, turns, radius=1.0, start=(0.0, 0.0, 0.0)):
    for length, turn in zip(lengths, turns, strict=True):
        start = move_along(*start, turn / radius, length)
    return np.array(start)


def distance(start, end, radius=1.0):
    return float(np.abs(reeds_shepp(start, end, radius)[0]).sum())


def same_pose(a, b, tolerance):
    assert np.hypot(*(a - b)[:2]) < tolerance
    assert abs(math.remainder(a[2] - b[2], 2 * math.pi)) < tolerance


@given(goal=poses)
@settings(max_examples=300)
def test_every_word_leads_to_the_goal(goal):
    words = Words(*words_buffer())
    n = words_between(*goal, words)
    assert 1 <= n <= MOST_WORDS
    for k in range(n):
        used = slice(words.n_pieces[k])
        same_pose(end_of(words.piece[k, used], words.turn[k, used]), goal, 1e-6)


@pytest.mark.parametrize(
    ("goal", "expected"),
    [
        ((7.0, 0.0, 0.0), 7.0),
        ((-7.0, 0.0, 0.0), 7.0),
        ((1.0, 1.0, math.pi / 2), math.pi / 2),
        ((0.0, 2.0, math.pi), math.pi),
        ((0.0, 0.0, math.pi), math.pi),  # three turns of 60° each, the middle one in reverse
        ((2.0, 2.0, 0.0), math.pi),
    ],
)
def test_lengths_that_are_known(goal, expected):
    assert distance(ORIGIN, np.array(goal)) == pytest.approx(expected, abs=1e-6)


@given(start=poses, end=poses)
@settings(max_examples=200)
def test_the_way_back_is_as_long_and_so_are_the_mirror_images(start, end):
    there = distance(start, end)
    assert distance(end, start) == pytest.approx(there, abs=1e-6)
    mirror = np.array([1.0, -1.0, -1.0])
    assert distance(start * mirror, end * mirror) == pytest.approx(there, abs=1e-6)
    assert there >= np.hypot(*(end - start)[:2]) - 1e-9
    assert there >= abs(math.remainder(end[2] - start[2], 2 * math.pi)) - 1e-6


@given(
    pieces=st.lists(
        st.tuples(st.floats(-2.5, 2.5), st.sampled_from([LEFT, STRAIGHT, RIGHT])), min_size=1, max_size=6
    )
)
@settings(max_examples=400)
def test_no_other_way_is_shorter(pieces):
    """Brute force: whatever pieces one drives, the word to the same place is at most as long."""
    lengths, turns = zip(*pieces, strict=True)
    goal = end_of(lengths, turns)
    assert distance(ORIGIN, goal) <= sum(map(abs, lengths)) + 1e-6


@given(end=poses, radius=st.floats(0.5, 8.0))
@settings(max_examples=100)
def test_lengths_grow_with_the_turning_circle(end, radius):
    scaled = end * [radius, radius, 1.0]
    length, turn = reeds_shepp(ORIGIN, scaled, radius)
    assert np.abs(length).sum() == pytest.approx(radius * distance(ORIGIN, end), rel=1e-6, abs=1e-6)
    same_pose(end_of(length, turn, radius), scaled, 1e-5)


def test_changes_of_direction_are_avoided_where_they_cost():
    goal = np.array([0.0, 0.5, 0.0])
    costly, cheap = (reeds_shepp(ORIGIN, goal, 1.0, change_m=c)[0] for c in (100.0, 0.0))
    changes = [int((np.diff(np.sign(length)) != 0).sum()) for length in (costly, cheap)]
    assert changes[0] < changes[1]
    assert np.abs(costly).sum() > np.abs(cheap).sum()
    assert word_cost(np.array([1.0, -1.0, 0.0, 0.0, 0.0]), 2, 2.0, 3.0) == 7.0
