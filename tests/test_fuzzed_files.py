"""Damaged and hostile variants of each kind of file are read, or refused by one `InputError`."""

import contextlib
import json
import random
import re
import shutil
import tempfile
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from file_mutations import mutated_bytes, mutated_json, mutated_text
from lot_checks import refusal
from made_maps import car_park

from parkenv import InputError, OccupancyLog, OccupancyProcess, SensorModel, make_scenario
from parkenv.driving.scene_files import read_scene
from parkenv.files.images import read_image
from parkenv.files.limited_reading import read_json, read_toml, read_yaml
from parkenv.files.tracks import read_track
from parkenv.forecast.counts import Counts
from parkenv.lots import check_lot, import_lot, packaged_lot, read_lot, write_lot
from parkenv.lots.draft import ImportOptions
from parkenv.mapping.store import MapStore, Session
from parkenv.perception.car_datasets import read_uiuc_test
from parkenv.perception.car_model import CarModel
from parkenv.scenarios.calibration import Calibration
from parkenv.show.report.page import write_page
from parkenv.studies.benchmark.suite import Suite, check_result
from parkenv.studies.compare.comparison import Comparison
from parkenv.studies.report import RunFolder
from parkenv.studies.results import DECISIONS, EPISODES, Results, decision_s
from parkenv.studies.study import read_study
from parkenv.studies.training.curve_file import read_curve
from parkenv.world.occupancy.recorded import read_mapping

MINI = packaged_lot("mini")
ROOT = Path(__file__).parents[1] / "parkenv"


class Format(NamedTuple):
    """A kind of file: good content, damaged variants of it, and all that reads it."""

    good: Any
    mutated: Callable[[Any, random.Random], bytes]
    read: Callable[[Path], object]


def written(write, suffix=""):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"file{suffix}"
        write(path)
        return path.read_bytes()


def lot(path):
    assert all("\n" not in p.message for p in check_lot(path))
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


def stored(path):
    """The store of a run with two searches."""
    with Results(path.parent) as results:
        results.begin({}, continues=False)
        row = dict.fromkeys((*EPISODES.keys, *EPISODES.columns), 1.5) | {DECISIONS: "12 3"}
        results.add([row, row | {"seed": 2}])
    (path.parent / "results.sqlite").rename(path)


def resumed(path):
    folder = Results(path.parent)
    folder.claim({"seed": 0, "agents": {}}, resume=True)
    for row in folder.rows().values():
        decision_s(row)


def reported(path):
    write_page(RunFolder.read(path.parent).data(), path.with_name("report.html"))


def reported_kind(path):
    """Report on a summary whose file is named after its command."""
    shutil.copy(path, path.with_name("summary.json"))
    reported(path.with_name("summary.json"))


def true_locations(path):
    (path.parent / "TestImages").mkdir(exist_ok=True)
    for number in range(2):
        (path.parent / "TestImages" / f"test-{number}.pgm").write_bytes(image(".pgm"))
    read_uiuc_test(path.parent, "single")


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
GOOD = json.loads(Path(__file__).with_name("good_files.json").read_text(encoding="utf-8"))
SUMMARY = GOOD["summary.json"]
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
_PIXELS = np.random.default_rng(0).integers(0, 255, (9, 12, 3), dtype=np.uint8)


def image(suffix):
    return cv2.imencode(suffix, _PIXELS[..., 0] if suffix == ".pgm" else _PIXELS)[1].tobytes()


FORMATS = {
    "lot.geojson": Format(json.loads((ROOT / "lots/packaged/mini.geojson").read_text()), mutated_json, lot),
    "map.yml": Format(MAP, mutated_text, lot),
    "osm.osm": Format(car_park().xml(), mutated_text, imported),
    "turbo.geojson": Format(json.loads(car_park().geojson()), mutated_json, imported),
    "log.csv": Format(LOG, mutated_text, OccupancyLog.read),
    "log.csv.gz": Format(LOG.encode(), mutated_bytes, OccupancyLog.read),
    "process.json": Format(PROCESS, mutated_json, OccupancyProcess.from_file),
    "model.json": Format(MODEL, mutated_json, sensor_model),
    "scenario.toml": Format(SCENARIO, mutated_text, make_scenario),
    "scenario.json": Format(tomllib.loads(SCENARIO), mutated_json, make_scenario),
    "experiment.json": Format(GOOD["experiment.json"], mutated_json, Comparison.read),
    "calibrated.json": Format(GOOD["calibrated.json"], mutated_json, Calibration.from_file),
    "map.sqlite": Format(written(map_file), mutated_bytes, mapped),
    "model.npz": Format((ROOT / "perception/models/side.npz").read_bytes(), mutated_bytes, CarModel.load),
    "trueLocations.txt": Format("0: (-5,30)\n1: (2,3) (4,5)\n", mutated_text, true_locations),
    "result.json": Format(RESULT, mutated_json, check_result),
    "summary.json": Format(SUMMARY, mutated_json, reported),
    "fleet.json": Format(GOOD["fleet.json"], mutated_json, reported_kind),
    "results.sqlite": Format(written(stored), mutated_bytes, resumed),
    "settings.json": Format({"seed": 0, "agents": {"mdp": {"failure_s": 1.0}}}, mutated_json, resumed),
} | {
    f"image{end}": Format(image(end), mutated_bytes, read_image)
    for end in (".png", ".jpg", ".pgm", ".bmp", ".webp")
}


