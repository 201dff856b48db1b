"""Damaged and hostile variants of each kind of file are read, or refused by one `InputError`."""

import contextlib
import json
import random
import shutil
import tempfile
import tomllib
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from file_mutations import mutated_bytes, mutated_json, mutated_text
from test_csv_tables import SESSION
from test_import_osm import car_park

from parkenv.errors import InputError
from parkenv.files.images import read_image
from parkenv.lots import check_lot, import_lot, packaged_lot, read_lot, write_lot
from parkenv.lots.draft import ImportOptions
from parkenv.mapping.store import MapStore, Session
from parkenv.perception.car_datasets import read_uiuc_test
from parkenv.perception.car_model import CarModel
from parkenv.scenarios.build import build
from parkenv.scenarios.calibration import Calibration
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.show.report.page import write_page
from parkenv.studies.benchmark.result_file import check_result
from parkenv.studies.benchmark.suite import Suite
from parkenv.studies.compare.comparison import Comparison
from parkenv.studies.fleet.study import FleetStudy
from parkenv.studies.fleet.tables import CHANGES
from parkenv.studies.report import RunFolder
from parkenv.studies.results import EPISODES, Results, decision_s
from parkenv.studies.sensing.sessions import SESSIONS
from parkenv.studies.sensing.surveys import detection_by_distance
from parkenv.studies.trips.calibration_study import CalibrationStudy
from parkenv.world.occupancy.log import OccupancyLog
from parkenv.world.occupancy.process import OccupancyProcess
from parkenv.world.sensor_model import SensorModel

MINI = packaged_lot("mini")
ROOT = Path(__file__).parents[1] / "parkenv"


@dataclass
class Format:
    """A kind of file: its name, good content, damaged variants of it, and all that reads it."""

    name: str
    good: Any
    mutated: Callable[[Any, random.Random], bytes]
    read: Callable[[Path], object]

    def __str__(self):
        return self.name


def written(write, suffix=""):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"file{suffix}"
        write(path)
        return path.read_bytes()


def lot(path):
    problems = check_lot(path)
    assert all("\n" not in p.message for p in problems)
    write_lot(read_lot(path), path.with_name("copy.geojson"))


def imported(path):
    import_lot(path, ImportOptions(goals=((1.0, 2.0),), entries=((0.0, 4.0),))).lot()


def sensor_model(path):
    SensorModel.from_file(path).rates(np.array([1.0, 7.0]), np.array([True, False]))


def map_file(path):
    with MapStore(path, MINI) as store:
        cars = np.array([[1.0, 2.0, 0.5]])
        store.add(Session("a", 0.0, "laser", "rain", np.full(MINI.n_slots, 0.7), cars))


def mapped(path):
    with MapStore(path, MINI, create=False) as store:
        store.log()


def scenario(path):
    build(ScenarioSpec.read(path))


def resumed(path):
    folder = Results(path.parent)
    folder.claim({"seed": 0, "agents": {}}, resume=True)
    for row in folder.rows().values():
        decision_s(row)


def resumed_trips(path):
    CalibrationStudy.table.read(path.parent)


def reported(path):
    run = RunFolder.read(path.parent)
    EPISODES.read(path.parent)
    write_page(run.data(), path.with_name("report.html"), run.figures)


def reported_kind(path):
    """Report on a summary whose file is named after its command."""
    shutil.copy(path, path.with_name("summary.json"))
    reported(path.with_name("summary.json"))


def days(path):
    FleetStudy.table.read(path.parent)


def sessions(path):
    detection_by_distance(SESSIONS.read(path.parent))


def true_locations(path):
    (path.parent / "TestImages").mkdir(exist_ok=True)
    for number in range(2):
        (path.parent / "TestImages" / f"test-{number}.pgm").write_bytes(image(".pgm"))
    read_uiuc_test(path.parent, "single")


def benchmark(path):
    check_result(path)


