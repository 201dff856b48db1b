"""From photographs or film to a map: ranging from boxes alone, tables and tracks of poses, and whole drives."""

import csv
import datetime
import math

import cv2
import numpy as np
import pytest
from command_line import ran
from hypothesis import assume, given
from hypothesis import strategies as st
from PIL import Image

from parkenv import InputError, make_scenario
from parkenv.files.tracks import read_track
from parkenv.lots.local_frame import LocalFrame
from parkenv.mapping.recordings.folders import source_of
from parkenv.mapping.recordings.photo_options import PhotoOptions
from parkenv.mapping.recordings.recorded_drive import RecordedDrive
from parkenv.mapping.store import MapStore
from parkenv.mapping.survey import Survey, SurveySettings
from parkenv.perception.detector import Detections, DetectorErrors
from parkenv.perception.hog_detector import HogDetector
from parkenv.perception.monocular import (
    HEIGHT,
    STREET_PITCH,
    GroundView,
    RangingErrors,
    UsualCars,
    corners_of_cars,
    distances_ahead,
    localize_boxes,
    street_pitch,
)
from parkenv.perception.slot_filter import P_OCCUPIED, SlotFilter
from sim_sensors.camera.models import PinholeCamera
from sim_sensors.rig import RIGHT, Mount

CAMERA = PinholeCamera.from_field_of_view(1280, 960, math.pi / 2)
PLAIN, HOG = DetectorErrors(), HogDetector.errors
GPX = '<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{}</trkseg></trk></gpx>'
POINT = '<trkpt lat="{:.9f}" lon="{:.9f}"><time>{}</time></trkpt>'


def view_of(height=1.3, pitch=0.0):
    return GroundView(CAMERA, Mount(z=height, yaw=RIGHT, pitch=math.radians(pitch)))


def usual_box(ground, ahead, aside, view, tall=HEIGHT, wide=None, foot=None):
    """The box of a car: its tyres and roof ahead of or behind its nearest side as usual, (4,) px."""
    usual = UsualCars.seen_as(view)
    width = usual.width if wide is None else wide
    tyres = ahead + (usual.foot if foot is None else foot)
    bottom = ground.pixels(tyres, 0.0, 0.0)[1]
    top = ground.pixels(ahead + usual.roof, 0.0, tall)[1]
    # Sides are measured at the row of the tyres, and as far ahead as the nearest side.
    pitch = ground.mount.pitch
    scale = CAMERA.fx * (math.cos(pitch) + (bottom - CAMERA.cy) / CAMERA.fy * math.sin(pitch))
    sides = CAMERA.cx + scale * (aside + np.array([-0.5, 0.5]) * width) / ahead
    return np.array([sides[0], top, sides[1], bottom])


@given(
    ahead=st.floats(2.5, 14.0), aside=st.floats(-0.3, 0.3), view=st.integers(0, 2),
    height=st.floats(0.9, 2.4), pitch=st.floats(-6.0, 6.0),
)  # fmt: skip
def test_exact_boxes_of_usual_cars_give_the_exact_distance(ahead, aside, view, height, pitch):
    ground = view_of(height, pitch)
    box = usual_box(ground, ahead, aside * ahead, view)
    assume(box[0] > 30 and box[2] < CAMERA.width - 30 and box[1] > 25 and box[3] < CAMERA.height - 25)
    found, std, agree = distances_ahead(box[None], np.array([view], np.int8), ground, RangingErrors())
    assert found[0] == pytest.approx(ahead, rel=1e-6)
    assert agree[0]
    assert 0.0 < std[0] < 0.3 * ahead + 1.0


@pytest.mark.parametrize(
    ("detector", "view", "ahead"), [(PLAIN, 0, 5.0), (HOG, 1, 5.0), (PLAIN, 2, 11.0), (HOG, 0, 11.0)]
)
def test_the_stated_deviation_is_that_of_the_error(detector, view, ahead):
    """Boxes, pitch, and cars as uncertain as stated: as many errors within 1 and 2 deviations as of a normal one."""
    rng, n = np.random.default_rng(0), 400
    errors, found, std = RangingErrors(detector), [], []
    for _ in range(n):
        ground = view_of(pitch=math.degrees(rng.normal(0.0, errors.pitch)))
        usual = UsualCars.seen_as(view)
        sizes = rng.normal([HEIGHT, usual.width, usual.foot], [0.12, usual.width_std, usual.foot_std])
        box = usual_box(ground, ahead, 0.0, view, sizes[0], max(sizes[1], 0.8), sizes[2])
        box += (box[3] - box[1]) * (detector.shift + rng.normal(0.0, detector.std))
        at, its, _ = distances_ahead(detector.corrected(box[None]), np.array([view]), view_of(), errors)
        found.append(at[0])
        std.append(its[0])
    off = np.abs(np.array(found) - ahead) / std
    assert 0.58 < (off < 1.0).mean() < 0.8
    assert (off < 2.0).mean() > 0.9