def read(name, content, folder):
    if name == "results.sqlite":
        (folder / "settings.json").write_text('{"seed": 0, "agents": {}}')
    (folder / name).write_bytes(content)
    FORMATS[name].read(folder / name)


def read_or_refuse(name, content, folder):
    """Read a file; only an InputError may come out of it."""
    with contextlib.suppress(InputError):
        read(name, content, folder)


@pytest.mark.parametrize("name", [name for name in FORMATS if name not in ("log.csv.gz", "result.json")])
def test_the_good_file_is_read(tmp_path, name):
    good = FORMATS[name].good
    text = good if isinstance(good, str | bytes) else json.dumps(good)
    read(name, text.encode() if isinstance(text, str) else text, tmp_path)


@pytest.mark.parametrize("count", [15, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_are_read_or_refused(name, count):
    """The same variants in every run, in a folder that keeps none of their files."""
    for number in range(count):
        content = FORMATS[name].mutated(FORMATS[name].good, random.Random(f"{name} {number}"))
        with tempfile.TemporaryDirectory() as folder:
            try:
                read_or_refuse(name, content, Path(folder))
            except Exception as error:
                error.add_note(f"{name}, variant {number}: {content[:2000]!r}")
                raise


FOUND = [
    ("turbo.geojson", b'{"features": [{"properties": {"@id": "way/1", "amenity": "parking_space"}, "geometry": '
     b'{"type": "Polygon", "coordinates": [[[7, 48], [7, 48], [7, 48], [7, 48]]]}}]}'),
    ("summary.json", b'{"command": ["parkenv", "compare"], "version": "0.1.0", "rows": [7]}'),
    ("summary.json", b'{"command": 5, "version": "0.1.0", "rows": []}'),
    ("summary.json", json.dumps(SUMMARY | {"seed": 1e300, "rows": [SUMMARY["rows"][0] | {"drive_s": 1e300}]}).encode()),
    ("summary.json", json.dumps(SUMMARY).replace("30.0", "1e999").encode()),
    ("settings.json", json.dumps({"seed": "x" * 5000}).encode()),
    ("map.yml", b"PARKING_AREAS: {A: {areas: [{shape: [2, 2015-11-12]}]}}"),
    ("experiment.json", json.dumps({"kind": "compare", "agents": ["mdp"], "scenarios": ["x" * 5000]}).encode()),
]  # fmt: skip
"""Variants that were found to end in a traceback, or in pages of text."""


@pytest.mark.parametrize(("name", "content"), FOUND)
def test_what_was_found_is_refused(tmp_path, name, content):
    read_or_refuse(name, content, tmp_path)


def test_a_map_whose_schema_is_no_text_is_refused(tmp_path):
    good = FORMATS["map.sqlite"].good
    assert good.count(b"key TEXT") == 1
    read_or_refuse("map.sqlite", good.replace(b"key TEXT", b"k\xffy TEXT"), tmp_path)


BAD = json.loads(Path(__file__).with_name("bad_files.json").read_text(encoding="utf-8"))
"""Names and texts of files that are refused, and what is said of each; `…` stands for any words."""
READERS = {
    "scenario.toml": make_scenario,
    "experiment.toml": lambda path: read_study(path).check(),
    "counts.csv": Counts.read,
    "map.yml": read_lot,
    "file.json": read_json,
    "file.toml": read_toml,
    "log.csv": OccupancyLog.read,
    "mapping.csv": lambda path: read_mapping(path, ["A", "B"], ("s0", "s1", "s2", "s3"), "the log"),
    "sight.json": SensorModel.from_file,
    "calibrated.json": Calibration.from_file,
    "curve.csv": read_curve,
    "file.yml": read_yaml,
    "track.gpx": read_track,
    "poses.csv": read_track,
    **dict.fromkeys(("scene.csv", "scene.json", "scene.toml"), read_scene),
}


@pytest.mark.parametrize(("name", "text", "said"), BAD)
def test_bad_files_are_refused_in_a_line_with_what_was_wanted(tmp_path, name, text, said):
    path = tmp_path / name
    path.write_text(text)
    (tmp_path / "own.toml").write_text('lot = "mini"\ncosts = { failre_s = 5 }\n')
    line = refusal(READERS[name], path)
    assert line.startswith(f"{path}: ") or name == "experiment.toml"
    assert len(line) < 500
    assert re.search(".*".join(map(re.escape, said.split(" … "))), line)
    if name == "map.yml":
        assert "error" in {problem.severity for problem in check_lot(path)}
