"""The perception stack on simulated drives: sessions, their map, and searches with its observations."""

from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
from command_line import ran, refused, summary_of

from parkenv import InputError, Lane, Mouth, OccupancyProcess, ParkingLot, Traffic, make_scenario
from parkenv.lots import packaged_lot
from parkenv.mapping.inference import SessionLog
from parkenv.mapping.route import survey_route
from parkenv.mapping.store import MapStore
from parkenv.mapping.survey import Survey, SurveySettings
from parkenv.mapping.survey_score import METHODS
from parkenv.perception.pipeline import PerceptionPipeline
from parkenv.scenarios.spec import scenario_spec
from parkenv.studies.runner import run
from parkenv.studies.sensing.sessions import SESSIONS
from parkenv.studies.sensing.survey_study import SurveyStudy
from parkenv.studies.sensing.surveys import map_error
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.rig import Mount, SensorRig

BUSY = Traffic(cars=2, pedestrians=4)
LOTS = ["campus", "jam", "street"]


def halves(name="mini", traffic=BUSY):
    """Every other slot is always taken."""
    lot = make_scenario(name).lot
    taken = np.arange(lot.n_slots) % 2 == 0
    world = OccupancyProcess.from_demand(np.where(taken, 25.0, -25.0), np.zeros(168), 1e9)
    return make_scenario(name, occupancy=world, traffic=traffic), taken


def test_who_watches_a_session_changes_nothing_and_sees_the_truth():
    scenario, frames = make_scenario("mini"), []
    survey = Survey(scenario, SurveySettings(every=8.0, weather="rain"))
    watched, alone = survey.drive(0, on_frame=frames.append), survey.drive(0)
    for name in ("p_occupied", "cars"):
        np.testing.assert_array_equal(getattr(watched.session, name), getattr(alone.session, name))
    assert watched.session.key == alone.session.key
    assert np.array_equal(watched.truth, alone.truth)
    times = [frame.result.captured.time for frame in frames]
    assert times == sorted(times)
    assert frames[0].truth.shape == (scenario.lot.n_slots,)


@pytest.mark.parametrize("rig", ["laser", pytest.param("stereo", marks=pytest.mark.slow)])
def test_a_session_finds_which_slots_are_taken(rig):
    every = {"laser": 4.0, "stereo": 1.25}[rig]
    scenario, taken = halves()
    result = Survey(scenario, SurveySettings(rig=rig, weather="overcast", every=every)).drive(0, pictures=2)
    np.testing.assert_array_equal(result.truth, taken)
    assert result.slot_accuracy >= 0.9
    assert result.slot_accuracy_seen >= 0.9
    assert result.found >= 0.8 * result.parked
    assert result.score.right >= 0.6 * result.score.detections > 0
    fitted, thesis = (np.median(result.score.errors(method), axis=0) for method in METHODS)
    assert (fitted < [0.1 if rig == "laser" else 0.4, 0.6, np.radians(10.0)]).all()
    assert (fitted < thesis).all(), "distance, place and heading are all better than the thesis's way"
    assert len(result.shown) == 2
    assert result.grid.seen.any()


@pytest.mark.slow
def test_a_survey_goes_on_where_it_was(tmp_path):
    study = SurveyStudy(scenario=scenario_spec("mini"), weather="sunny", every=15.0, sessions=1, jobs=1)
    run(study, tmp_path)
    (first,) = SESSIONS.read(tmp_path)
    seen = []
    run(study.changed(sessions=2), tmp_path, resume=True, progress=lambda *news: seen.append(news[1:]))
    rows = SESSIONS.read(tmp_path)
    assert repr(rows[0]) == repr(first), "was not driven again"
    assert seen[:2] == [(1, 2), (2, 2)]
    # Sessions that are not in the map are driven again, and others stay.
    (tmp_path / "map.sqlite").unlink()
    other = run(study.changed(seed=1), tmp_path, resume=True)
    assert [row["key"] for row in SESSIONS.read(tmp_path)] == [study.changed(seed=1).survey.key_of(0)]
    assert other.rows[0]["sessions"] == 1
    run(study, tmp_path, resume=True)
    with MapStore(tmp_path / "map.sqlite", study.built.lot, create=False) as store:
        assert len(store.sessions()) == len(SESSIONS.read(tmp_path)) == 2


def test_the_maps_error_is_zero_where_it_is_right():
    scenario, taken = halves()
    log = SessionLog(np.zeros(500), np.tile(taken, (500, 1)), np.ones((500, len(taken)), bool))
    error, expected = map_error(scenario, [ArrivalWindow((0,), 0.0, 0.0)], log)
    assert error < 0.02
    assert expected < 0.01


