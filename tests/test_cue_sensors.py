"""What sensors show of cars that leave, and what perception makes of it."""

import gymnasium as gym
import numpy as np
import pytest
import shapely
from gymnasium.utils.env_checker import check_env

import parkenv
from parkenv import OccupancyProcess
from parkenv.belief.slot_belief import SlotBelief
from parkenv.perception.departure_cues import WEIGHTS, DepartureCues, log_likelihood_ratio
from parkenv.perception.pipeline import PerceptionPipeline
from parkenv.world.cue_scene import ARRIVED_S, CueScene
from parkenv.world.cues import Cues
from parkenv.world.lot_scene import LotScenes, slot_lot
from parkenv.world.occupancy.kernel import shown_s
from sim_sensors.camera.models import PinholeCamera
from sim_sensors.camera.weather import Weather
from sim_sensors.ground_truth import vehicle_boxes
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.mesh import Lamps
from sim_sensors.rig import RIGHT, Mount, SensorRig, TimedCapture

RIG = SensorRig(
    cameras=(("right", PinholeCamera.from_field_of_view(160, 120), Mount(z=1.1, yaw=RIGHT)),),
    lasers=(("laser", LaserScanner(), Mount(z=0.5)),),
)


def busy(name="mini", cues=None, stay_s=600.0, p=0.9):
    """A lot with cars that come and go fast."""
    scenario = parkenv.make_scenario(name)
    n, hours = scenario.lot.n_slots, np.ones(168)
    leaving = np.full(n, 1.0 / stay_s)
    process = OccupancyProcess(leaving * p / (1.0 - p), hours, leaving, hours)
    return scenario.replace(occupancy=process, prior=None, cues=cues or Cues())


class Departure:
    """The scenes around the first car of a world that leaves after a long announcement."""

    def __init__(self, name="mini", key=12345):
        self.scenario, self.key = busy(name), np.uint64(key)
        arrival = self.scenario.occupancy.draw_arrival(self.scenario.arrival, self.key)
        self.world = self.scenario.occupancy.world(self.key, arrival)
        self.slots = np.arange(self.scenario.lot.n_slots)
        ends = self.world.next_free(self.slots, arrival.time)
        leads = np.array([shown_s(self.key, s, end, 31.0) for s, end in enumerate(ends)])
        chosen = (leads > 14.0) & (leads < 90.0) & (ends > arrival.time + 130.0)
        self.slot = int(np.flatnonzero(chosen)[0])
        self.end, self.lead, self.begin = ends[self.slot], leads[self.slot], arrival.time
        lot = self.scenario.lot
        heading = np.array([np.cos(lot.vertex_yaw[self.slot]), np.sin(lot.vertex_yaw[self.slot])])
        self.pose = np.array([*(lot.vertex_xy[self.slot] - 6.5 * heading), lot.vertex_yaw[self.slot] + 0.7])

    def scenes(self, cues=True):
        scenario = self.scenario if cues else self.scenario.replace(cues=None)
        return LotScenes(slot_lot(scenario.lot), scenario, self.key, self.world)


@pytest.mark.parametrize("name", ["mini", "street"])
def test_the_occupancy_is_the_same_and_a_car_moves_out_without_touching_others(name):
    leaving = Departure(name)
    cued, plain = leaving.scenes(), leaving.scenes(cues=False)
    for time in np.arange(leaving.end - 120.0, leaving.end + 5.0, 4.0):
        np.testing.assert_array_equal(cued.at(time).present, plain.at(time).present)
    slots, lot = slot_lot(leaving.scenario.lot), leaving.scenario.lot
    scene = slots.scene(np.full(lot.n_slots, True), leaving.slots)
    ways = CueScene(lot, Cues(), leaving.key, leaving.world)
    for slot in leaving.slots[:12].tolist():
        near = np.flatnonzero(np.hypot(*(lot.slot_xy - lot.slot_xy[slot]).T) < 14.0)
        others = shapely.union_all([shapely.Polygon(scene.footprint(i)) for i in near if i != slot])
        for share in np.linspace(0.0, 1.0, 9):
            moved = scene.with_vehicle(slot, pose=ways._moved(slot, scene.vehicle_pose[slot], share))
            car = shapely.Polygon(moved.footprint(slot))
            assert not car.intersects(others)
        assert not car.intersects(shapely.Polygon(lot.slot_corners()[slot]))


