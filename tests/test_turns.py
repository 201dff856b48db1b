"""Turns that cars may not make: the ways round them, files, imports, and that nobody ever makes one."""

import copy
import itertools
import json

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from lot_checks import refusal
from scipy.sparse.csgraph import dijkstra
from small_lots import driven

from parkenv import make_agent, make_scenario
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.errors import InputError
from parkenv.lots import check_lot, read_lot, write_lot
from parkenv.mapping.route import survey_route
from parkenv.studies.simulate import adapt_to_agent
from parkenv.world.demand import ConstantTime, Demand, ExponentialTime, PoissonArrivals
from parkenv.world.lot import GraphError, Lane, Mouth, ParkingLot, Turn
from planners.heuristics import POLICIES

AT = (-100.0, 0.0, 100.0)
ARMS = {"west": (-1, 0), "east": (1, 0), "north": (0, 1), "south": (0, -1)}


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


def metres(lot):
    return dijkstra(lot.drive_matrix(), indices=lot.entry_vertices[0])[0]


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
    assert metres(blocks(turns)) == pytest.approx(wanted)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([(-50, 0), (3, 0), (50, 0)], r"turn 0: has no junction or end of a lane at \(3.0, 0.0\) m"),
        ([(-50, -50), (0, 0), (50, 0)], "turn 0: has no lane by which cars come from"),
        ([(-50, 0), (0, 0), (50, 50)], "turn 0: has no lane by which cars leave"),
        ([(-100, 0), (-150, 0), (-100, 0)], r"turn 0: prohibits the last turn that cars may make"),
        ([(-50, 0), (0, 0)], r"turn points has shape \(2, 2\), want \(3, 2\)"),
    ],
)
def test_a_turn_that_there_is_not_is_refused(points, message):
    with pytest.raises(InputError, match=message):
        blocks([Turn(np.array(points, float))])


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


TURNS = st.builds(
    turn, *[st.sampled_from(sorted(ARMS))] * 2, st.tuples(*[st.sampled_from(AT)] * 2), only=st.booleans()
)


@settings(max_examples=6, deadline=None)
@given(turns=st.lists(TURNS, min_size=1, max_size=12), seed=st.integers(0, 99))
def test_nobody_ever_makes_a_forbidden_turn(turns, seed):
    """Of all compiled drivers, in a crowded town; turns that the map has not, or that leave no way on, are dropped."""
    while True:
        try:
            lot = blocks(turns, every=40.0)
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
    steps = fleet.take_steps()
    drives = set()
    for car in np.unique(steps["car"]).tolist():
        of_car = steps[steps["car"] == car]
        drives |= made(lot, of_car["origin"].tolist(), of_car["vertex"].tolist())
    assert drives
    for one in turns:
        comes, at, leaves = one.points
        arms = [arm_of(comes - at), arm_of(leaves - at)]
        at = tuple(at.tolist())
        those = {last for first, where, last in drives if (first, where) == (arms[0], at)}
        assert those <= {arms[1]} if one.only else arms[1] not in those


@pytest.mark.parametrize("name", ["mdp", "belief"])
def test_agents_drive_round_it_too(name):
    at = (-100.0, 0.0)
    forbidden = {("west", at, "north"), ("west", at, "east")}
    turns = [turn(comes, leaves, at) for comes, _, leaves in forbidden]
    assert driven_by(name, blocks(every=40.0)) & forbidden
    assert not driven_by(name, blocks(turns, every=40.0)) & forbidden


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
