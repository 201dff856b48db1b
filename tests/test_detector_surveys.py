"""Detectors compared on whole survey drives."""

import csv
import json

import numpy as np
import pytest
from command_line import parkenv

from parkenv import InputError
from parkenv.mapping.survey_score import SIGHTING
from parkenv.studies.sensing.detector_surveys import (
    CAUSES,
    causes_of,
    is_wanted,
    never_found,
    read_sightings,
    write_sightings,
)
from parkenv.studies.statistics import rate_interval
from sim_sensors.ground_truth import View


def sighting(**changes):
    usual = {"slot": 3, "distance": 6.0, "visible": 1.0, "view": View.END}
    usual |= {"left": 200, "top": 180, "right": 300, "bottom": 250}
    record = np.zeros(1, SIGHTING)
    for name, value in (usual | changes).items():
        record[name] = value
    return record


@pytest.mark.parametrize(
    ("weather", "changes", "cause"),
    [
        ("rain", {}, "in plain view"),
        ("rain", {"view": View.OBLIQUE}, "oblique"),
        ("dusk", {"view": View.OBLIQUE}, "dusk"),
        ("dusk", {"distance": 13.0}, "far"),
        ("dusk", {"distance": 13.0, "visible": 0.8}, "hidden"),
        ("rain", {"left": 0, "visible": 0.8}, "cut off"),
        ("rain", {"right": 640}, "cut off"),
        ("rain", {"left": 0, "right": 640}, "fills the picture"),
        ("rain", {"bottom": 480}, "fills the picture"),
    ],
)
def test_the_cause_is_the_first_that_holds(weather, changes, cause):
    (found,) = causes_of(sighting(**changes), weather, 640, 480)
    assert list(CAUSES)[found] == cause


def test_a_car_that_is_never_found_counts_by_its_best_picture():
    seen = np.concatenate([
        sighting(slot=1, visible=0.5), sighting(slot=1, left=0),
        sighting(slot=2, boxes=1, placed=1), sighting(slot=2, distance=13.0),
        sighting(slot=4, visible=0.2), sighting(slot=-1),
    ])  # fmt: skip
    causes = causes_of(seen, "rain", 640, 480)
    best = never_found(seen, is_wanted(seen), causes)
    assert [list(CAUSES)[i] for i in best] == ["hidden"]


def test_intervals_are_wider_where_drives_differ():
    alike, apart = rate_interval([8, 8, 8], [10, 10, 10]), rate_interval([10, 9, 5], [10, 10, 10])
    assert alike[0] == apart[0] == pytest.approx(0.8)
    assert apart[2] - apart[1] > alike[2] - alike[1]
    assert rate_interval([24], [30]) == alike
    assert np.isnan(rate_interval([0, 0], [0, 0])).all()
    assert rate_interval([7, 5], [7, 5])[2] == 1.0


def test_sightings_are_read_back_and_checked(tmp_path):
    path = tmp_path / "laser_hog" / "sightings" / "00000.csv"
    path.parent.mkdir(parents=True)
    with pytest.raises(InputError, match=r"00000\.csv: is missing; delete the folder .*laser_hog to drive"):
        read_sightings(path)
    seen = np.concatenate([sighting(), sighting(slot=-1, distance=np.nan)])
    write_sightings(path, seen)
    assert repr(read_sightings(path)) == repr(seen)
    path.write_text(path.read_text().replace("6.0", "near"))
    with pytest.raises(InputError, match=r"line 2: distance is 'near', want a number"):
        read_sightings(path)


@pytest.mark.slow
def test_detectors_on_the_command_line(tmp_path):
    words = (
        "evaluate-detector", "--drives", "mini", "--sessions", 2, "--rig", "laser,stereo", "--detector", "hog,net",
        "--every", 6, "--misses", 2, "--jobs", 1, "--out", tmp_path / "d",
    )  # fmt: skip
    done = parkenv(*words)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "d" / "summary.json").read_text())
    rows = {(r["rig"], r["detector"], r["part"]): r for r in summary["rows"] if r["group"] != "weather"}
    every = [rows[rig, name, "all"] for rig in ("laser", "stereo") for name in ("hog", "net")]
    assert len({row["in_pictures"] for row in every}) == 1, "all look at the same cars"
    for row in every:
        assert 0.0 <= row["cars_low"] <= row["cars_rate"] <= row["cars_high"] <= 1.0
        assert row["slots"] == 20
        assert row["slots_rate"] + row["unknown_rate"] + row["wrong_rate"] == pytest.approx(1.0)
    of_cause = [rows["laser", "hog", cause]["in_pictures"] for cause in CAUSES if cause != "dusk"]
    assert sum(of_cause) <= every[0]["in_pictures"]
    with (tmp_path / "d" / "table.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(summary["rows"])
    pictures = sorted(p.name for p in (tmp_path / "d").glob("*.png"))
    assert pictures == [
        *(f"misses_{r}_{n}.png" for r in ("laser", "stereo") for n in ("hog", "net")),
        "reach_mini.png",
    ]
    kept = (tmp_path / "d" / "table.csv").read_text()
    table = tmp_path / "d" / "sessions.csv"
    table.write_text(
        "".join(table.read_text().splitlines(keepends=True)[:-1])
    )  # as if it had been interrupted
    again = parkenv(*words[:-4], "--jobs", 1, "--out", tmp_path / "d")
    assert again.returncode == 0, again.stderr
    assert (tmp_path / "d" / "table.csv").read_text() == kept


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--drives", "mini", "--rig", "stereo"], "--rig and --misses go with --sessions"),
        (["--uiuc", "x", "--sessions", 2], "--sessions requires --drives"),
        (
            ["--drives", "mini", "--sessions", 1, "--rig", "sonar"],
            "--rig is 'sonar', want 'laser', 'stereo', 'both_sides' or",
        ),
        (["--drives", "mini", "--sessions", 1, "--detector", "hog,none.onnx"], "none.onnx"),
        (["--drives", "nowhere", "--sessions", 1], "unknown scenario 'nowhere'"),
    ],
)
def test_bad_options_are_one_line(tmp_path, words, message):
    bad = parkenv("evaluate-detector", *words, "--out", tmp_path / "d")
    assert (bad.returncode, len(bad.stderr.splitlines())) == (2, 1), bad.stderr
    assert message in bad.stderr
    assert not (tmp_path / "d").exists()