LOG = "datetime,camera,slot_id,weather,occupied\n" + "".join(
    f"2015-11-{12 + h // 24} {h % 24:02d}:0{m},1,{s},SUNNY,{(h + s) % 2}\n"
    for h in range(0, 40, 9)
    for m in (0, 5)
    for s in range(3)
)
MAP = """PARKING_AREAS:
  A: {bounds: [[10, 73], [40, 73], [40, 68], [10, 68]], areas: [{shape: [1, 12], coords: null}]}
  B: {bounds: [[10, 61], [40, 61], [40, 50], [10, 50]], areas: [{shape: [2, 12], coords: null}]}
WAYPOINTS:
""" + "".join(
    f"  {name}: {{bounds: [[{x0}, {y0}], [{x1}, {y1}]]}}\n"
    for name, x0, y0, x1, y1 in (
        *((f"R{k}L", 3, y, 20, y) for k, y in enumerate((65, 47, 30, 13), start=1)),
        *((f"R{k}R", 20, y, 45, y) for k, y in enumerate((65, 47, 30, 13), start=1)),
        ("C1", 3, 65, 3, 13), ("C2", 20, 65, 20, 13), ("EXT", 12, 80, 12, 65),
    )
)  # fmt: skip
SCENARIO = """name = "mine"
lot = { grid = { rows = 2, columns = 3, pitch = 2.5 } }
goal = [1.0, 2.0]
forecast = { flat = 0.5 }
sensor_model = { hit_rate = 0.9, false_alarm_rate = 0.1, view_range = 10.0 }
[occupancy]
typical = { pull = 1.0, demand = 0.5 }
event = { share = 0.5, factor = 10.0 }
[arrivals]
hours = "08:00-13:00"
days = ["mon", "tue"]
[costs]
failure_s = 10.0
[traffic]
cars = 2
"""
EXPERIMENT = {
    "kind": "compare",
    "agents": ["mdp", "mdp(failure_s=20)"],
    "scenarios": ["mini", {"name": "x", "lot": "jam", "speeds": {"v_walk_kmh": 3.0}}],
    "episodes": 3,
    "seed": 1,
    "grid": {"failure_s": [10.0, 20.0], "occupancy_levels": [0.5]},
}
MODEL = json.loads((ROOT / "world" / "sensor_models" / "laser.json").read_text())
_HOURS = np.full(168, 1e-4)
PROCESS = json.loads(written(OccupancyProcess(np.ones(3), _HOURS, np.ones(3), _HOURS).to_file))
SUITE = Suite.packaged()
SEARCHES = {"total_s": [100.0] * 3}
RESULT = {
    "format": "parkenv-benchmark-result", "version": 2, "suite": "v3", "suite_sha256": SUITE.fingerprint,
    "commit": "", "by": "", "code": "", "date": "2026-01-01", "sha256": "0" * 64,
    "parkenv": "0.1.0", "command": ["parkenv", "benchmark"], "scores": {"mdp": 0.9},
    "rows": [
        {
            "task": t.name, "agent": "mdp", "episodes": 3, "parked_fraction": 1.0, "total_s": 100.0,
            "total_s_ci95": [90.0, 110.0], "regret_s": 10.0, "regret_s_ci95": [5.0, 15.0], "failed_parks": 0.0,
            "decision_ms": 1.0, "decision_ms_p99": 2.0, "score": 0.9,
        } for t in SUITE.tasks
    ],
    "episodes": {"mdp": {t.name: SEARCHES for t in SUITE.tasks}},
}  # fmt: skip
SUMMARY_ROW = {
    "scenario": "mini",
    "occupancy_level": None,
    "agent": "mdp",
    "failure_cost_s": 10.0,
    "v_walk_kmh": 4.0,
    "v_drive_kmh": 10.0,
    "episodes": 2,
    "parked_fraction": 1.0,
    "truncated_fraction": 0.0,
    "total_s": 50.0,
    "total_s_ci95": [40.0, 60.0],
    "median_s": 50.0,
    "gave_up_fraction": 0.0,
    "leads": True,
    "difference_s": 0.0,
    "difference_s_ci95": [0.0, 0.0],
    "drive_s": 30.0,
    "failed_s": 0.0,
    "walk_s": 20.0,
    "parking_cost_s": 0.0,
    "gave_up_s": 0.0,
    "bound_s": 49.0,
    "failed_parks": 0.0,
    "replans": 1.0,
    "regret_s": 1.0,
    "regret_s_ci95": [0.0, 2.0],
    "decision_ms": 0.1,
    "decision_ms_p99": 0.2,
}
EPISODE_ROWS = (
    "scenario,occupancy_level,agent,failure_cost_s,v_walk_kmh,v_drive_kmh,seed,day,arrival_s,occupancy,slot,parked,truncated,"
    "total_s,drive_s,failed_s,walk_s,parking_cost_s,gave_up_s,bound_s,driven_m,walked_m,failed_parks,slots_passed,replans,steps\n"
    "mini,,mdp,10.0,4.0,10.0,0,mon,3600.0,0.5,A1,True,False,50.0,30.0,0.0,20.0,0.0,0.0,49.0,80.0,20.0,0,3,1,9\n"
    "mini,,mdp,10.0,4.0,10.0,1,tue,3600.0,0.5,A2,True,False,50.0,30.0,0.0,20.0,0.0,0.0,49.0,80.0,20.0,0,3,1,9\n"
)
TIMING_ROWS = (
    "scenario,occupancy_level,agent,failure_cost_s,v_walk_kmh,v_drive_kmh,seed,decisions_us\n"
    "mini,,mdp,10.0,4.0,10.0,0,12 3 4\nmini,,mdp,10.0,4.0,10.0,1,5 6\n"
)
SUMMARY = {
    "command": ["parkenv", "compare", "--episodes", "2"], "version": "0.1.0", "seed": 0,
    "rows": [SUMMARY_ROW, SUMMARY_ROW | {"agent": "random", "total_s": 70.0}],
}  # fmt: skip
SURVEY_SUMMARY = {
    "command": ["parkenv", "survey"], "version": "0.1.0", "seed": 0,
    "rows": [
        {
            "scenario": "mini", "sessions": 1, "slots": 10, "car_detection_rate": 0.6, "slot_accuracy": 1.0,
            "unknown_fraction": 0.0, "range_abs_error_m": {"median": 0.002, "p95": 0.003},
            "by_weather": {"dusk": {"sessions": 1, "car_detection_rate": 0.6, "slot_accuracy": 1.0}},
            "detection_by_distance": [
                {"weather": "dusk", "distance_m": [0.0, 4.0], "in_frame": 2, "detected": 2, "rate_ci95": [0.3, 1.0]}
            ],
        }
    ],
}  # fmt: skip
COMMUTE_ROW = {
    "scenario": "mini", "map": "none", "agent": "first-free", "courses": 1, "total_s": 31.3,
    "total_s_ci95": [None, None], "forecast_error": None, "forecast_error_ci95": [None, None],
}  # fmt: skip
COMMUTE_SUMMARY = {
    "command": ["parkenv", "commute"], "version": "0.1.0", "seed": 0, "complete": True,
    "rows": [COMMUTE_ROW | {"day": 1}], "weeks": [COMMUTE_ROW | {"days": "1-2", "difference_s": 0.0}],
}  # fmt: skip
FLEET_SUMMARY = {
    "command": ["parkenv", "fleet"], "version": "0.1.0", "seed": 0, "complete": True, "stay_s": 3600.0,
    "rows": [
        {
            "scenario": "mini", "agents": "random", "knows": knows, "share": 0.5, "arrivals_per_hour": 20.0, "days": 2,
            "total_s": 70.0, "total_s_ci95": [60.0, 80.0], "occupancy": 0.5, "balked_fraction": 0.1,
            "price_of_anarchy": price, "price_of_anarchy_ci95": [price, price], "others_s": None,
        }
        for knows, price in (("own", 1.1), ("shared", None))
    ],
    "hours": [
        {
            "scenario": "mini", "agents": "random", "knows": "own", "share": 0.0, "arrivals_per_hour": 20.0, "hour": 8,
            "occupancy": 0.5, "counted_occupancy": 0.75, "excess": -0.25, "excess_ci95": [-0.3, -0.2],
        }
    ],
    "blocks": [
        {
            "scenario": "mini", "agents": "random", "knows": "own", "share": 0.0, "arrivals_per_hour": 20.0,
            "block": "Mill Street", "type": "kerb", "zone": "centre", "slots": 10, "price": 2.0, "occupancy": 0.5,
            "parked_a_day": 20.0, "share_parked": 1.0, "refused_a_day": 1.0, "search_s": 30.0, "walk_s": 20.0,
            "cruised_m": None, "paid_a_day": 40.0, "paid_a_car": 2.0,
        }
    ],
    "reach": [
        {"scenario": "mini", "entries": 3, "entries_cut_off": 1}
    ],
    "changes": [
        {
            "change": "knows", "before": "own observations", "after": "a live map for 50 %", "zone": None,
            "purpose": None, "prices": None, "scenario": "mini",
            "agents": "random", "knows": "shared", "share": 0.5, "arrivals_per_hour": 20.0, "days": 2,
            "cars_a_day": 20.0,
        }
        | dict.fromkeys(CHANGES, -0.5) | {f"{name}_ci95": [-0.75, -0.25] for name in CHANGES}
    ],
}  # fmt: skip
DAY = dict.fromkeys((*FleetStudy.table.keys, *FleetStudy.table.columns), "1.5") | {
    "scenario": "mini", "agents": "random", "knows": "own", "day": "0", "cars": "20", "members_s": "nan",
}  # fmt: skip
DAY_ROWS = f"{','.join(DAY)}\n{','.join(DAY.values())}\n"
SESSION_ROWS = f"{','.join(SESSION)}\n{','.join(SESSION.values())}\n"
TRIP = {
    "slots": "observed",
    "seed": 0,
    "agent": "mdp",
    "total_s": 25.0,
    "lanes_s": 5.0,
    "manoeuvre_s": 10.0,
    "costs": {"failed_s": 0.0, "walk_s": 10.0, "parking_cost_s": 0.0, "gave_up_s": 0.0},
    "parked": True,
    "slot": "A1",
    "slot_kind": "perpendicular",
    "graph_m": 10.0,
    "driven_m": 11.0,
    "contacts": 0,
    "strays": 0,
    "rescues": 0,
    "waited_s": 0.0,
    "legs": [],
    "attempts": [],
}
_PIXELS = np.random.default_rng(0).integers(0, 255, (9, 12, 3), dtype=np.uint8)