@pytest.mark.parametrize(("detector", "pitch"), [(PLAIN, -4.0), (HOG, 4.0)])
def test_boxes_that_end_above_the_horizon_are_no_cars(detector, pitch):
    """However probable, and as high and wide as a car: the ground is elsewhere."""
    ground, tall = view_of(pitch=pitch), 250.0
    horizon = CAMERA.cy + CAMERA.fy * math.tan(ground.mount.pitch)
    for bottom, cars in ((horizon + 270.0, 1), (horizon - 1.0, 0), (horizon - 60.0, 0)):
        box = np.array([[500.0, bottom - tall, 820.0, bottom]]) + tall * np.array(detector.shift)
        found = Detections(box, np.ones(1), np.ones(1, np.bool_))
        assert len(localize_boxes(found, ground, np.zeros(3), RangingErrors(detector))) == cars


@pytest.mark.parametrize("raised", [-1.0, 0.0, 1.0])
def test_cars_of_a_street_tell_how_high_the_camera_looks(raised):
    """Their height does, however far away they are; without a car nothing does."""
    true, said = view_of(pitch=-2.0 + raised), view_of(pitch=-2.0)
    boxes = np.array([usual_box(true, x, y, 2) for x in (7.0, 10.0, 14.0) for y in (-1.0, 1.0)])
    sure = np.ones(len(boxes), np.float32)
    seen = [(Detections(boxes[k : k + 1], sure[:1], sure[:1] > 0), said) for k in range(len(boxes))] * 5
    pitch, error = street_pitch(seen, RangingErrors())
    assert math.degrees(pitch) == pytest.approx(raised, abs=0.25)
    assert error < 0.6 * STREET_PITCH
    assert street_pitch([], RangingErrors()) == (0.0, STREET_PITCH)


def before_a_slot(away):
    """The lot, a slot, its yaw, and where a vehicle stands whose camera looks into it."""
    lot, slot = make_scenario("campus").lot, 40
    yaw = lot.slot_yaw[slot]
    spot = lot.slot_xy[slot] - away * np.array([math.cos(yaw), math.sin(yaw)])
    return lot, slot, yaw, np.array([*spot, yaw - RIGHT])


def test_cars_are_placed_in_their_slots_and_uncertain_ones_in_none():
    """A car in each of five slots before the camera, by the box of its corners."""
    (lot, slot, yaw, vehicle), ground, placed = before_a_slot(6.5), view_of(), {}
    for error in (0.1, 3.0):
        slots = SlotFilter(lot)
        near = np.flatnonzero(np.hypot(*(lot.slot_xy - lot.slot_xy[slot]).T) < 4.0)
        away = lot.slot_xy[near] - vehicle[:2]
        along, across = corners_of_cars(lot.slot_yaw[near] - yaw)
        ahead = (math.cos(yaw) * away[:, 0] + math.sin(yaw) * away[:, 1])[:, None] + along
        aside = (math.sin(yaw) * away[:, 0] - math.cos(yaw) * away[:, 1])[:, None] + across
        sides = ground.pixels(ahead, aside, np.zeros_like(ahead))[..., 0]
        boxes = np.array([usual_box(ground, a.min() + UsualCars.seen_as(0).corner, 0.0, 0) for a in ahead])
        boxes[:, 0], boxes[:, 2] = sides.min(axis=1), sides.max(axis=1)
        sure = np.ones(len(near), np.float32)
        errors = RangingErrors.of_poses(error, 0.0)
        cars = localize_boxes(Detections(boxes, sure, sure > 0), ground, vehicle, errors, slots.headings_near)
        placed[error] = slots.update_from_cars(cars)
        if error == 0.1:
            assert placed[error].tolist() == near[cars.detection].tolist()
            assert len(cars) == len(near) > 1
            assert np.hypot(*(cars.xy - lot.slot_xy[placed[error]]).T).max() < 0.4
            assert (slots.states().p_occupied[near] > 0.8).all()
            assert (slots.states().p_occupied[near] <= P_OCCUPIED).all()
    assert (placed[3.0] == -1).all(), "3 m off, a car may as well be the neighbour's"


