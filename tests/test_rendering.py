"""Pictures, films and play of the environments: frames, texts, scenes of lots in both painters."""

import dataclasses
import sys
from types import SimpleNamespace

import cv2
import gymnasium as gym
import numpy as np
import pytest
import shapely
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordVideo
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from pictures import shows_color
from test_make_options import OPTIONS

import parkenv  # noqa: F401  (registers the environments)
from parkenv import make_scenario
from parkenv.lots import city_lot, packaged_lot
from parkenv.show.frames.search import SearchRenderer
from parkenv.show.frames.window import Window
from parkenv.show.painters import axes, opencv
from parkenv.show.painters.opencv import MapView
from parkenv.show.scene import PALETTE, SQUARE, Areas, Lines, LotScene, Marks, belief_colors
from parkenv.world.lot import PARK, Lane, ParkingLot
from parkenv.world.occupancy.process import Arrival, OccupancyProcess


def row_lot(vertical=False):
    """Ten slots of 2.5 m by 5 m north of a lane; or east of it, where it runs north."""
    xy = np.stack([5.0 + 2.5 * np.arange(10), np.full(10, 5.5)], axis=1)
    lane, goals = np.array([[0.0, 0.0], [35.0, 0.0]]), np.array([[40.0, 0.0]])
    turn = slice(None, None, -1 if vertical else 1)
    ids, yaw = tuple(f"A{i}" for i in range(10)), np.full(10, 0.0 if vertical else np.pi / 2)
    size = np.full(10, 5.0), np.full(10, 2.5), np.zeros(10)
    lanes = (Lane(lane[:, turn]),)
    return ParkingLot("row", ids, xy[:, turn], yaw, *size, lanes, np.zeros((1, 2)), goals[:, turn])


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
        frame = renderer.frame(stand_in(env, vertex=vertex, path=[vertex]), nothing)
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
        env.step(int(np.argmax(unwrapped.scenario.lot.neighbors[unwrapped.state.vertex] >= 0)))
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
    env, over = start(lot, occupancy=full), False
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
    window, frame = Window("a title"), np.zeros((480, 640, 3), dtype=np.uint8)
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
    frame, contrast = env.render()[:440], {}
    for name in ("floor", "parked", "paint"):
        assert (frame == PALETTE[name]).all(axis=2).mean() > 0.003, name
        low, high = sorted((luminance(name), luminance("floor")))
        contrast[name] = (high + 0.05) / (low + 0.05)
    assert contrast["parked"] > 7 > 2 > contrast["paint"]


def polygons(paved):
    return shapely.union_all([shapely.Polygon(rings[0], rings[1:]) for rings in paved])


@pytest.mark.parametrize("name", ["campus", "street", "mini"])
def test_asphalt_is_where_cars_drive_and_park_marks_lie_on_their_lanes_and_entries_lead_in(name):
    lot = packaged_lot(name)
    outline = LotScene.of(lot)
    kerbed, asphalt = polygons(outline.paved(apron=0.0)), polygons(outline.paved())
    assert kerbed.symmetric_difference(outline.area.around(np.zeros(2), 1e4)).area == pytest.approx(0.0)
    assert asphalt.contains(kerbed)
    assert all(asphalt.contains(shapely.Polygon(corners)) for corners in outline.slots)
    assert shapely.contains(asphalt, shapely.points(lot.vertex_xy[: lot.n_slots])).all()
    assert not any(asphalt.contains(shapely.Point(wall[0])) for wall in outline.walls)
    one_way = shapely.union_all([shapely.LineString(lane.points) for lane in lot.lanes if lane.oneway])
    assert len(outline.centre_lines) + sum(lane.oneway for lane in lot.lanes) == len(lot.lanes)
    for x, y, yaw in outline.arrows:
        ahead = shapely.Point(x + 0.1 * np.cos(yaw), y + 0.1 * np.sin(yaw))
        assert one_way.distance(shapely.Point(x, y)) < 1e-6
        assert one_way.distance(ahead) < 1e-6
    np.testing.assert_array_equal(outline.entries[:, :2], lot.entries)
    x, y, yaw = outline.entries.T
    assert shapely.contains_xy(asphalt, x + 3.0 * np.cos(yaw), y + 3.0 * np.sin(yaw)).all()


def test_painted_lines_leave_the_mouth_open():
    lot = packaged_lot("campus")
    lines = shapely.linestrings(LotScene.of(lot).slot_lines)
    gap = shapely.distance(lines, shapely.points(lot.mouth_xy()))
    assert gap.min() > 1.0, "half a slot's width away from either side"
    np.testing.assert_allclose(shapely.length(lines), 2 * lot.slot_length + lot.slot_width)


def test_the_page_draws_the_same_shapes_to_the_centimetre():
    lot = packaged_lot("street")
    scene = LotScene.of(lot)
    page, layers = scene.data(), scene.ground()
    for layer, drawn in zip(layers, page["ground"], strict=False):
        assert drawn["color"] == layer.color
    asphalt = next(layer for layer in page["ground"] if layer["color"] == "asphalt")
    for rings, drawn in zip(scene.paved(), asphalt["areas"], strict=True):
        for ring, flat in zip(rings, drawn, strict=True):
            np.testing.assert_allclose(ring.ravel(), flat, atol=0.0051)
    np.testing.assert_allclose(scene.entries, page["ground"][-1]["marks"], atol=0.0051)
    walls = next(layer["lines"] for layer in page["ground"] if layer["color"] == "wall" and layer["lines"])
    assert len(walls) == len(lot.walls)


