"""`parkenv occupancy evaluate` and `fit` on counts of car parks."""

from datetime import date, timedelta

import numpy as np
import pytest
from command_line import parkenv, refused, summary_of
from scipy.special import expit

KEYS = ("model", "log_loss", "brier", "crps", "coverage_90", "days", "car_parks")


def write(path, days, fault=False):
    """Two car parks of 150 places that fill by day; one may report -3 free places for a night."""
    rng = np.random.default_rng(2)
    curve = -1.5 + 2.5 * np.exp(-(((np.arange(24) - 13) / 4.0) ** 2))
    rows = ["car_park,capacity,hour,free"]
    for name in "ab":
        for day in range(days):
            free = 150 - rng.binomial(150, expit(curve + rng.normal(0.0, 0.4)))
            if fault and (name, day) == ("b", 2):
                free[:4] = -3
            rows += [
                f"{name},150,{date(2024, 1, 1) + timedelta(day)}T{h:02d}:00,{n}" for h, n in enumerate(free)
            ]
    path.write_text("\n".join(rows) + "\n")
    return path


@pytest.mark.slow
def test_an_evaluation_has_a_row_and_a_picture_for_each_model(tmp_path):
    counts = write(tmp_path / "counts.csv", 60, fault=True)
    ended = parkenv("occupancy", "evaluate", counts, "--from", "2024-02-10", "--out", tmp_path / "out")
    assert (ended.returncode, ended.stderr) == (0, "")
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
    assert summary["faults"]["negative"] == summary["faults_by_car_park"]["b"]["negative"] == 4
    assert "negative 4" in ended.stdout
    again = parkenv(
        "occupancy", "evaluate", counts, "--from", "2024-02-10", "--car-parks", "b", "--out", tmp_path / "b"
    )
    assert again.stdout.startswith(("Fit", "1 car park"))
    assert summary_of(tmp_path / "b")["rows"][0]["car_parks"] == 1


@pytest.mark.parametrize(
    ("days", "options"),
    [
        (1, []),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in ((3, ["--from", "2024-01-01"]), (10, []))),
    ],
)
def test_a_short_record_is_no_trouble(tmp_path, days, options):
    counts = write(tmp_path / "counts.csv", days)
    ended = parkenv("occupancy", "evaluate", counts, *options, "--out", tmp_path / "out")
    assert (ended.returncode, ended.stderr) == (0, "")


def test_a_fit_states_day_errors_drift_and_faults(tmp_path):
    counts = write(tmp_path / "counts.csv", 60, fault=True)
    ended = parkenv("occupancy", "fit", counts, "--out", tmp_path / "out")
    assert (ended.returncode, ended.stderr) == (0, "")
    summary = summary_of(tmp_path / "out")
    assert [row["car_park"] for row in summary["rows"]] == ["a", "b"]
    assert [row["negative"] for row in summary["rows"]] == [0, 4]
    assert all(row["day_error"] == pytest.approx(0.4, abs=0.15) for row in summary["rows"])
    assert 0 < summary["level_drift_per_week"] < 1
    assert summary["typical_week"] is None, "60 days are too few"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--from", "May"], "--from is 'May', want a date such as 2015-11-20"),
        (["--from", "2025-01-01"], "has no usable readings from then on"),
        (["--car-parks", "c"], "has no car park 'c'"),
        (["--timezone", "Mars"], "timezone is 'Mars', want an IANA name"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_line(tmp_path, options, message):
    counts = write(tmp_path / "counts.csv", 2)
    assert message in refused("occupancy", "evaluate", counts, *options, "--out", tmp_path / "out")


def test_counts_as_a_log_of_slots_are_refused(tmp_path):
    counts = write(tmp_path / "counts.csv", 2)
    said = refused("compare", "--scenario", "mini", "--occupancy", counts, "--out", tmp_path / "out")
    assert "has counts of car parks, want --car-park with it" in said
