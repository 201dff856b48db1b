"""`parkenv occupancy evaluate` and `fit` on counts of car parks."""

import pytest
from car_park_counts import write_counts
from command_line import ran, refused, summary_of

KEYS = ("model", "log_loss", "brier", "crps", "coverage_90", "days", "car_parks")


def write(path, days, fault=False):
    def change(park, day, taken):
        return 1.03 if fault and (park, day) == (1, 2) else taken

    return write_counts(path, days=days, change=change)


@pytest.mark.slow
def test_an_evaluation_has_a_row_and_a_picture_for_each_model(tmp_path):
    counts = write(tmp_path / "counts.csv", 60, fault=True)
    ended = ran("occupancy", "evaluate", counts, "--from", "2024-02-10", "--out", tmp_path / "out")
    summary = summary_of(tmp_path / "out")
    models = [row["model"] for row in summary["rows"]]
    assert models == ["day-curves", "last-four-weekdays", "last-week", "hour-mean", "gradient-boosting"]
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(
        [*(f"{m}.png" for m in models), "summary.json"]
    )
    for row in summary["rows"]:
        assert set(KEYS) <= set(row)
        assert (row["days"], row["car_parks"]) == (20, 2)
        assert sum(band["days"] for band in row["coverage_90_by_band"]) == 40
    assert summary["faults"]["negative"] == summary["faults_by_car_park"]["P1"]["negative"] == 24
    assert "negative 24" in ended.stdout
    chosen = ("--from", "2024-02-10", "--car-parks", "P1")
    again = ran("occupancy", "evaluate", counts, *chosen, "--out", tmp_path / "b")
    assert again.stdout.startswith(("Fit", "1 car park"))
    assert summary_of(tmp_path / "b")["rows"][0]["car_parks"] == 1


@pytest.mark.parametrize(
    ("days", "options"),
    [(1, []), pytest.param(3, ["--from", "2024-01-01"], marks=pytest.mark.slow)],
)
def test_a_short_record_is_no_trouble(tmp_path, days, options):
    counts = write(tmp_path / "counts.csv", days)
    assert not ran("occupancy", "evaluate", counts, *options, "--out", tmp_path / "out").stderr


def test_a_fit_states_day_errors_drift_and_faults(tmp_path):
    counts = write(tmp_path / "counts.csv", 40, fault=True)
    assert not ran("occupancy", "fit", counts, "--out", tmp_path / "out").stderr
    summary = summary_of(tmp_path / "out")
    rows = {row["car_park"]: row for row in summary["rows"]}
    assert {name: row["negative"] for name, row in rows.items()} == {"P0": 0, "P1": 24, "empty": 0}
    assert all(rows[name]["day_error"] == pytest.approx(0.5, abs=0.15) for name in ("P0", "P1"))
    assert 0 < summary["level_drift_per_week"] < 1
    assert summary["typical_week"] is None, "40 days are too few"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--from", "May"], "--from is 'May'"),
        (["--from", "2025-01-01"], "no usable readings"),
        (["--car-parks", "c"], "'c'"),
        (["--timezone", "Mars"], "timezone is 'Mars'"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_line(tmp_path, options, message):
    counts = write(tmp_path / "counts.csv", 2)
    assert message in refused("occupancy", "evaluate", counts, *options, "--out", tmp_path / "out")