@pytest.mark.parametrize("weather", ["sunny", "dusk", "rain"])
def test_lamps_that_are_lit_show_in_the_picture(weather):
    leaving = Departure()
    shown, (_, camera, mount) = [], RIG.cameras[0]
    light = Weather.draw(weather, 3)
    for cues in (False, True):
        scene = leaving.scenes(cues).at(leaving.end - 9.0, leaving.pose)
        frame = camera.render(scene, mount.camera_pose(leaving.pose), light, 0)
        red, green, _ = frame.image[frame.ids == leaving.slot + 1].astype(int).T
        shown.append(int(((red > 200) & (red - green > 60)).sum()))
    assert shown[0] == 0
    assert shown[1] > 8
    assert Lamps(int(scene.lamps[leaving.slot])) & Lamps.TAIL
    before = [leaving.scenes(cues).at(leaving.begin + ARRIVED_S, leaving.pose) for cues in (False, True)]
    one, other = (RIG.capture(scene, leaving.pose, light, 0).images["right"].image for scene in before)
    np.testing.assert_array_equal(one, other)


def test_a_car_that_moves_out_does_so_in_scans_and_in_the_ground_truth():
    leaving = Departure()
    leaving.pose[2] += 0.4
    scenes, (_, camera, mount) = leaving.scenes(), RIG.cameras[0]
    boxes, nearest = [], []
    for left in (11.0, 0.2):
        scene = scenes.at(leaving.end - left, leaving.pose)
        scan = RIG.capture(scene, leaving.pose, Weather(), 0).scans["laser"]
        eye = mount.camera_pose(leaving.pose)
        truth = vehicle_boxes(camera, scene, eye, camera.render(scene, eye, Weather(), 0))
        boxes.append(truth.distance[truth.ids == leaving.slot + 1][0])
        car = shapely.Polygon(scene.footprint(leaving.slot)).buffer(0.1)
        angle = leaving.pose[2] + np.radians(-135.0 + 0.25 * np.arange(len(scan)))
        ends = leaving.pose[:2] + scan[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        hits = shapely.contains_xy(car, ends)
        assert hits.sum() > 5
        nearest.append(scan[hits].min())
    assert boxes[1] < boxes[0] - 0.5
    assert nearest[1] < nearest[0] - 0.3
    blocked = scenes.at(leaving.end - 0.2, np.array([*leaving.scenario.lot.mouth_xy()[leaving.slot], 0.0]))
    assert blocked.lamps[leaving.slot]
    parked = leaving.scenes(cues=False).at(leaving.end - 0.2)
    moved = blocked.vehicle_pose[leaving.slot] - parked.vehicle_pose[leaving.slot]
    assert np.hypot(*moved[:2]) < 0.1, "it waits for the searching car"


def test_somebody_comes_to_the_door_and_is_gone_before_lamps_are_lit():
    leaving = Departure()
    scenes, away = leaving.scenes(), []
    for after in (-9.0, -5.0, 0.5):
        scene = scenes.at(leaving.end - leaving.lead + after)
        gap = scene.movers.walker_pose[:, :2] - scene.vehicle_pose[leaving.slot, :2]
        away.append(np.hypot(*gap.T).min())
    assert away[0] > away[1] + 1.0 > away[2]
    assert 0.8 < away[2] < 1.8
    scene = scenes.at(leaving.end - 9.0)
    if scene.movers is not None:
        gap = scene.movers.walker_pose[:, :2] - scene.vehicle_pose[leaving.slot, :2]
        assert np.hypot(*gap.T).min() > 1.8


def test_cars_that_were_just_backed_in_are_lit():
    leaving, lit, dark = Departure(), 0, 0
    scenes, lot = leaving.scenes(), leaving.scenario.lot
    for time in np.arange(leaving.begin + 10.0, leaving.begin + 1500.0, 2.0):
        new = leaving.world.sojourn(leaving.slots, time) != leaving.world.sojourn(leaving.slots, time - 3.0)
        scene = scenes.at(time)
        for slot in np.intersect1d(np.flatnonzero(new), scene.present):
            if np.cos(scene.vehicle_pose[slot, 2] - lot.slot_yaw[slot]) < 0.0:
                lit += 1
                assert scene.lamps[slot]
            elif leaving.world.next_free([slot], time)[0] > time + 100.0:
                dark += 1
                assert scene.lamps is None or not scene.lamps[slot]
    assert min(lit, dark) > 0


def test_raw_sensors_have_cues_and_no_belief_about_them():
    env = gym.make("parkenv/SearchSensors-v2", scenario=busy(), rig=RIG, captures=1)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert "cues" not in observation


class Steady:
    """Likelihoods that do not depend on what is seen."""

    def __init__(self, ratio):
        self.ratio = ratio

    def __call__(self, features):
        return np.full(len(features), np.log(self.ratio))


def test_the_belief_after_perceived_cues_is_by_bayes_rule_and_successive_pictures_count_once(monkeypatch):
    monkeypatch.setattr("parkenv.envs.perception.log_likelihood_ratio", Steady(10.0))
    env = gym.make("parkenv/SearchPerception-v2", scenario=busy(), rig=RIG, weather="rain")
    observation, _ = env.reset(seed=4)
    n, before = env.unwrapped.scenario.lot.n_slots, np.zeros(0)
    for _ in range(2):
        move = int(np.flatnonzero(observation["action_mask"][:4])[0])
        observation, *_ = env.step(move)
        (slots, taken), excess = env.unwrapped.perception.observation, observation["cues"][:n]
        fresh = np.setdiff1d(slots[taken], np.flatnonzero(before))
        forecast, decay_rate, p = observation["belief"].reshape(4, -1)[:3]
        usual = decay_rate * (1.0 - forecast) / observation["cues"][n : 2 * n] * p
        after = 10.0 * usual / (10.0 * usual + 1.0 - usual)
        assert len(fresh) or len(before)
        np.testing.assert_allclose(excess[fresh], (after - usual)[fresh], rtol=1e-4)
        again = np.intersect1d(slots[taken], np.flatnonzero(before))
        assert (excess[again] <= before[again] + 1e-6).all()
        before = excess.copy()


def test_a_step_without_captures_changes_nothing():
    """A driven trip observes before it has moved."""
    env = gym.make("parkenv/SearchPerception-v2", scenario=busy(), rig=RIG).unwrapped
    before, _ = env.reset(seed=0)
    env.perception.reset()
    env.perception.update_belief(env._address, env.state.vertex, [])
    assert len(env.perception.observation.slots) == 0
    np.testing.assert_array_equal(env._observation(env.state.vertex)["cues"], before["cues"])


def test_lamps_and_motion_are_evidence_that_a_car_leaves():
    leaving = Departure()
    rig, scenes = SensorRig.thesis().resized(400), leaving.scenes()
    pipeline, cues = PerceptionPipeline(rig, leaving.scenario.lot), DepartureCues(leaving.scenario.lot)
    results = {}
    for left, turn in ((leaving.lead + 40.0, 0.0), (9.0, 0.0), (2.0, 0.4), (0.2, 0.4)):
        time, pose = leaving.end - left, leaving.pose + np.array([0.0, 0.0, turn])
        capture = rig.capture(scenes.at(time, pose), pose, Weather.draw("overcast", 3), 0)
        results[left] = pipeline.locate(TimedCapture(time, capture))
    still, lit, moves, out = results.values()
    pairs = (still, still), (still, lit), (moves, out)
    rows = [cues.features(pair, np.array([leaving.slot])) for pair in pairs]
    shown = [dict(zip(WEIGHTS, row[0], strict=True)) for row in rows]
    assert shown[0]["picture"] == shown[1]["picture"] == 1.0
    assert shown[0]["red"] == 0.0 < 0.3 < shown[1]["red"]
    assert shown[1]["moved"] == 0.0 < 0.5 < shown[2]["moved"]
    ratio = [log_likelihood_ratio(row)[0] for row in rows]
    assert ratio[0] < 0.0 < 0.8 < ratio[1]
    assert ratio[2] > 1.5


def test_the_belief_in_a_slot_falls_as_its_car_is_seen_to_leave():
    """And without cues it does not: the same drive in the same world."""
    options = {"weather": "overcast", "rig": "laser", "picture_width": 400}
    envs = [
        gym.make("parkenv/SearchPerception-v2", scenario=scenario, **options).unwrapped
        for scenario in (busy(stay_s=200.0), busy(stay_s=200.0).replace(cues=None))
    ]
    check_env(envs[0], skip_render_check=True)
    seen = [env.reset(seed=36)[0] for env in envs]
    for _ in range(3):
        seen = [env.step(3)[0] for env in envs]
    later = [SlotBelief.of_observation(observation).decay(20.0).p_occupied for observation in seen]
    slot = int(np.argmin(later[0] - later[1]))
    assert later[0][slot] < later[1][slot] - 0.1
    left = envs[0].state.world.next_free([slot], envs[0].state.time)[0] - envs[0].state.time
    assert 0.0 < left < 40.0