def test_slots_where_no_car_is_found_are_free_as_far_as_the_picture_shows():
    (lot, slot, _, vehicle), ground = before_a_slot(7.0), view_of()
    none, before = np.empty((0, 4)), np.array([[300.0, 400.0, 980.0, 900.0]])
    for boxes, error, seen in ((none, 0.1, True), (before, 0.1, False), (none, 3.0, False)):
        slots = SlotFilter(lot)
        slots.update_from_picture(ground, vehicle, boxes, RangingErrors.of_poses(error, 0.0))
        assert slots.states().in_view[slot] == seen
    slots = SlotFilter(lot)
    slots.update_from_picture(ground, vehicle, none, RangingErrors(DetectorErrors(missed=0.1)))
    assert slots.states().p_occupied[slot] == pytest.approx(0.1 / 1.1, abs=0.01)


def write_rows(path, rows):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)


def test_tables_and_tracks_say_the_same(tmp_path):
    frame, xy = LocalFrame(7.85, 48.0), np.column_stack([np.linspace(0.0, 9.0, 10), np.zeros(10)])
    lonlat = frame.to_lonlat(xy)
    times = [f"2026-05-04T09:00:{k:02d}.250Z" for k in range(10)]
    points = "".join(POINT.format(*p[::-1], t) for p, t in zip(lonlat, times, strict=True))
    (tmp_path / "t.gpx").write_text(GPX.format(points))
    globe = [(t, y, x, 3) for t, (x, y) in zip(times, lonlat, strict=True)]
    plane = [(t, x, y, 90.0) for t, (x, y) in zip(times, xy, strict=True)]
    write_rows(tmp_path / "p.csv", [("time", "lat", "lon", "speed"), *globe])
    write_rows(tmp_path / "h.csv", [("time", "x", "y", "heading"), *plane])
    track, table, metres = (read_track(tmp_path / name) for name in ("t.gpx", "p.csv", "h.csv"))
    for one in (table, metres):
        np.testing.assert_array_equal(track.stamps, one.stamps)
    start = int(datetime.datetime(2026, 5, 4, 9, tzinfo=datetime.UTC).timestamp())
    assert track.stamps[0] == start * 10**9 + 250_000_000
    positions = frame.to_xy(track.positions)
    np.testing.assert_allclose(positions, metres.positions, atol=2e-3)
    np.testing.assert_allclose(track.headings(positions), metres.headings(metres.positions), atol=1e-3)


def test_no_heading_is_made_across_a_gap(tmp_path):
    """East, then after a gap far away north: in segments, by time alone, or by a column; one lone point has none."""
    frame = LocalFrame(7.85, 48.0)
    parts = [[(3.0 * k, 0.0) for k in range(6)], [(50.0, 80.0)], [(90.0, 60.0 + 3.0 * k) for k in range(6)]]
    for gap in (1, 60):
        rows = [(k + gap * i, i, *p) for i, part in enumerate(parts) for k, p in enumerate(part, 6 * i)]
        segments = {0: "", 1: "", 2: ""}
        table = [("time", "x", "y", "segment") if gap == 1 else ("time", "x", "y", "speed")]
        for second, i, x, y in rows:
            time = f"2026-05-04T09:{second // 60:02d}:{second % 60:02d}Z"
            (lon, lat), *_ = frame.to_lonlat(np.array([[x, y]]))
            segments[i] += POINT.format(lat, lon, time)
            table.append((time, x, y, i if gap == 1 else 3))
        (tmp_path / "t.gpx").write_text(GPX.format("</trkseg><trkseg>".join(segments.values())))
        write_rows(tmp_path / "t.csv", table)
        wanted = [0.0] * 6 + [math.nan] + [math.pi / 2] * 6
        for track in (read_track(tmp_path / "t.gpx"), read_track(tmp_path / "t.csv")):
            xy = frame.to_xy(track.positions) if track.in_degrees else track.positions
            np.testing.assert_allclose(track.headings(xy), wanted, atol=1e-3)


def test_a_track_that_is_too_long_is_refused(tmp_path):
    (tmp_path / "t.gpx").write_text("<gpx>" + " " * 17_000_000 + "</gpx>")
    with pytest.raises(InputError, match="16,000,000 bytes"):
        read_track(tmp_path / "t.gpx")


def photographs(folder, count=4, size=(64, 48), times=False):
    folder.mkdir()
    for k in range(count):
        image = Image.fromarray(np.full((size[1], size[0], 3), 20 * k, np.uint8))
        exif = Image.Exif()
        if times:
            exif.get_ifd(0x8769).update({36867: f"2026:05:04 09:00:{k:02d}", 37521: "5"})
        image.save(folder / f"{k}.jpg", exif=exif, quality=100)
    return folder


