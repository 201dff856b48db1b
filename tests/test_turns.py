"""Turns that cars may not make, and lots where cars keep left."""

import copy
import dataclasses
import itertools
import json

import gymnasium as gym
import numpy as np
import pytest
from command_line import ran
from gymnasium.wrappers import TimeLimit
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from lot_checks import refusal
from made_maps import Map
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from small_lots import CAR_PARKS, driven

from parkenv import make_agent, make_scenario
from parkenv.driving.driven_lines import DrivenLines
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.engine.sensor_sampler import make_rig
from parkenv.lots import check_lot, packaged_lot, read_lot, write_lot
from parkenv.lots.draft import LotDraft
from parkenv.lots.town.draft import import_town
from parkenv.mapping.route import survey_route
from parkenv.studies.simulate import adapt_to_agent
from parkenv.world.demand import ConstantTime, Demand, ExponentialTime, PoissonArrivals
from parkenv.world.lot import MOVES, GraphError, Lane, Mouth, ParkingLot, Turn
from planners.heuristics import POLICIES

AT = (-100.0, 0.0, 100.0)
ARMS = {"west": (-1, 0), "east": (1, 0), "north": (0, 1), "south": (0, -1)}
ACROSS = np.array([-1.0, 1.0])
SWAPPED = [MOVES.index(name) for name in ("up", "down", "right", "left")]
OTHER = np.array([Mouth.REAR, Mouth.RIGHT, Mouth.LEFT])


def turn(comes, leaves, at=(0.0, 0.0), *, only=False):
    """From one arm of a crossing into another one."""
    via = np.array(at)
    before, after = (via + 50.0 * np.array(ARMS[arm]) for arm in (comes, leaves))
    return Turn(np.array([before, via, after]), only)


def blocks(turns=(), every=None):
    """Four blocks of 100 m, entered from the west: a kerb slot on the way north from the middle, or one every few m."""
    places = [(4.0, 50.0, np.pi / 2)]  # x, y, heading of those who drive past it
    if every is not None:
        along = np.arange(-100.0 + every / 2, 100.0, every).tolist()
        places = [(a, y - 4.0 * way, np.arccos(way)) for y in AT for way in (1, -1) for a in along]
        places += [(x + 4.0 * way, a, way * np.pi / 2) for x in AT for way in (1, -1) for a in along]
    x, y, yaw = np.array(places).T
    n = len(x)
    level = [[(-150.0, 0.0)] * (y == 0.0) + [(x, y) for x in AT] for y in AT]
    return ParkingLot(
        "blocks",
        tuple(map(str, range(n))),
        slot_xy=np.stack([x, y], axis=1),
        slot_yaw=yaw,
        slot_length=np.full(n, 5.0),
        slot_width=np.full(n, 2.0),
        slot_mouth=np.full(n, Mouth.LEFT),
        lanes=tuple(Lane(np.array(points)) for points in (*level, *([(x, y) for y in AT] for x in AT))),
        entries=np.array([(-150.0, 0.0)]),
        goals=np.array([(10.0, 50.0)]),
        turns=tuple(turns),
    )


BACK = [turn(arm, arm) for arm in ARMS]


@pytest.mark.parametrize(
    ("turns", "wanted"),
    [
        ([], 200.0),
        # Round a block to come from the north, and turn round; straight on and back from the east; right, and back from
        # the south, or there round a block.
        ([turn("west", "north")], 400.0),
        ([turn("west", "south", only=True)], 400.0),
        ([turn("west", "north"), *BACK, turn("south", "north")], 400.0),
        ([turn("west", "east", only=True), BACK[2], turn("west", "west", (100.0, 0.0))], 400.0),
        ([turn(arm, "north") for arm in ARMS], np.inf),
        # What is allowed elsewhere does not change.
        ([turn("east", "north"), turn("south", "west"), turn("south", "north", only=True)], 200.0),
    ],
)
def test_the_shortest_way_goes_round_what_is_forbidden(turns, wanted):
    lot = blocks(turns)
    metres = dijkstra(lot.drive_matrix(), indices=lot.entry_vertices[0])
    assert metres[0] == pytest.approx(wanted)


