"""Tables: a wrong value is refused in a line with file, line, column, value, and what was wanted."""

import csv
import io
import tempfile
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from parkenv import InputError
from parkenv.files import csv_tables
from parkenv.files.csv_tables import TEXT, csv_text, typed_records
from parkenv.studies.training.curve_file import read_curve

EVALUATION = {"steps": "0", "total_s": "80.0", "low_s": "nan", "wall_s": "4.5"}


def write(path, row):
    path.write_text(f"{','.join(row)}\n{','.join(row.values())}\n")
    return path


def test_good_tables_are_read(tmp_path):
    (evaluation,) = read_curve(write(tmp_path / "curve.csv", EVALUATION), ("steps", "total_s"))
    assert (evaluation["steps"], evaluation["total_s"]) == (0, 80.0)
    assert read_curve(tmp_path / "none.csv") == []


NUMBER = "a number, at most 1e+12"


@pytest.mark.parametrize(
    ("column", "value", "wanted"),
    [
        ("steps", "1e5", "a whole number of at most 15 digits"),
        ("total_s", "fast", f"{NUMBER}, or nan"),
    ],
)
def test_a_wrong_value_is_named(tmp_path, column, value, wanted):
    path = write(tmp_path / "table.csv", EVALUATION | {column: value})
    with pytest.raises(InputError) as refused:
        read_curve(path)
    assert str(refused.value) == f"{path}: line 2: {column} is {value!r}, want {wanted}"


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
        rows = [row for _, row in typed_records(file, kinds.__getitem__)]
    assert [row["text"] for row in rows] == texts
    assert all(row["number"] == -1.5 for row in rows)