def test_pictures_get_their_poses_by_name_by_exif_or_by_rate(tmp_path):
    folder = photographs(tmp_path / "photos", times=True)
    by_name, by_time = tmp_path / "n.csv", tmp_path / "t.csv"
    by_name.write_text("file,x,y,yaw\n2.jpg,5,1,0.5\n0.jpg,3,1,0\n")
    by_time.write_text("time,x,y,yaw\n" + "".join(f"2026-05-04T09:00:0{k},{k},0,0\n" for k in range(8)))
    for poses, more, wanted in (
        (by_name, {}, [[5, 1, 0.5], [3, 1, 0]]),
        (by_time, {}, [[0.5, 0, 0], [1.5, 0, 0], [2.5, 0, 0], [3.5, 0, 0]]),
        (by_time, {"clock_offset": 3.0}, [[3.5, 0, 0], [4.5, 0, 0], [5.5, 0, 0], [6.5, 0, 0]]),
        (by_time, {"fps": 2.0}, [[0, 0, 0], [0.5, 0, 0], [1, 0, 0], [1.5, 0, 0]]),
    ):
        taken = source_of(folder, None, PhotoOptions(poses=poses, fov=70.0, **more), None)
        drive = RecordedDrive(folder, source=taken)
        captures = list(drive.captures())
        np.testing.assert_allclose([pose for _, pose in captures], wanted, atol=1e-9)
        assert drive.rig.cameras[0][1].fx == pytest.approx(32.0 / math.tan(math.radians(35.0)))
    assert drive.start == 9 * 3600.0
    shown = [int(c.capture.images["camera"].image.mean().round()) for c, _ in captures]
    assert shown == [0, 20, 40, 60]


@pytest.mark.parametrize(
    ("poses", "options", "names"),
    [
        ("file,x,y,yaw\n9.jpg,0,0,0\n", {"fov": 70.0}, "has no picture '9.jpg'"),
        ("file,x,y,yaw\n0.jpg,0,0,0\n0.jpg,0,0,0\n", {"fov": 70.0}, "two poses"),
        ("time,x,y,yaw\n0,0,0,0\n", {"fov": 70.0}, "no Exif time"),
        ("time,x,y,yaw\n0,0,0,0\n", {}, "--calibration or --fov"),
        ("time,x,y\n0,0,0\n1,0,0\n", {"fov": 70.0, "fps": 1.0}, "no headings"),
        ("time,x,y,yaw\n0,0,0,0\n1,0,0,0\n", {"fov": 70.0, "fps": 1.0, "clock_offset": 900.0}, "do their clocks agree"),
    ],
)  # fmt: skip
def test_photographs_without_what_they_need_are_refused_in_a_line(tmp_path, poses, options, names):
    folder = photographs(tmp_path / "photos")
    (folder / "poses.csv").write_text(poses)
    with pytest.raises(InputError, match=names) as caught:
        RecordedDrive(folder, source=source_of(folder, None, PhotoOptions(**options), None))
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_drive_is_mapped_from_its_photographs_and_from_a_film_with_a_track(tmp_path):
    settings = SurveySettings(rig="camera", every=1.5, weather="overcast", seed=7)
    survey = Survey(make_scenario("mini"), settings)
    drive, lot = survey.draw(0), survey.scenario.lot
    truth = drive.world.occupied(np.arange(lot.n_slots), drive.times[-1])
    photos, begin = tmp_path / "photos", datetime.datetime(2026, 5, 4, 9, tzinfo=datetime.UTC)
    photos.mkdir()
    film = cv2.VideoWriter(str(tmp_path / "film.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 4.0, (640, 480))
    lonlat = LocalFrame(7.85, 48.0).to_lonlat(drive.poses[:, :2])
    points, rows = [], [("file", "x", "y", "yaw")]
    for i, pose in enumerate(drive.poses.tolist()):
        image = np.ascontiguousarray(drive.capture(i)[1].images["right"].image[..., ::-1])
        cv2.imwrite(str(photos / f"{i:04d}.png"), image)
        film.write(image)
        rows.append((f"{i:04d}.png", *pose))
        points.append(POINT.format(*lonlat[i, ::-1], (begin + datetime.timedelta(seconds=i / 4)).isoformat()))
    film.release()
    write_rows(photos / "poses.csv", rows)
    (tmp_path / "track.gpx").write_text(GPX.format("".join(points)))
    track = ("--poses", tmp_path / "track.gpx", "--origin", "48.0,7.85", "--pose-error", 0.1)
    for path, more in ((photos, ()), (tmp_path / "film.mp4", track)):
        out = tmp_path / f"of {path.name}"
        ran("map-drive --scenario mini --fov 90 --detector net", path, *more, "--out", out)
        with MapStore(out / "map.sqlite", lot, create=False) as store:
            p = next(iter(store.sessions())).p_occupied
        seen = ~np.isnan(p)
        assert seen.mean() >= 0.5
        assert ((p > 0.5) == truth)[seen].mean() >= 0.9
        assert "distance_std_m" in (out / "sightings.csv").read_text()