def test_survey_and_map_on_the_command_line(tmp_path):
    out = tmp_path / "s"
    ran("survey --scenario mini --sessions 1 --weather sunny --every 3 --jobs 1 --out", out)
    (row,) = summary_of(out)["rows"]
    assert {
        "sessions", "slots", "car_detection_rate", "detection_precision", "range_abs_error_m", "slot_accuracy",
        "slot_accuracy_seen", "unknown_fraction", "occupancy_mae", "seconds_per_frame",
    } <= set(row)  # fmt: skip
    names = ("detections", "graph", "map", "reach", "session", "slots_found")
    assert sorted(p.name for p in out.glob("*.png")) == [f"{name}_mini.png" for name in names]
    file, spec = out / "map.sqlite", (out / "experiment.json").read_text()
    shown = ran("map", file, *"--scenario mini --weekday tue --hour 9.5 --out".split(), tmp_path / "m").stdout
    assert "mini, tue 09:30, 1 session" in shown
    assert len((tmp_path / "m" / "slots.csv").read_text().splitlines()) == 11
    for words, message in (
        (["survey", "--scenario", "campus", "--sessions", 1, "--jobs", 1, "--out", out], "--resume"),
        (["map", file, "--scenario", "campus"], "is a map of lot 'mini', not of 'campus'"),
        (["map", tmp_path / "none", "--scenario", "mini"], "no such map file"),
    ):
        assert message in refused(*words)
    assert (out / "experiment.json").read_text() == spec


def test_the_search_sees_what_is_there_and_nothing_else():
    scenario, taken = halves()
    env = gym.make("parkenv/SearchPerception-v2", scenario=scenario, weather="sunny").unwrapped
    prior = env.reset(seed=0)[0]["p_occupied"]
    lot = scenario.lot
    for _ in range(6):
        action = int(np.flatnonzero(lot.neighbors[env.state.vertex] >= 0)[-1])
        observation, *_ = env.step(action)
    seen = env.state.belief.observed
    assert seen.sum() >= 4
    believed = observation["p_occupied"] > 0.5
    assert (believed == taken)[seen].mean() >= 0.9
    np.testing.assert_array_equal(observation["p_occupied"][~seen], prior[~seen])


def test_a_rig_that_cannot_see_is_refused():
    laser = SensorRig(lasers=(("laser", LaserScanner(), Mount(z=0.5)),))
    with pytest.raises(InputError, match="no camera"):
        PerceptionPipeline(laser, make_scenario("mini").lot)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rig", "every", "accuracy"), [("campus", "laser", 9.0, 0.97), ("street", "stereo", 6.0, 0.94)]
)
def test_held_out_sessions_are_as_right_as_promised(name, rig, every, accuracy):
    """A survey with a seventh and a fifth of the default number of captures."""
    window = ArrivalWindow((1,), 36_000.0, 43_200.0)
    settings = SurveySettings(rig=rig, windows=(window,), seed=777, every=every)
    assert Survey(make_scenario(name, traffic=BUSY), settings).drive(0).slot_accuracy >= accuracy


def legal(lot, a, b):
    return b in lot.neighbors[a]


@pytest.mark.parametrize("name", LOTS)
def test_every_slot_is_passed_on_the_right_and_the_drive_ends_where_it_began(name):
    lot = packaged_lot(name)
    for both_sides in (True, False):
        route = survey_route(lot, both_sides=both_sides)
        assert set(route.vertices.tolist()) >= set(range(lot.n_slots))
        assert route.vertices[0] == route.vertices[-1] == lot.entry_vertices[0]
        np.testing.assert_array_equal(route.path, lot.vertex_xy[route.vertices])
        assert route.length == pytest.approx(np.hypot(*np.diff(route.path, axis=0).T).sum())
    seen, way_of = set(), route.vertices
    for before, vertex, after in zip(way_of[:-2], way_of[1:-1], way_of[2:], strict=True):
        if vertex < lot.n_slots:
            way = lot.vertex_xy[after] - lot.vertex_xy[before]
            off = lot.slot_xy[vertex] - lot.vertex_xy[vertex]
            if way[0] * off[1] - way[1] * off[0] < 0.0:
                seen.add(int(vertex))
    assert seen == set(range(lot.n_slots))


@pytest.mark.parametrize("name", LOTS)
def test_lanes_are_driven_as_they_may_be_but_for_slots_on_their_left(name):
    lot = packaged_lot(name)
    free, strict = survey_route(lot), survey_route(lot, both_sides=True)
    assert all(legal(lot, a, b) for a, b in pairwise(strict.vertices))
    wrong = [(a, b) for a, b in pairwise(free.vertices) if not legal(lot, a, b)]
    assert strict.against == 0
    assert bool(wrong) == (free.against > 0)
    for a, b in wrong:
        assert legal(lot, b, a)


def test_one_aisle_is_driven_there_and_back_and_a_trap_not():
    lot = packaged_lot("mini")
    route = survey_route(lot)
    x = route.path[:, 0]
    there_and_back = 2 * (x.max() - x.min())
    assert there_and_back <= route.length < there_and_back + 5.0  # a little for changing sides at the ends
    visits = np.bincount(route.vertices[route.vertices < lot.n_slots])
    assert (visits == 1).all()
    lane, slot = Lane([[0.0, 0.0], [20.0, 0.0]], oneway=True), ([[10.0, -5.5]], [-np.pi / 2], [5.0], [2.5])
    lot = ParkingLot("trap", ("a",), *slot, [Mouth.REAR], (lane,), [[0.0, 0.0]], [[5.0, 5.0]])
    with pytest.raises(InputError, match="no drive leads from its first entry past every slot and back"):
        survey_route(lot)