def test_both_painters_give_every_layer_its_colour_at_its_place():
    box = np.array([[0.0, 0.0], [8.0, 0.0], [8.0, 6.0], [0.0, 6.0]])
    hole = np.array([[5.0, 1.0], [7.0, 1.0], [7.0, 5.0], [5.0, 5.0]])
    layers = [
        Areas([[box, hole]], "asphalt"),
        Lines([np.array([[0.0, 3.0], [4.0, 3.0]])], "car", 0.8, halo="ink"),
        Marks(np.array([[2.0, 1.0, np.pi / 2], [2.0, 5.0, 0.0]]), SQUARE, ["goal", "entry"], (1.6, 0.4)),
    ]
    view = MapView.around(np.array([5.0, 3.0]), (500, 300), 50.0)
    image = np.full((300, 500, 3), 255, np.uint8)
    opencv.paint(image, view, layers)
    figure = Figure(figsize=(5.0, 3.0), dpi=100)
    ax = figure.add_axes((0, 0, 1, 1), xlim=(0, 10), ylim=(0, 6), aspect="equal")
    ax.set_axis_off()
    axes.paint(ax, layers, 1.0)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    places = {
        "asphalt": [(1.0, 4.5), (2.6, 1.0), (2.0, 5.6)],
        "white": [(6.0, 3.0), (9.0, 3.0)],
        "car": [(2.0, 3.0)],
        "goal": [(2.0, 1.6)],
        "entry": [(2.6, 5.0)],
    }
    for picture in (image, np.asarray(canvas.buffer_rgba())[..., :3]):
        for color, (x, y) in ((name, at) for name in places for at in places[name]):
            found = picture[round(50 * (6 - y)) - 1, round(50 * x)].astype(int)
            np.testing.assert_allclose(found, PALETTE[color], atol=2, err_msg=f"{x}, {y}")
        assert shows_color(picture, PALETTE["ink"]), "the halo"


def test_dashes_end_with_their_line_and_a_small_mark_is_drawn_larger():
    image = np.full((40, 200, 3), 255, np.uint8)
    view = MapView(np.eye(2), 1.0, np.zeros(2))
    line = Lines([np.array([[10.0, 10.0], [150.0, 10.0]])], "goal", px=(2.0, 2.0), dash=(10.0, 10.0))
    small = Marks(np.array([[100.0, 30.0, 0.0]]), SQUARE, "entry", (2.0, 1.0), px=20.0)
    opencv.paint(image, view, [line, small])
    row = (image[9] == PALETTE["goal"]).all(axis=1)
    assert row[[12, 148]].all()
    assert 0.4 < row[10:150].mean() < 0.7
    assert np.ptp(np.flatnonzero((image[29] == PALETTE["entry"]).all(axis=1))) == pytest.approx(20, abs=2)
    assert np.ptp(np.flatnonzero((image[:, 100] == PALETTE["entry"]).all(axis=1))) == pytest.approx(10, abs=2)


pygame = pytest.importorskip("pygame")


def played(env, keys, noop, monkeypatch):
    """The actions of a game in which these keys are held, one list a frame."""
    from gymnasium.utils.play import play

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    frames, held, actions = iter(keys), set(), []

    def events():
        wanted = set(next(frames, []))
        told = [pygame.event.Event(pygame.KEYDOWN, key=key) for key in wanted - held]
        told += [pygame.event.Event(pygame.KEYUP, key=key) for key in held - wanted]
        held.clear()
        held.update(wanted)
        return [*told, *([] if wanted else [pygame.event.Event(pygame.QUIT)])]

    monkeypatch.setattr(pygame.event, "get", events)
    play(env, fps=1000, seed=3, noop=noop, callback=lambda _obs, _next, action, *_: actions.append(action))
    return actions


def test_environments_are_played_with_keys_and_two_at_once(monkeypatch):
    env = gym.make("parkenv/Search-v2", scenario="campus", render_mode="rgb_array")
    keys = [[pygame.K_w], [pygame.K_s], [pygame.K_a], [pygame.K_d], [pygame.K_SPACE]]
    assert played(env, keys, 4, monkeypatch) == [0, 1, 2, 3, 4]
    env = gym.make("parkenv/Drive-v1", render_mode="rgb_array")
    keys = [[pygame.K_w], [pygame.K_w, pygame.K_a], [pygame.K_d, pygame.K_s]]
    actions = played(env, keys, np.zeros(2, dtype=np.float32), monkeypatch)
    assert np.array_equal(actions, [[1, 0], [1, 1], [-1, -1]])


@pytest.mark.parametrize("name", OPTIONS)
def test_every_environment_is_filmed(name, tmp_path):
    pytest.importorskip("moviepy")
    env = gym.make(name, render_mode="rgb_array", **OPTIONS[name])
    env = RecordVideo(env, str(tmp_path / "films"))
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(3):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            break
    env.close()
    (film,) = (tmp_path / "films").glob("*.mp4")
    there, frame = cv2.VideoCapture(str(film)).read()
    assert there
    assert frame.std() > 5.0