def made(lot, origins, vertices):
    """The turns of a drive, as (comes, at, leaves), by names of arms; the steps are those of one car in their order."""
    n, xy, found = lot.n_slots, lot.vertex_xy, set()
    steps = [(u, v) for u, v in zip(origins, vertices, strict=True) if u != v]
    for before, (v, after) in itertools.pairwise(steps):
        if v >= n and before[1] == v:
            found.add((arm_of(xy[before[0]] - xy[v]), tuple(xy[v].tolist()), arm_of(xy[after] - xy[v])))
    return found


def arm_of(way):
    return max(ARMS, key=lambda arm: float(way @ np.array(ARMS[arm])))


ARM, PLACE = st.sampled_from(sorted(ARMS)), st.sampled_from(AT)
TURNS = st.builds(turn, ARM, ARM, st.tuples(PLACE, PLACE), only=st.booleans())


@settings(max_examples=6, deadline=None)
@given(turns=st.lists(TURNS, min_size=1, max_size=12), seed=st.integers(0, 99))
def test_nobody_ever_makes_a_forbidden_turn(turns, seed):
    """Of all compiled drivers, in a crowded town; turns that the map has not, or that leave no way on, are dropped."""
    while True:
        try:
            lot = blocks(turns, every=50.0)
            break
        except GraphError as error:
            wrong = {problem.index for problem in error.problems}
            turns = [one for i, one in enumerate(turns) if i not in wrong]
    assume(turns)
    arrivals = PoissonArrivals(200.0, 8 * 3600, 8.5 * 3600)
    demand = Demand(arrivals, ExponentialTime(1800.0), ConstantTime(300.0))
    drivers = [DriverKind(policy=policy) for policy in POLICIES.values()]
    fleet = Fleet(make_scenario(lot), demand, background="none", drivers=drivers)
    fleet.reset(seed)
    fleet.keep_steps()
    fleet.run()
    steps, drives = fleet.take_steps(), set()
    for car in np.unique(steps["car"]).tolist():
        of_car = steps[steps["car"] == car]
        drives |= made(lot, of_car["origin"].tolist(), of_car["vertex"].tolist())
    assert drives
    for one in turns:
        comes, at, leaves = one.points
        arms, at = [arm_of(comes - at), arm_of(leaves - at)], tuple(at.tolist())
        those = {last for first, where, last in drives if (first, where) == (arms[0], at)}
        assert those <= {arms[1]} if one.only else arms[1] not in those


@pytest.mark.parametrize("name", ["mdp", "belief"])
def test_agents_drive_round_it_too(name):
    at = (-100.0, 0.0)
    forbidden = {("west", at, "north"), ("west", at, "east")}
    turns = [turn(comes, leaves, at) for comes, _, leaves in forbidden]
    assert driven_by(name, blocks(every=50.0)) & forbidden
    assert not driven_by(name, blocks(turns, every=50.0)) & forbidden


def driven_by(name, lot):
    """The turns that an agent makes in five searches."""
    scenario, drives = make_scenario(lot), set()
    agent = make_agent(name, scenario.public())
    env = adapt_to_agent(TimeLimit(gym.make("parkenv/Search-v2", scenario=scenario), 200), agent)
    for seed in range(5):
        observation, _ = env.reset(seed=seed)
        memory, over, path = None, False, [int(observation["vertex"])]
        while not over:
            action, memory = agent.predict(observation, memory)
            observation, _, *ends, _ = env.step(action)
            over = any(ends)
            path.append(int(observation["vertex"]))
        drives |= made(scenario.lot, path[:-1], path[1:])
    return drives


