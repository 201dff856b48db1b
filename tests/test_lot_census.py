"""The census of lots; `test_documents` goes on to a comparison on a town's largest car parks."""

import csv

import pytest
from command_line import parkenv, ran, refused, summary_of
from made_outlines import document, double_row, kerb, row, write

from parkenv.errors import InputError
from parkenv.lots import grid_lot, import_lot, packaged_lot, write_lot
from parkenv.lots.draft import ImportOptions
from parkenv.scenarios.build import largest_lots
from parkenv.scenarios.spec import scenario_specs
from parkenv.studies.lots import COLUMNS, check_drivability, count_lot, lot_columns, lot_files

AUTO = ImportOptions(guess_entry=True, guess_goal=True)


def columns_of(lot):
    return lot_columns(lot, check_drivability(lot))


@pytest.fixture
def lots(tmp_path):
    folder = tmp_path / "lots"
    folder.mkdir()
    for name, lot in (("b", grid_lot(2, 5)), ("a", grid_lot(4, 30)), ("mini", packaged_lot("mini"))):
        write_lot(lot, folder / f"{name}.geojson")
    (folder / "notes.txt").write_text("no lot")
    return folder


@pytest.mark.parametrize(
    ("rows", "kind"),
    [
        (double_row(), "perpendicular"),
        ([row((0.0, 0.0), 0.0, 12, angle_deg=60.0)], "oblique"),
        ([kerb((0.0, 0.0), 0.0, 6), kerb((36.0, -5.5), 180.0, 6)], "kerbside"),
        ([kerb((0.0, 0.0), 0.0, 6), row((30.0, -5.5), 180.0, 10)], "mixed"),
    ],
)
def test_lots_are_of_the_kind_of_their_slots(tmp_path, rows, kind):
    lot = import_lot(write(tmp_path / "made.geojson", document(rows)), AUTO).lot()
    row = columns_of(lot)
    assert (row["kind"], row["slots"]) == (kind, lot.n_slots)
    assert sum(row[name] for name in ("perpendicular", "oblique", "kerbside")) == lot.n_slots


def test_the_drive_is_that_to_the_farthest_slot():
    # 30 slots of 2.5 m, 3 m from the entry, and across the lane.
    assert columns_of(grid_lot(2, 30))["drive_s"] == pytest.approx(79.75 * 0.36, abs=0.06)
    sizes = [columns_of(grid_lot(2, n))["size"] for n in (39, 40, 99, 100)]
    assert sizes == ["small", "medium", "medium", "large"]


def test_a_census_is_a_table_and_pictures(lots, tmp_path):
    out = tmp_path / "census"
    done = ran("lot census --out", out, lots)
    assert "3 lots, 140 slots: 3 clean" in done.stdout
    assert sorted(path.name for path in out.iterdir()) == [
        "census.csv", "census.png", "contact-sheet-1.png", "summary.json",
    ]  # fmt: skip
    rows = summary_of(out)["rows"]
    assert [row["slots"] for row in rows] == [120, 10, 10], "the largest first"
    with (out / "census.csv").open() as file:
        table = list(csv.DictReader(file))
    assert tuple(table[0]) == COLUMNS
    assert [row["file"] for row in table] == [row["file"] for row in rows]
    assert float(table[0]["drive_s"]) == rows[0]["drive_s"]


def test_what_is_no_lot_is_named_and_the_others_are_counted(lots, tmp_path):
    (lots / "broken.geojson").write_text('{"type": "FeatureCollection", "features": [')
    done = parkenv("lot", "census", lots, "--out", tmp_path / "census")
    assert (done.returncode, "3 clean, 1 invalid" in done.stdout) == (2, True)
    rows = summary_of(tmp_path / "census")["rows"]
    assert [row["result"] for row in rows] == ["clean"] * 3 + ["invalid"]
    assert "not JSON" in rows[-1]["reason"]
    assert count_lot(lots / "broken.geojson")[1] is None
    for place, message in ((tmp_path / "none", "no such file or folder"), (tmp_path, "holds no lot")):
        with pytest.raises(InputError, match=message):
            lot_files([place])
        assert message in refused("lot", "census", place)


def test_the_largest_lots_are_chosen(lots):
    specs = scenario_specs(lots)
    assert [spec.title for spec in largest_lots(specs, 2)] == ["a", "b"]
    assert len(largest_lots(specs, 9)) == 3