def image(suffix):
    return cv2.imencode(suffix, _PIXELS[..., 0] if suffix == ".pgm" else _PIXELS)[1].tobytes()


FORMATS = [
    Format(
        "lot.geojson",
        json.loads((ROOT / "lots" / "packaged" / "mini.geojson").read_text()),
        mutated_json,
        lot,
    ),
    Format("map.yml", MAP, mutated_text, lot),
    Format("osm.osm", car_park().xml(), mutated_text, imported),
    Format("overpass.json", json.loads(car_park().overpass(geometry=False)), mutated_json, imported),
    Format("turbo.geojson", json.loads(car_park().geojson()), mutated_json, imported),
    Format(
        "slots.csv",
        "id,x,y,yaw\n"
        + "".join(f"s{i}{j},{2.5 * i},{j},{0.3 * j - 1.57}\n" for i in range(9) for j in (0, 11)),
        mutated_text,
        imported,
    ),
    Format("log.csv", LOG, mutated_text, OccupancyLog.read),
    Format("log.csv.gz", LOG.encode(), mutated_bytes, OccupancyLog.read),
    Format("process.json", PROCESS, mutated_json, OccupancyProcess.from_file),
    Format("model.json", MODEL, mutated_json, sensor_model),
    Format("scenario.toml", SCENARIO, mutated_text, scenario),
    Format("scenario.json", tomllib.loads(SCENARIO), mutated_json, scenario),
    Format("experiment.json", EXPERIMENT, mutated_json, Comparison.read),
    Format(
        "calibrated.json",
        {
            "format": "parkenv-calibration",
            "version": 1,
            "scenario": "mini",
            "v_drive": 2.0,
            "failure_s": 9.0,
            "manoeuvre_s": 8.0,
            "trips": 3,
            "speed_limit": 2.7,
        },
        mutated_json,
        Calibration.from_file,
    ),
    Format("map.sqlite", written(map_file), mutated_bytes, mapped),
    Format(
        "model.npz", (ROOT / "perception" / "models" / "side.npz").read_bytes(), mutated_bytes, CarModel.load
    ),
    Format("image.png", image(".png"), mutated_bytes, read_image),
    Format("image.jpg", image(".jpg"), mutated_bytes, read_image),
    Format("image.pgm", image(".pgm"), mutated_bytes, read_image),
    Format("image.bmp", image(".bmp"), mutated_bytes, read_image),
    Format("image.tif", image(".tiff"), mutated_bytes, read_image),
    Format("image.webp", image(".webp"), mutated_bytes, read_image),
    Format("trueLocations.txt", "0: (-5,30)\n1: (2,3) (4,5)\n", mutated_text, true_locations),
    Format("result.json", RESULT, mutated_json, benchmark),
    Format("summary.json", SUMMARY, mutated_json, reported),
    Format("survey.json", SURVEY_SUMMARY, mutated_json, reported_kind),
    Format("commute.json", COMMUTE_SUMMARY, mutated_json, reported_kind),
    Format("fleet.json", FLEET_SUMMARY, mutated_json, reported_kind),
    Format("days.csv", DAY_ROWS, mutated_text, days),
    Format("sessions.csv", SESSION_ROWS, mutated_text, sessions),
    Format("episodes.csv", EPISODE_ROWS, mutated_text, resumed),
    Format("timings.csv", TIMING_ROWS, mutated_text, resumed),
    Format("settings.json", {"seed": 0, "agents": {"mdp": {"failure_s": 1.0}}}, mutated_json, resumed),
    Format(
        "trips.jsonl",
        json.dumps(TRIP) + "\n" + json.dumps(TRIP | {"seed": 1}) + "\n",
        mutated_text,
        resumed_trips,
    ),
]
BESIDE = {
    "episodes.csv": {"settings.json": '{"seed": 0, "agents": {}}'},
    "timings.csv": {"settings.json": '{"seed": 0, "agents": {}}', "episodes.csv": EPISODE_ROWS},
    "trips.jsonl": {"settings.json": '{"seed": 0}'},
    "summary.json": {"episodes.csv": EPISODE_ROWS},
    "survey.json": {"sessions.csv": SESSION_ROWS},
}
"""Other files that stand in the folder of a file."""