def test_turns_come_back_from_a_file_and_faults_are_named(tmp_path):
    lot = blocks([turn("west", "north"), turn("north", "south", only=True), turn("east", "east")])
    path = tmp_path / "blocks.geojson"
    write_lot(lot, path)
    again = read_lot(path)
    assert again == lot
    np.testing.assert_array_equal(again.neighbors, lot.neighbors)
    document = json.loads(path.read_text())
    first = next(i for i, f in enumerate(document["features"]) if f["properties"]["kind"] == "turn")
    for part, change, named in (
        ("properties", {"only": "yes"}, "only is 'yes'"),
        ("geometry", {"type": "Point", "coordinates": [0, 0]}, "geometry is 'Point'"),
        ("geometry", {"coordinates": [[0, 0], [1, 0]]}, "shape (2, 2)"),
        ("geometry", {"coordinates": [[0, 0], [1, 0], [2, 0]]}, "has no junction"),
    ):
        broken = copy.deepcopy(document)
        broken["features"][first][part] |= change
        path.write_text(json.dumps(broken))
        (problem,) = check_lot(path)
        assert (problem.feature, named in problem.message) == (first, True)
        assert refusal(read_lot, path) == f"{path}: feature {first}: {problem.message}"


def test_a_junction_is_blocked_for_all_who_come_to_it():
    ends = []
    for turns in ([], BACK):  # nobody turns back
        demand = Demand(PoissonArrivals(1200, 8 * 3600, 8.25 * 3600), ExponentialTime(600.0))
        drivers = [DriverKind(policy=POLICIES["first-free"])]
        scenario = make_scenario(blocks(turns, every=20.0))
        fleet = Fleet(scenario, demand, drivers=drivers, manoeuvre_s=30.0, background="none")
        ends.append(driven(fleet, 1).cars["ended_at"])
        assert (fleet.cars["queued_s"] > 0.0).sum() > 100
    np.testing.assert_array_equal(*ends)


LEFT = [turn(*arms) for arms in itertools.pairwise(["west", "north", "east", "south", "west"])]


@pytest.mark.parametrize("turns", [LEFT[:1], LEFT, [turn("west", "north", only=True)]])
def test_a_survey_passes_every_slot_once_without_them(turns):
    plain, lot = survey_route(blocks(every=20.0)), blocks(turns, every=20.0)
    route = survey_route(lot)
    assert (lot.neighbors[route.vertices[:-1]] == route.vertices[1:, None]).any(axis=1).all()
    assert sorted(route.vertices[route.vertices < lot.n_slots]) == list(range(lot.n_slots))
    assert route.length == pytest.approx(plain.length)


def mirrored(lot):
    """The mirror image of a lot, west to east, in which cars keep to the other side."""
    return dataclasses.replace(
        lot,
        slot_xy=lot.slot_xy * ACROSS,
        slot_yaw=np.pi - lot.slot_yaw,
        slot_mouth=OTHER[lot.slot_mouth],
        lanes=tuple(Lane(lane.points * ACROSS, lane.oneway, lane.speed) for lane in lot.lanes),
        entries=lot.entries * ACROSS,
        goals=lot.goals * ACROSS,
        walls=tuple(wall * ACROSS for wall in lot.walls),
        turns=tuple(Turn(turn.points * ACROSS, turn.only) for turn in lot.turns),
        left_hand=not lot.left_hand,
    )


# In `mini`, two slots are equally far from the one opposite.
@pytest.mark.parametrize("name", [name for name in CAR_PARKS if name != "mini"])
def test_its_graph_and_what_is_seen_are_mirror_images(name):
    lot = packaged_lot(name)
    image = mirrored(lot)
    np.testing.assert_allclose(image.vertex_xy, lot.vertex_xy * ACROSS, atol=1e-9)
    np.testing.assert_array_equal(image.neighbors[:, SWAPPED], lot.neighbors)
    np.testing.assert_allclose(image.edge_length[:, SWAPPED], lot.edge_length, atol=1e-9)
    for one, other in zip(make_scenario(lot).sight_lines, make_scenario(image).sight_lines, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)
    for line, other in zip(DrivenLines(lot).lines, DrivenLines(image).lines, strict=True):
        np.testing.assert_allclose(other.points, line.points * ACROSS, atol=1e-9)
    assert mirrored(image).left_hand is False


