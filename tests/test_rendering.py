import dataclasses
import sys
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import parkenv  # noqa: F401  (registers the environments)
from parkenv import make_scenario
from parkenv.lots import city_lot
from parkenv.show.frames.search import SearchRenderer
from parkenv.show.frames.window import Window
from parkenv.show.scene import PALETTE, belief_colors
from parkenv.world.lot import PARK, Lane, ParkingLot
from parkenv.world.occupancy.process import Arrival, OccupancyProcess


def row_lot(vertical=False):
    """Ten slots of 2.5 m by 5 m north of a lane; or east of it, where it runs north."""
    xy, lane, goal = (
        np.stack([5.0 + 2.5 * np.arange(10), np.full(10, 5.5)], axis=1),
        [[0, 0], [35, 0]],
        (40, 0),
    )
    turn = slice(None, None, -1 if vertical else 1)
    ids, yaw = tuple(f"A{i}" for i in range(10)), np.full(10, 0.0 if vertical else np.pi / 2)
    size = np.full(10, 5.0), np.full(10, 2.5), np.zeros(10)
    lanes = (Lane(np.array(lane, float)[:, turn]),)
    return ParkingLot(
        "row", ids, xy[:, turn], yaw, *size, lanes, np.zeros((1, 2)), np.array([goal], float)[:, turn]
    )


def start(lot, **fields):
    env = gym.make("parkenv/Search-v2", scenario=make_scenario(lot, **fields), render_mode="rgb_array")
    env.reset(seed=1)
    return env


def middle_of_slot(renderer, state, slot, along=0.0):
    """Pixel (row, column) of a point of a slot, `along` m from its centre toward its nose."""
    lot = renderer.scenario.lot
    yaw = lot.slot_yaw[slot]
    point = lot.slot_xy[slot] + along * np.array([np.cos(yaw), np.sin(yaw)])
    column, row = np.floor(renderer.frames.still(lot.vertex_xy[state.vertex]).view(point)).astype(int)
    return row, column


def stand_in(env, p_occupied=None, observed=None, **changes):
    """The state of an environment, but for some of it."""
    state = env.unwrapped.state
    belief = state.belief if p_occupied is None else dataclasses.replace(state.belief, p_occupied=p_occupied)
    if observed is not None:
        belief.observed_at[:] = np.where(observed, 0.0, -1.0)
    names = "arrival time vertex path parked over failed_parks walk_s parking_cost_s total_s".split()
    return SimpleNamespace(**{n: getattr(state, n) for n in names} | {"belief": belief} | changes)


def test_frames_are_what_gymnasium_asks_for_and_do_not_depend_on_history():
    env = start(row_lot())
    first = env.render()
    assert (first.shape, first.dtype) == ((480, 640, 3), np.uint8)
    state = env.unwrapped.state
    occupied = state.world.occupied(np.arange(10), state.time)
    env.step(3)
    moved = env.render()
    assert np.array_equal(SearchRenderer(env.unwrapped.scenario).frame(state, occupied), moved)
    assert (first != moved).any(axis=2).sum() > 200
    first[:] = 0
    assert env.render().any()


def test_slots_have_the_colour_of_the_belief_and_cars_stand_where_the_truth_is_taken():
    env = start(row_lot())
    renderer = SearchRenderer(env.unwrapped.scenario)
    state = stand_in(env, p_occupied=np.linspace(0, 1, 10), observed=np.arange(10) >= 5)
    occupied = np.arange(10) % 2 == 1
    frame = renderer.frame(state, occupied)
    colors = belief_colors(state.belief.p_occupied, state.belief.observed)
    for slot in range(10):
        edge = frame[middle_of_slot(renderer, state, slot, along=2.3)]
        assert np.abs(edge.astype(int) - colors[slot]).max() <= 2
        center = frame[middle_of_slot(renderer, state, slot)]
        assert np.abs(center.astype(int) - (PALETTE["parked"] if occupied[slot] else colors[slot])).max() <= 2


def test_a_lot_higher_than_wide_is_turned_and_drawn_as_large():
    flat, high = (SearchRenderer(make_scenario(row_lot(vertical=v))) for v in (False, True))
    assert high.frames.whole.scale == pytest.approx(flat.frames.whole.scale)
    north = high.frames.whole(np.array([0.0, 30.0])) - high.frames.whole(np.array([0.0, 0.0]))
    assert north[0] > 0
    assert north[1] == pytest.approx(0)


