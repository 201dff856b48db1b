"""Calibrate the search environment from driven trips: lane speed, manoeuvre time and cost of a failed attempt.

The drive graph charges an edge's length at `v_drive`, nothing for the manoeuvre into a slot, and `failure_s` for a
failed attempt. This module measures these values in driven trips.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.parking_task import KINDS
from parkenv.errors import ensure
from parkenv.files.known_names import OBSERVED
from parkenv.scenarios.calibration import Calibration
from parkenv.show.figures.picture_files import INK, picture
from parkenv.studies.results import Row
from parkenv.studies.statistics import columns_of, mean_interval
from parkenv.studies.trips.driven_car import EDGE_KINDS, Leg, ParkingAttempt
from parkenv.studies.trips.driven_search import Trip
from parkenv.world.scenario import KMH, Scenario


def trip_row(trip: Trip) -> Row:
    lists = {"legs": list(map(list, trip.legs)), "attempts": list(map(list, trip.attempts))}
    return dataclasses.asdict(trip) | lists


def samples(rows: Sequence[Row], speed: float) -> dict[str, FloatArray]:
    """Return the samples of each measured quantity, in trips with observations but for failed attempts.

    `failed_s` is the time of a failed attempt until the car is back on the lane, `lost_s` the same less the time of the
    onward distance at `speed`, m/s.
    """
    observed = [row for row in rows if row["slots"] == OBSERVED]
    attempts = [ParkingAttempt(*t) for row in rows for t in row["attempts"]]
    failed = [t for t in attempts if t.reason]
    done = [ParkingAttempt(*t) for row in observed for t in row["attempts"] if not t[4]]
    legs = [Leg(*leg) for row in observed for leg in row["legs"]]
    lists: dict[str, list[float]] = {
        "speed_kmh": [
            r["graph_m"] / r["lanes_s"] / KMH
            for r in observed
            if r["lanes_s"] > 0.0 and not r["costs"]["failed_s"]
        ],
        "manoeuvre_s": [t.seconds for t in done],
        **{f"manoeuvre_s.{kind}": [t.seconds for t in done if t.kind == kind] for kind in KINDS},
        "failed_s": [t.seconds for t in failed],
        "lost_s": [t.seconds - t.onward_m / speed for t in failed],
        **{f"failed_s.{kind}": [t.seconds for t in failed if t.kind == kind] for kind in KINDS},
        **{
            f"s_per_m.{kind}": [leg.seconds / leg.graph_m for leg in legs if leg.kind == kind]
            for kind in EDGE_KINDS
        },
    }
    return {name: np.array(values) for name, values in lists.items() if values}


def summary_of(values: FloatArray) -> Row:
    return {
        "n": len(values),
        "median": float(np.median(values)),
        **columns_of("mean", mean_interval(values)),
        "p95": float(np.quantile(values, 0.95)),
    }


def calibrate(rows: Sequence[Row], scenario: Scenario, speed_limit: float) -> tuple[Calibration, list[Row]]:
    """Compute the calibration and one row per distribution.

    The speed is the total distance of trips with observations over their total time, so that drive times on the graph
    are right on average.
    """
    observed = [row for row in rows if row["slots"] == OBSERVED]
    metres = np.array([row["graph_m"] for row in observed])
    seconds = np.array([row["lanes_s"] for row in observed])
    known = samples(rows, speed_limit)
    for name, event in (("manoeuvre_s", "trip has parked"), ("lost_s", "attempt has failed")):
        ensure(name in known, f"of {len(rows)} trips in {scenario.name!r} no {event}: drive more trips")
    speed = float(metres.sum() / seconds.sum())
    table = [{"what": name, **summary_of(values)} for name, values in known.items()]
    ratio = [speed / KMH, speed / KMH]
    if len(observed) > 1 and np.ptp(metres / seconds) > 0.0:
        interval = stats.bootstrap(
            (metres, seconds),
            lambda m, s, axis: m.sum(axis=axis) / s.sum(axis=axis) / KMH,
            paired=True,
            n_resamples=9999,
            vectorized=True,
            method="percentile",
            rng=np.random.default_rng(0),
        ).confidence_interval
        ratio = [float(interval.low), float(interval.high)]
    table.insert(0, {"what": "v_drive_kmh", "n": len(observed), "mean": speed / KMH, "mean_ci95": ratio})
    calibration = Calibration(
        scenario=scenario.name,
        v_drive=speed,
        failure_s=float(known["lost_s"].mean()),
        manoeuvre_s=float(known["manoeuvre_s"].mean()),
        trips=len(observed),
        speed_limit=speed_limit,
    )
    return calibration, table


def save_distributions(rows: Sequence[Row], speed_limit: float, title: str, path: Path) -> None:
    known = samples(rows, speed_limit)
    with picture(path, (10.0, 6.4)) as figure:
        figure.suptitle(title, x=0.02, ha="left", weight="bold")
        axes = figure.subplots(2, 2).ravel()
        panels = (
            ("speed on the lanes, per trip (km/h)", ["speed_kmh"], [""]),
            ("manoeuvre into the slot (s)", [f"manoeuvre_s.{k}" for k in KINDS], list(KINDS)),
            ("failed attempt, until back on the lane (s)", [f"failed_s.{k}" for k in KINDS], list(KINDS)),
        )
        colors = ("#0072b2", "#d55e00", "#009e73")
        for ax, (heading, names, labels) in zip(axes, panels, strict=False):
            shown = [
                (known[n], label, c) for n, label, c in zip(names, labels, colors, strict=False) if n in known
            ]
            ax.set_title(heading)
            if not shown:
                continue
            everything = np.concatenate([values for values, _, _ in shown])
            low, high = float(everything.min()), float(everything.max())
            bins = np.linspace(low - 0.02 * (high - low) - 0.05, high + 0.02 * (high - low) + 0.05, 31)
            for values, label, color in shown:
                ax.hist(values, bins=bins.tolist(), color=color, alpha=0.55, label=label or None)
                ax.axvline(float(values.mean()), color=color, lw=1.4)
                ax.text(
                    float(values.mean()), 1.0, f" {values.mean():.1f}", color=INK, fontsize=8,
                    transform=ax.get_xaxis_transform(), va="top",
                )  # fmt: skip
            ax.set_ylabel("trips" if names == ["speed_kmh"] else "attempts")
            if labels != [""]:
                ax.legend()
        ax = axes[3]
        kinds = [k for k in EDGE_KINDS if f"s_per_m.{k}" in known]
        ax.boxplot([known[f"s_per_m.{k}"] for k in kinds], tick_labels=kinds, whis=(5, 95), showfliers=False)
        ax.axhline(1.0 / speed_limit, color="#d55e00", lw=1.0, ls="--")
        ax.set_title("edges (s/m; dashed: speed limit)")