def test_its_kerb_side_camera_looks_to_the_left():
    ((name, _, mount),) = make_rig(None, make_scenario(mirrored(packaged_lot("mini")))).cameras
    ((_, _, usual),) = make_rig(None, make_scenario("mini")).cameras
    assert (name, mount.yaw) == ("left", -usual.yaw)


def test_left_hand_traffic_is_kept_in_files_and_imports_turn_parked_cars(tmp_path):
    path = tmp_path / "street.geojson"
    write_lot(LotDraft.of_lot(packaged_lot("campus")).in_left_hand_traffic().lot(), path)
    lot = read_lot(path)
    assert lot.left_hand
    assert json.loads(path.read_text())["traffic"] == "left"
    along = lot.slot_mouth != Mouth.REAR
    assert (np.cos(lot.slot_yaw - lot.vertex_yaw[: lot.n_slots])[along] > 0.0).all()
    plain = packaged_lot("campus")
    np.testing.assert_allclose(lot.mouth_xy(), plain.mouth_xy(), atol=1e-9)
    assert lot.n_vertices == plain.n_vertices
    path.write_text(path.read_text().replace('"traffic": "left"', '"traffic": "middle"'))
    assert "traffic is 'middle', want 'left' or 'right'" in refusal(read_lot, path)
    write_lot(packaged_lot("mini"), tmp_path / "mini.geojson")
    ran("lot", "import", str(tmp_path / "mini.geojson"), "--left-hand", "--out", str(tmp_path / "l.geojson"))
    assert read_lot(tmp_path / "l.geojson").left_hand


@pytest.mark.parametrize("tags", [{}, {"parking:both": "lane", "parking:both:orientation": "diagonal"}])
def test_a_mirrored_town_is_its_mirror_image(tmp_path, tags):
    """A dual carriageway, whose untagged kerbs are the outer ones, a one-way and a two-way street."""
    towns = []
    for sign in (1, -1):
        place = Map()
        for x, y, kind in ((-10, 1, "tertiary"), (10, -1, "tertiary"), (60, 1, "residential")):
            ends = [(sign * -x, -y * 200), (sign * -x, 0), (sign * -x, y * 200)]
            place.way(ends, {"highway": kind, "oneway": "yes", **tags})
        street = {"highway": "residential"}
        place.way([(sign * 100, y) for y in (-200, 0, 200)], street, **tags)
        for y in (-200, 0, 200):
            place.way([(sign * x, y) for x in (-60, -10, 10, 100)], street, **{"parking:both": "no"})
        place.way([(sign * 100, 0), (sign * 200, 0)], {"highway": "primary", "parking:both": "no"})
        for x in (-75, -25, 20, 85, 115):
            place.box(sign * x, -190, sign * (x + 5), 190, {"building": "house"})
        town = import_town(place.write(tmp_path / f"{sign}.osm"), left_hand=sign < 0).draft
        towns.append((town.in_left_hand_traffic() if sign < 0 else town).lot())
    right, left = towns
    assert left.n_slots == right.n_slots > 30
    apart, other = cKDTree(left.slot_xy).query(right.slot_xy * ACROSS)
    assert apart.max() < 0.05
    np.testing.assert_allclose(np.cos(left.slot_yaw[other] + right.slot_yaw - np.pi), 1.0, atol=1e-3)
    if not tags:  # no car on the median: the halves are at -10 m and 10 m, the middle of all streets at 70 m
        assert not (np.abs(left.slot_xy[:, 0] - 70.0) < 10.0).any()
