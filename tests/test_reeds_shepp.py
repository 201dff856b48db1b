"""The car that drives and the shortest ways of such a car: closed forms, limits, symmetry; what it touches."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from parkenv.driving import vehicle
from parkenv.driving.collision_world import CollisionWorld, ObstacleKind, Obstacles
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
PIECE = st.tuples(st.floats(-2.5, 2.5), st.sampled_from([LEFT, STRAIGHT, RIGHT]))
ORIGIN = np.zeros(3)
CAR = vehicle.VehicleParameters()
commands = st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)), min_size=1, max_size=60)


def end_of(lengths, turns, radius=1.0, start=(0.0, 0.0, 0.0)):
    for length, turn in zip(lengths, turns, strict=True):
        start = vehicle.move_along(*start, turn / radius, length)
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


@given(pieces=st.lists(PIECE, min_size=1, max_size=6))
@settings(max_examples=400)
def test_no_other_way_is_shorter(pieces):
    """Brute force: whatever pieces one drives, the word to the same place is at most as long."""
    lengths, turns = zip(*pieces, strict=True)
    assert distance(ORIGIN, end_of(lengths, turns)) <= sum(map(abs, lengths)) + 1e-6


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


def drive(car, state, acceleration, steering, steps=1):
    """The states under a constant command, one a step."""
    states = [np.array(state, dtype=float)]
    for _ in range(steps):
        states.append(states[-1].copy())
        vehicle.advance(states[-1], acceleration, steering, car.limits)
    return np.array(states)


def driven(pairs, speed=0.0):
    """The states that a row of commands leads through, one a step."""
    states = [np.array([0.0, 0.0, 0.0, speed, 0.0, 0.0])]
    for acceleration, steering in pairs:
        states.append(drive(CAR, states[-1], acceleration, steering)[-1])
    return np.array(states)


@given(steering=st.floats(0.05, 1.0), speed=st.floats(0.2, 3.0), side=st.sampled_from([-1.0, 1.0]))
def test_the_rear_axle_runs_on_a_circle_of_wheelbase_over_tan_steering(steering, speed, side):
    angle = side * steering * CAR.max_steering
    radius = CAR.wheelbase / math.tan(angle)
    path = drive(CAR, [0.0, 0.0, 0.0, speed, angle, 0.0], 0.0, side * steering, steps=400)
    away = np.hypot(path[:, vehicle.X], path[:, vehicle.Y] - radius)
    np.testing.assert_allclose(away, abs(radius), rtol=1e-9)
    assert np.allclose(path[:, vehicle.SPEED], speed)


@given(steering=st.floats(-1.0, 1.0), steps=st.integers(1, 200))
def test_a_car_at_rest_stays_where_it_is(steering, steps):
    """Turning the wheels moves nothing."""
    path = drive(CAR, np.array([3.0, -2.0, 0.7, 0.0, 0.0, 0.0]), 0.0, steering, steps)
    assert (path[:, : vehicle.SPEED + 1] == path[0, : vehicle.SPEED + 1]).all()


@given(pairs=commands)
def test_all_limits_and_rates_are_kept(pairs):
    states = driven(pairs)
    change = np.abs(np.diff(states, axis=0))
    assert np.abs(states[:, vehicle.STEERING]).max() <= CAR.max_steering
    assert change[:, vehicle.STEERING].max() <= CAR.steering_rate * vehicle.PHYSICS_S + 1e-12
    speed = states[:, vehicle.SPEED]
    assert -CAR.max_reverse_speed <= speed.min() <= speed.max() <= CAR.max_speed
    assert change[:, vehicle.SPEED].max() <= CAR.max_braking * vehicle.PHYSICS_S + 1e-12
    faster = np.abs(states[1:, vehicle.SPEED]) > np.abs(states[:-1, vehicle.SPEED]) + 1e-12
    assert (change[faster, vehicle.SPEED] <= CAR.max_acceleration * vehicle.PHYSICS_S + 1e-12).all()
    # Only coming to rest and meeting a limit of the speed end an acceleration at once.
    held = states[:, vehicle.ACCELERATION]
    ended = held[1:] == 0.0
    assert (np.abs(np.diff(held))[~ended] <= CAR.acceleration_rate * vehicle.PHYSICS_S + 1e-9).all()


@given(speed=st.floats(0.01, 8.0) | st.floats(-3.0, -0.01), brake=st.floats(0.05, 1.0))
def test_brakes_take_energy_bring_the_car_to_rest_and_hold_it(speed, brake):
    path = drive(CAR, [0.0, 0.0, 0.0, speed, 0.0, 0.0], -math.copysign(brake, speed), 0.0, steps=1)
    states = [path[-1]]
    while states[-1][vehicle.SPEED] != 0.0:
        states.append(drive(CAR, states[-1], -math.copysign(brake, speed), 0.0)[-1])
        assert abs(states[-1][vehicle.SPEED]) < abs(states[-2][vehicle.SPEED])
        assert states[-1][vehicle.SPEED] * speed >= 0.0
    assert np.ptp(drive(CAR, states[-1], 0.0, 0.0, steps=10)[:, vehicle.X]) == 0.0


def test_the_way_to_a_halt_is_that_of_constant_braking():
    soft = replace(CAR, acceleration_rate=1e6)
    state = np.array([0.0, 0.0, 0.0, 5.0, 0.0, 0.0])
    while state[vehicle.SPEED] > 0.0:
        vehicle.advance(state, -1.0, 0.0, soft.limits)
    assert state[vehicle.X] == pytest.approx(5.0**2 / (2 * soft.max_braking), rel=1e-12)


@given(pairs=commands, speed=st.floats(-3.0, 3.0))
def test_left_and_right_are_mirror_images(pairs, speed):
    left, right = driven(pairs, speed), driven([(a, -s) for a, s in pairs], speed)
    np.testing.assert_array_equal(left * [1, -1, -1, 1, -1, 1], right)


@given(curvature=st.floats(-0.3, 0.3), way=st.floats(-4.0, 4.0), pieces=st.integers(2, 20))
def test_an_arc_in_pieces_is_the_same_arc(curvature, way, pieces):
    """Exact integration: the step's length makes no difference."""
    there = (1.0, 2.0, 0.5)
    for _ in range(pieces):
        there = vehicle.move_along(*there, curvature, way / pieces)
    np.testing.assert_allclose(there, vehicle.move_along(1.0, 2.0, 0.5, curvature, way), atol=1e-12)