def read(kind, content, folder):
    """Read a file; only an InputError may come out of it, or a word on units."""
    for name, text in BESIDE.get(kind.name, {}).items():
        (folder / name).write_text(text)
    path = folder / kind.name
    path.write_bytes(content)
    with contextlib.suppress(InputError), warnings.catch_warnings():
        # A lot that has lost its `frame` is read, and said to be in metres.
        warnings.filterwarnings("ignore", ".* are taken for metres", UserWarning)
        kind.read(path)


def content_of(kind):
    good = kind.good
    return good if isinstance(good, bytes) else (good if isinstance(good, str) else json.dumps(good)).encode()


@pytest.mark.parametrize("kind", [k for k in FORMATS if k.name not in ("log.csv.gz", "result.json")], ids=str)
def test_the_good_file_is_read(tmp_path, kind):
    for name, text in BESIDE.get(kind.name, {}).items():
        (tmp_path / name).write_text(text)
    (tmp_path / kind.name).write_bytes(content_of(kind))
    kind.read(tmp_path / kind.name)


def read_damaged(kind, count):
    """Read `count` variants, the same ones in every run, from a folder that keeps none of their files."""
    with tempfile.TemporaryDirectory() as folder:
        for number in range(count):
            content = kind.mutated(kind.good, random.Random(f"{kind} {number}"))
            for path in Path(folder).iterdir():
                if path.is_file():
                    path.unlink()
            try:
                read(kind, content, Path(folder))
            except Exception as error:
                error.add_note(f"{kind}, variant {number}: {content[:2000]!r}")
                raise


