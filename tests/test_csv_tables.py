"""Tables of run folders: a wrong value is refused in a line with file, line, column, value, and what was wanted."""

import csv
import io
import tempfile
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from parkenv import InputError
from parkenv.files import csv_tables
from parkenv.files.csv_tables import TEXT, csv_text, typed_records
from parkenv.studies.results import EPISODES
from parkenv.studies.sensing.sessions import ERROR_COLUMNS, SESSIONS
from parkenv.studies.sensing.surveys import detection_by_distance
from parkenv.studies.training.curve_file import read_curve

SESSION = {
    "key": "mini/laser/any/10m/0m0rad/seed0/00000", "weather": "dusk", "time_s": "291974.3", "parked": "5",
    "found": "3", "detections": "5", "right": "4", **dict.fromkeys(ERROR_COLUMNS, "nan"),
    **{f"thesis_{name}": "0.01" for name in ERROR_COLUMNS}, "slot_accuracy": "1.0", "slot_accuracy_seen": "1.0",
    "unknown_fraction": "0.0", "occupied_fraction": "0.5", "seconds_per_frame": "0.05",
    "cars_in_frame": "2 1 0 0 0 0", "cars_detected": "2 0 0 0 0 0",
    "odometry_error_m": "1.5", "pose_error_m": "0.1", "pose_error_max_m": "0.2",
    "within_1_std": "0.7", "within_2_std": "nan",
}  # fmt: skip
EPISODE = {
    "scenario": "mini", "occupancy_level": "", "agent": "mdp", "failure_cost_s": "10.0", "v_walk_kmh": "4.0",
    "v_drive_kmh": "10.0", "seed": "0", "day": "", "arrival_s": "3600.0", "occupancy": "0.5", "slot": "A1",
    "parked": "True", "truncated": "False", "total_s": "50.0", "drive_s": "30.0", "failed_s": "0.0", "walk_s": "20.0",
    "parking_cost_s": "0.0", "gave_up_s": "0.0", "bound_s": "49.0", "driven_m": "80.0", "walked_m": "20.0",
    "failed_parks": "0", "slots_passed": "3", "replans": "1", "steps": "9",
}  # fmt: skip
EVALUATION = {"steps": "0", "total_s": "80.0", "low_s": "nan", "wall_s": "4.5"}


def write(path, row):
    path.write_text(f"{','.join(row)}\n{','.join(row.values())}\n")
    return path


def read_sessions(path):
    return replace(SESSIONS, file=path.name).read(path.parent)


def read_rows(path):
    return replace(EPISODES, file=path.name, lists=None).read(path.parent)


def test_good_tables_are_read(tmp_path):
    (session,) = read_sessions(write(tmp_path / "sessions.csv", SESSION))
    assert (session["parked"], session["slot_accuracy"]) == (5, 1.0)
    assert session["place_error_m"] != session["place_error_m"]
    assert [row["detected"] for row in detection_by_distance([session])] == [2, 0]
    (episode,) = read_rows(write(tmp_path / "episodes.csv", EPISODE))
    assert (episode["occupancy_level"], episode["parked"], episode["steps"]) == (None, True, 9)
    (evaluation,) = read_curve(write(tmp_path / "curve.csv", EVALUATION), ("steps", "total_s"))
    assert (evaluation["steps"], evaluation["total_s"]) == (0, 80.0)
    assert read_sessions(tmp_path / "none.csv") == read_rows(tmp_path / "none.csv") == []


NUMBER = "a number, at most 1e+12"


@pytest.mark.parametrize(
    ("read", "good", "column", "value", "wanted"),
    [
        (read_sessions, SESSION, "cars_in_frame", "2 1 seed0 0 0 0", "6 whole numbers separated by spaces"),
        (read_sessions, SESSION, "cars_detected", "}", "6 whole numbers separated by spaces"),
        (read_sessions, SESSION, "cars_detected", "2 0 0 0 0", "6 whole numbers separated by spaces"),
        (read_sessions, SESSION, "cars_detected", "3 0 0 0 0 0", "at most cars_in_frame, '2 1 0 0 0 0'"),
        (read_sessions, SESSION, "parked", "-5", "a whole number of at most 15 digits"),
        (read_sessions, SESSION, "found", "9" * 20, "a whole number of at most 15 digits"),
        (read_sessions, SESSION, "slot_accuracy", "", f"{NUMBER}, or nan"),
        (read_sessions, SESSION, "time_s", "1e300", f"{NUMBER}, or nan"),
        (read_rows, EPISODE, "truncated", "yes", "True or False"),
        (read_rows, EPISODE, "total_s", "nan", NUMBER),
        (read_rows, EPISODE, "total_s", "", NUMBER),
        (read_rows, EPISODE, "occupancy_level", "full", f"{NUMBER}, or nothing"),
        (read_rows, EPISODE, "seed", "1.5", "a whole number of at most 15 digits"),
        (read_curve, EVALUATION, "steps", "1e5", "a whole number of at most 15 digits"),
        (read_curve, EVALUATION, "total_s", "fast", f"{NUMBER}, or nan"),
    ],
)
def test_a_wrong_value_is_named(tmp_path, read, good, column, value, wanted):
    path = write(tmp_path / "table.csv", good | {column: value})
    with pytest.raises(InputError) as refused:
        read(path)
    assert str(refused.value) == f"{path}: line 2: {column} is {value!r}, want {wanted}"


def test_tables_of_other_versions_are_refused(tmp_path):
    for read, good in ((read_sessions, SESSION), (read_rows, EPISODE)):
        with pytest.raises(InputError, match="not written by this version of parkenv; use another folder"):
            read(write(tmp_path / "table.csv", good | {"more": "1"}))


@given(st.lists(st.text(st.characters(blacklist_categories=["Cs"], blacklist_characters="\0")), min_size=1))
@example(["=1+1", "'=1+1", "''=1", "+A1", "-cmd", "@x", "-5", "+1e3", "'quoted'", "", "\tx", "\rx", "a=1"])
def test_texts_are_no_formulas_in_spreadsheets_and_are_read_as_they_were(texts):
    table = csv_text(["text", "number"], [{"text": text, "number": -1.5} for text in texts], header=True)
    for cell, number in list(csv.reader(io.StringIO(table, newline="")))[1:]:
        assert number == "-1.5"
        if cell.startswith(("=", "+", "-", "@", "\t", "\r")):
            float(cell)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "table.csv"
        file.write_bytes(table.encode())
        kinds = {"text": TEXT, "number": csv_tables.NUMBER}
        rows = [row for _, row in typed_records(file, kinds.__getitem__, whole_lines=True)]
    assert [row["text"] for row in rows] == texts
    assert all(row["number"] == -1.5 for row in rows)