@given(
    speed=st.floats(0.5, CAR.max_speed),
    offset=st.floats(-0.85, 0.85),
    phase=st.floats(0.0, 1.0),
    angle=st.floats(-1.2, 1.2),
)
@settings(max_examples=60)
def test_nothing_is_passed_through_at_any_allowed_speed(speed, offset, phase, angle):
    """A wall of no thickness and a pole across the way are touched, wherever a step ends."""
    along = np.array([math.sin(angle), math.cos(angle)])
    at = np.array([12.0 + phase, offset])
    wall = np.stack([at - 0.05 * along, at + 0.05 * along])
    space = CollisionWorld(CAR, Obstacles.of([(ObstacleKind.WALL, wall)]))
    state = np.array([0.0, 0.0, 0.0, speed, 0.0, 0.0])
    while state[vehicle.X] < 20.0:
        vehicle.advance(state, 0.0, 0.0, CAR.limits)
        if space.touched(*state[:3]):
            break
    assert state[vehicle.X] + CAR.length - CAR.rear_overhang >= 12.0 - 0.05
    assert state[vehicle.X] < 12.5


@pytest.mark.parametrize("thing", [t for t in ObstacleKind if t is not ObstacleKind.NOTHING])
def test_what_is_touched_is_named(thing):
    outline = np.array([[6.0, -1.0], [7.0, -1.0], [7.0, 1.0], [6.0, 1.0]])
    if thing in (ObstacleKind.MOVING_CAR, ObstacleKind.PEDESTRIAN):
        space = CollisionWorld(CAR, Obstacles.of([]), [(thing, outline - [6.5, 0.0])])
        space.move([[30.0, 0.0, 0.0]])
        assert space.touched(0.0, 0.0, 0.0) == ObstacleKind.NOTHING
        space.move([[4.0, 0.0, 0.3]])
        assert space.touched(0.0, 0.0, 0.0) == thing
    else:
        is_line = thing in (ObstacleKind.KERB, ObstacleKind.WALL)
        line = outline[:2] + np.array([0.0, 0.9]) if is_line else outline
        space = CollisionWorld(CAR, Obstacles.of([(thing, line)]))
        assert space.touched(0.0, 1.5, 0.0) == ObstacleKind.NOTHING
        assert space.touched(3.0, 0.0, 0.0) == thing
        assert space.touched(0.0, 1.5, 0.0) == ObstacleKind.NOTHING


def test_of_several_things_the_same_one_is_named_in_any_order():
    car = (ObstacleKind.PARKED_CAR, np.array([[3.0, -1.0], [4.0, -1.0], [4.0, 1.0], [3.0, 1.0]]))
    kerb = (ObstacleKind.KERB, np.array([[3.0, -1.0], [3.0, 1.0]]))
    for things in ([car, kerb], [kerb, car]):
        assert CollisionWorld(CAR, Obstacles.of(things)).touched(0.0, 0.0, 0.0) == ObstacleKind.PARKED_CAR