@pytest.mark.parametrize("kind", FORMATS, ids=str)
def test_damaged_files_are_read_or_refused(kind):
    read_damaged(kind, 15)


FOUND = [
    ("turbo.geojson", b'{"features": [{"properties": {"@id": "way/1", "amenity": "parking_space"}, "geometry": '
     b'{"type": "Polygon", "coordinates": [[[7, 48], [7, 48], [7, 48], [7, 48]]]}}]}'),
    ("summary.json", b'{"command": ["parkenv", "compare"], "version": "0.1.0", "rows": [7]}'),
    ("summary.json", b'{"command": 5, "version": "0.1.0", "rows": []}'),
    ("summary.json", json.dumps(SUMMARY | {"seed": 1e300, "rows": [SUMMARY_ROW | {"drive_s": 1e300}]}).encode()),
    ("summary.json", json.dumps(SUMMARY).replace("30.0", "1e999").encode()),
    ("survey.json", json.dumps(SURVEY_SUMMARY).replace('"dusk", "distance_m"', '"dusk"}, 7, {"distance_m"').encode()),
    ("survey.json", json.dumps(SURVEY_SUMMARY).replace('[{"weather"', '{"weather"').replace("}]}", "}}").encode()),
    ("commute.json", json.dumps(COMMUTE_SUMMARY | {"weeks": [[COMMUTE_ROW]]}).encode()),
    ("sessions.csv", SESSION_ROWS.replace("2 1 0", "seed0 1 0").encode()),
    ("settings.json", json.dumps({"seed": "x" * 5000}).encode()),
    ("timings.csv", TIMING_ROWS.replace("12 3", "12 <").encode()),
    ("timings.csv", TIMING_ROWS.replace("12 3", "12 " + "9" * 400).encode()),
    ("map.yml", b"PARKING_AREAS: {A: {areas: [{shape: [2, 2015-11-12]}]}}"),
    ("experiment.json", json.dumps({"kind": "compare", "agents": ["mdp"], "scenarios": ["x" * 5000]}).encode()),
]  # fmt: skip
"""Variants that were found to end in a traceback, or in pages of text."""


@pytest.mark.parametrize(("name", "content"), FOUND)
def test_what_was_found_is_refused(tmp_path, name, content):
    (kind,) = (k for k in FORMATS if k.name == name)
    read(kind, content, tmp_path)


def test_a_map_whose_schema_is_no_text_is_refused(tmp_path):
    (kind,) = (k for k in FORMATS if k.name == "map.sqlite")
    assert kind.good.count(b"y REAL") == 1
    read(kind, kind.good.replace(b"y REAL", b"y\xffREAL"), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", FORMATS, ids=str)
def test_many_damaged_files_are_read_or_refused(kind):
    read_damaged(kind, 1000)