def test_a_large_lot_is_shown_through_a_window_that_follows_the_car():
    scenario = make_scenario(city_lot(4000, seed=2))
    renderer = SearchRenderer(scenario)
    assert renderer.frames.whole is None
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    env.reset(seed=0)
    nothing, frames = np.zeros(4000, dtype=bool), {}
    for vertex in (0, 2000, 3999, 0):
        state = stand_in(env, vertex=vertex, path=[vertex])
        frame = renderer.frame(state, nothing)
        still = renderer.frames.still(scenario.lot.vertex_xy[vertex])
        column, row = still.view(scenario.lot.vertex_xy[vertex])
        assert 0.2 * 640 < column < 0.8 * 640
        assert 0.2 * 446 < row < 0.8 * 446
        assert (frame == PALETTE["car"]).all(axis=2).any()
        assert np.array_equal(frames.setdefault(vertex, frame), frame)
        assert len(still.slots) < 1000


def test_the_end_of_a_search_shows_the_walk():
    env = start(row_lot())
    unwrapped = env.unwrapped
    while unwrapped.state.vertex >= 10:
        out = unwrapped.scenario.lot.neighbors[unwrapped.state.vertex]
        env.step(int(np.argmax(out >= 0)))
    before = env.render()
    free = not unwrapped.state.world.occupied(np.array([unwrapped.state.vertex]), unwrapped.state.time)[0]
    env.step(PARK)
    after = env.render()
    assert unwrapped.state.parked == free

    def walk_pixels(frame):
        return int((frame == PALETTE["goal"]).all(axis=2).sum())

    assert (walk_pixels(after) > walk_pixels(before) + 100) == free


def test_a_full_lot_ends_at_a_junction_too():
    lot = row_lot()
    full = OccupancyProcess(np.full(10, 100.0), np.full(168, 9.0), np.ones(10), np.full(168, 1e-9))
    env = start(lot, occupancy=full)
    over = False
    while not over:
        out = np.flatnonzero(env.unwrapped.action_masks()[:PARK])
        onward = lot.vertex_xy[lot.neighbors[env.unwrapped.state.vertex, out], 0]
        _, _, over, _, _ = env.step(int(out[np.argmax(onward)]))
    state = stand_in(env, vertex=10)
    assert (env.render()[446:] == PALETTE["warning"]).all(axis=2).any()
    assert "every slot is taken" in SearchRenderer(env.unwrapped.scenario).text(state)


def test_text_tells_place_time_and_surroundings():
    env = start(row_lot())
    p_occupied = np.insert(np.full(7, 0.5), 2, [0.0, 1.0, 0.0])
    moment = 86400 + 9 * 3600 + 41 * 60 + 7
    state = stand_in(env, p_occupied, vertex=3, path=[3], time=moment, arrival=Arrival(moment))
    lines = SearchRenderer(env.unwrapped.scenario).text(state).splitlines()
    assert "at slot A3" in lines[0]
    assert "Tue 09:41:07" in lines[1]
    assert "A2 free, A3 taken, A4 free" in lines[2]
    assert len(lines) <= 22
    assert max(map(len, lines)) <= 78
    marks = "".join(lines[3:-2])
    assert marks.count("G") == marks.count("E") == 1
    assert sum(marks.count(m) for m in "<>^v") == 1
    assert sum(marks.count(m) for m in "o#.:%") == 10


def test_a_window_shows_frames_and_without_pygame_says_what_to_install(monkeypatch):
    import pygame

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    window = Window("a title")
    frame = np.zeros((480, 640, 3), dtype=np.uint8)
    frame[100, 200] = 1, 2, 3
    window.show(frame, 1000)
    assert pygame.display.get_surface().get_at((200, 100))[:3] == (1, 2, 3)
    window.close()
    window.close()
    assert not pygame.display.get_init()
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(gym.error.DependencyNotInstalled, match=r'pip install "parkenv\[human\]"'):
        check_env(gym.make("parkenv/Search-v2", scenario="mini").unwrapped)


@pytest.mark.parametrize("lot", ["campus", "street"])
def test_obstacles_stand_out_of_a_drive_more_than_anything_painted_on_the_ground(lot):
    """WCAG's contrast to the ground that is driven on: of cars, kerbs and walls above 7, of painted lines below 2."""

    def luminance(name):
        part = np.array(PALETTE[name]) / 255
        linear = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
        return linear @ [0.2126, 0.7152, 0.0722]

    env = gym.make("parkenv/Drive-v1", lot=lot, render_mode="rgb_array")
    env.reset(seed=3)
    frame = env.render()[:440]
    contrast = {}
    for name in ("floor", "parked", "paint"):
        assert (frame == PALETTE[name]).all(axis=2).mean() > 0.003, name
        low, high = sorted((luminance(name), luminance("floor")))
        contrast[name] = (high + 0.05) / (low + 0.05)
    assert contrast["parked"] > 7 > 2 > contrast["paint"]
