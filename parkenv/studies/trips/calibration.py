"""Calibrate the search environment from driven trips: lane speed, manoeuvre time and cost of a failed attempt.

The drive graph charges an edge's length at `v_drive`, nothing for the manoeuvre into a slot, and `failure_s` for a
failed attempt. This module measures these values in driven trips.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from pydantic import TypeAdapter
from scipy import stats

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.parking_task import KINDS
from parkenv.errors import InputError
from parkenv.files.atomic_write import append_text, atomic_write
from parkenv.files.limited_reading import parse_json, read_text
from parkenv.scenarios.blind import blind_scenario
from parkenv.scenarios.calibration import Calibration
from parkenv.show.figures.picture_files import INK, STYLE, save_picture
from parkenv.studies.results import require_same_settings, write_settings
from parkenv.studies.statistics import mean_interval
from parkenv.studies.trips.driven_search import DrivenSearch, Trip
from parkenv.studies.trips.executor import EDGE_KINDS, Leg, ParkingAttempt
from parkenv.studies.trips.vehicle_controller import DrivingStyle
from parkenv.studies.workers import HERE, Workers
from parkenv.world.scenario import KMH, Scenario

Row = dict[str, Any]

OBSERVED, UNOBSERVED = "observed", "unobserved"  # whether the agent observes slots from the lane
BLOCK = 5  # trips per task
_TRIP = TypeAdapter(Trip)


@dataclass(frozen=True, eq=False)
class TripPlan:
    """Which trips to drive."""

    scenario: Scenario
    agent: str
    style: DrivingStyle  # driving style
    rig: str | None = None  # name of the sensor rig; None for the scenario's sensor model
    detector: str | None = None  # the rig's detector; None for the scenario's

    def run(self, slots: str, seeds: Sequence[int]) -> list[Row]:
        """Drive the trips; return the `trip_row` of each."""
        scenario, rig = (
            (self.scenario, self.rig) if slots == OBSERVED else (blind_scenario(self.scenario), None)
        )
        search = DrivenSearch(scenario, self.agent, style=self.style, rig=rig, detector=self.detector)
        return [trip_row(search.run(seed), slots) for seed in seeds]


def trip_row(trip: Trip, slots: str) -> Row:
    """Return a trip as JSON data; `slots` is `OBSERVED` or `UNOBSERVED`."""
    row = dataclasses.asdict(trip)
    return {
        "slots": slots,
        **row,
        "legs": [list(leg) for leg in trip.legs],
        "attempts": [list(t) for t in trip.attempts],
    }


class TripFolder:
    """The file of trips, with one line per finished trip.

    Args:
        path: an existing folder.
        settings: everything that affects the outcome of a trip.
        resume: continue an earlier run.

    Attributes:
        rows: finished trips by (slots, seed).

    Raises:
        InputError: the folder holds trips and `resume` is not set, or their settings differ.
    """

    def __init__(self, path: Path, settings: Row, *, resume: bool = False) -> None:
        self._file = path / "trips.jsonl"
        self.rows: dict[tuple[str, int], Row] = {}
        if self._file.exists():
            if not resume:
                raise InputError(
                    f"--out {path}: holds trips; add --resume to continue, or name another folder"
                )
            require_same_settings(path, settings, "trips")
            whole, _, _ = read_text(self._file).rpartition("\n")
            for number, line in enumerate(whole.splitlines(), start=1):
                row = parse_json(line, f"{self._file}: line {number}")
                try:
                    slots = row.pop("slots")
                    row = {"slots": slots, **dataclasses.asdict(_TRIP.validate_python(row))}
                    if slots not in (OBSERVED, UNOBSERVED):
                        raise ValueError(slots)
                except (AttributeError, KeyError, TypeError, ValueError) as error:
                    raise InputError(f"{self._file}: line {number}: {line!r:.40} is no trip") from error
                self.rows[row["slots"], row["seed"]] = row
        write_settings(path, settings)
        self.put_in_order()

    def add(self, rows: Sequence[Row]) -> None:
        """Append finished trips."""
        append_text(self._file, "".join(json.dumps(row) + "\n" for row in rows))
        self.rows |= {(row["slots"], row["seed"]): row for row in rows}

    def put_in_order(self) -> None:
        """Sort the file by slots and seed."""
        with atomic_write(self._file) as beside:
            beside.write_text(
                "".join(json.dumps(row) + "\n" for _, row in sorted(self.rows.items())), encoding="utf-8"
            )


def drive_trips(
    plan: TripPlan,
    seeds: Sequence[int],
    folder: TripFolder,
    workers: Workers = HERE,
    on_progress: Callable[[int], None] = lambda _: None,
) -> list[Row]:
    """Drive the missing trips, each seed with and without slot observations; return all rows in order.

    Agents that observe slots hardly ever attempt a taken one; trips without observations provide failed attempts.
    """
    tasks = [
        partial(plan.run, slots, block)
        for slots in (OBSERVED, UNOBSERVED)
        for block in _blocks([s for s in seeds if (slots, s) not in folder.rows])
    ]
    wanted = [(slots, seed) for slots in (OBSERVED, UNOBSERVED) for seed in seeds]
    on_progress(sum(key in folder.rows for key in wanted))
    for _, rows in workers.results(tasks):
        folder.add(rows)
        on_progress(len(rows))
    folder.put_in_order()
    return [folder.rows[key] for key in wanted]


def _blocks(seeds: Sequence[int]) -> Iterator[Sequence[int]]:
    for i in range(0, len(seeds), BLOCK):
        yield seeds[i : i + BLOCK]


def samples(rows: Sequence[Row], speed: float) -> dict[str, FloatArray]:
    """Collect the samples of each measured quantity.

    Args:
        rows: rows of trips.
        speed: speed on the lanes, m/s; converts the onward distance of a failed attempt into time.

    Returns:
        From trips with observations: `speed_kmh` on the lanes, and `manoeuvre_s`, also by kind of slot.
        `failed_s`, also by kind of slot: time of a failed attempt until the car is back on the lane. `lost_s`: the
        same, less the time of the onward distance. `s_per_m` by kind of edge.
    """
    observed = [row for row in rows if row["slots"] == OBSERVED]
    attempts = [ParkingAttempt(*t) for row in rows for t in row["attempts"]]
    failed = [t for t in attempts if t.reason]
    done = [ParkingAttempt(*t) for row in observed for t in row["attempts"] if not t[4]]
    legs = [Leg(*leg) for row in observed for leg in row["legs"]]
    lists: dict[str, list[float]] = {
        "speed_kmh": [
            r["graph_m"] / r["lanes_s"] / KMH for r in observed if r["lanes_s"] > 0.0 and not r["failed_s"]
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
    """Return median, mean with its 95 % interval, and 95th percentile of a sample."""
    mean, low, high = mean_interval(values)
    return {
        "n": len(values),
        "median": float(np.median(values)),
        "mean": mean,
        "mean_ci95": [low, high],
        "p95": float(np.quantile(values, 0.95)),
    }


def calibrate(rows: Sequence[Row], scenario: Scenario, speed_limit: float) -> tuple[Calibration, list[Row]]:
    """Compute the calibration and one row per distribution.

    The speed is the total distance of trips with observations over their total time, so that drive times on the graph
    are right on average.

    Raises:
        InputError: no trip ended parked, or no attempt failed.
    """
    observed = [row for row in rows if row["slots"] == OBSERVED]
    metres = np.array([row["graph_m"] for row in observed])
    seconds = np.array([row["lanes_s"] for row in observed])
    known = samples(rows, speed_limit)
    for name, event in (("manoeuvre_s", "trip has parked"), ("lost_s", "attempt has failed")):
        if name not in known:
            raise InputError(f"of {len(rows)} trips in {scenario.name!r} no {event}: drive more trips")
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
    made = Calibration(
        scenario=scenario.name,
        v_drive=speed,
        failure_s=float(known["lost_s"].mean()),
        manoeuvre_s=float(known["manoeuvre_s"].mean()),
        trips=len(observed),
        speed_limit=speed_limit,
    )
    return made, table


def save_distributions(rows: Sequence[Row], speed_limit: float, title: str, path: Path) -> None:
    """Draw the distributions: speed, manoeuvres and failed attempts by kind of slot, edges by kind."""
    known = samples(rows, speed_limit)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10.0, 6.4), layout="constrained")
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
        save_picture(figure, path)
