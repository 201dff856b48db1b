"""Fit models to recorded occupancy, and score forecasts of it: pictures into a folder, and what a summary holds."""

from collections.abc import Sequence
from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import NamedTuple

import numpy as np

from parkenv.errors import InputError
from parkenv.forecast.comparison import MODELS, Compared, compare
from parkenv.forecast.count_table import listed_faults
from parkenv.forecast.counts import Counts
from parkenv.forecast.day_curves import FIT_STEPS, fit_settings, forecast_days
from parkenv.forecast.slot_comparison import ComparedSlots, compare_slot_days
from parkenv.forecast.typical_week_fit import LEVEL_SHARES, fit_typical_week
from parkenv.show.figures.forecast import save_forecast, save_rates, shown_counts, shown_slots, shown_week
from parkenv.show.tables import plural
from parkenv.studies.results import Row
from parkenv.studies.study import Progress, counted
from parkenv.world.occupancy.fit import fit_process
from parkenv.world.occupancy.log import OccupancyLog, RecordedFile
from parkenv.world.week import DAY_S, HOUR_S


class FitReport(NamedTuple):
    title: str  # name of the data
    summary: Row  # content of `summary.json`; `rows` is its table
    notes: Sequence[str] = ()  # faults of the data, and what the rows leave out


def fit(recorded: RecordedFile, folder: Path, *, max_gap_s: float, progress: Progress) -> FitReport:
    if recorded.is_counts:
        return _fit_counts(recorded.counts(), progress)
    progress("Fitting rates", 0, 0)
    log = recorded.log()
    fitted = fit_process(log, max_gap_s=max_gap_s)
    process = fitted.process
    process.to_file(folder / "process.json")
    save_rates(process, folder / "rates.png", title=recorded.files[0].name)
    rows = [
        {
            "day": name,
            "hour": hour,
            "arrival_rate_per_h": float(process.arrival_profile[24 * day + hour] * 3600.0),
            "departure_rate_per_h": float(process.departure_profile[24 * day + hour] * 3600.0),
            "occupancy": float(np.mean(process.marginal(day * DAY_S + hour * HOUR_S))),
        }
        for name, day in (("weekday", 0), ("weekend", 5))
        for hour in range(7, 19)
    ]
    summary = {"rows": rows, "log_likelihood": fitted.log_likelihood, "intervals": fitted.n_intervals}
    summary |= {"day_error": asdict(process.day_error), **_told_faults(log)}
    name, intervals = recorded.files[0].name, plural(fitted.n_intervals, "interval")
    title = f"{name}: {plural(len(fitted.slot_ids), 'slot')}, {intervals}"
    note = f"Days differ from the process by a standard deviation of {process.day_error.level:.2f} logits"
    return FitReport(title, summary, [*_log_faults(log), note])


def _fit_counts(counts: Counts, progress: Progress) -> FitReport:
    # By how much days of whole car parks differ from their forecasts, and the typical week.
    n = len(counts.days)
    settings = fit_settings(counts, n, counted(progress, "Fit", FIT_STEPS))
    forecast = forecast_days(counts, 0, "rolling", settings, lambda day: progress("Forecast days", day, n))
    rows: list[Row] = []
    for i, name in enumerate(counts.car_parks):
        seen = np.isfinite(counts.occupied[i])
        days = np.flatnonzero(seen.any(axis=1))
        row = {
            "car_park": name,
            "capacity": float(counts.capacity[i, -1]),
            "days": int(days.size),
            "mean_occupancy": float(counts.occupied[i][seen].mean()) if days.size else None,
            "day_error": float(np.median(forecast.level_sd[i, days[-28:]])) if days.size else None,
        }
        rows.append(row | counts.faults[i])
    week = fit_typical_week(counts)
    typical_week = week and {
        "occupied": week.occupied.round(3).tolist(),
        "levels": dict(zip(map(str, LEVEL_SHARES), week.levels.round(3).tolist(), strict=True)),
        "day_error": float(np.nanmedian(week.day_errors).round(3)),
    }
    summary = {
        "rows": rows,
        "idle": counts.idle(),
        "variances": asdict(settings),
        "level_drift_per_week": float(np.sqrt(7 * settings.level_drift)),
        "faults": counts.total_faults(),
        "typical_week": typical_week,
    }
    drift = f"Levels drift by {summary['level_drift_per_week']:.2f} logits a week"
    return FitReport(f"{counts.source}: {plural(n, 'day')}", summary, [*_faults(counts), drift])


def _faults(counts: Counts) -> list[str]:
    faults = ", ".join(f"{name.replace('_', ' ')} {n:,}" for name, n in counts.total_faults().items() if n)
    return [f"Faults: {faults or 'none'}", *(f"{name}: {what}" for name, what in counts.idle().items())]


def evaluate(
    recorded: RecordedFile,
    folder: Path,
    *,
    from_day: date | None,
    car_parks: Sequence[str] | None,
    seed: int,
    progress: Progress,
) -> FitReport:
    if not recorded.is_counts:
        return _evaluate_log(recorded.log(), recorded.files[0], folder, from_day, seed, progress)
    counts = recorded.counts()
    counts = counts if car_parks is None else counts.chosen(list(car_parks))
    n = len(counts.days)
    first = n // 2 if from_day is None else counts.day_index(from_day)
    if not np.isfinite(counts.occupied[:, first:]).any():
        days = f"its {plural(n, 'day')} are {counts.days[0]} to {counts.days[-1]}"
        raise InputError(f"--from is {from_day}: {counts.source} has no usable readings from then on; {days}")
    settings = fit_settings(counts, first, counted(progress, "Fit", FIT_STEPS))
    week = shown_week(counts, first)
    models: list[Compared] = []
    done = counted(progress, "Models", len(MODELS))
    for compared in compare(counts, first, settings, lambda day: progress("Forecast days", day, n)):
        save_forecast(shown_counts(compared, counts, week), folder / f"{compared.model}.png")
        models.append(compared)
        done()
    rows = [_row(compared, models[0], seed) for compared in models]
    summary = {
        "rows": rows,
        "first_day": counts.days[first].isoformat(),
        "faults": counts.total_faults(),
        "faults_by_car_park": dict(zip(counts.car_parks, counts.faults, strict=True)),
        "idle": counts.idle(),
        "variances": asdict(settings),
    }
    return _scored(plural(rows[0]["car_parks"], "car park"), summary, _faults(counts))


def _told_faults(log: OccupancyLog) -> Row:
    return {"faults": dict(log.faults)} if log.faults else {}


def _log_faults(log: OccupancyLog) -> list[str]:
    return [f"Rows corrected or left out: {listed_faults(log.faults)}"] if any(log.faults.values()) else []


def _evaluate_log(
    recorded: OccupancyLog, log: Path, folder: Path, from_day: date | None, seed: int, progress: Progress
) -> FitReport:
    first = recorded.days[len(recorded.days) // 2] if from_day is None else str(from_day)
    classes = [np.flatnonzero(recorded.weekend == weekend) for weekend in (False, True)]
    days = [recorded.slot_days(days) for days in classes if days.size]
    done = counted(progress, "Forecast days", sum(day >= first for day in recorded.days))
    models: Sequence[ComparedSlots] = compare_slot_days(days, date.fromisoformat(first).toordinal(), done)
    if not models:
        there = f"its {plural(len(recorded.days), 'day')} are {', '.join(recorded.days):.60}"
        raise InputError(
            f"--from is {first}: {log} has no day from then on with one of its class before it; {there}"
        )
    for compared in models:
        save_forecast(shown_slots(compared, log.name), folder / f"{compared.model}.png")
    rows = [_row(compared, models[0], seed) for compared in models]
    summary = {"rows": rows, "first_day": first, **_told_faults(recorded)}
    return _scored(plural(len(recorded.slot_ids), "slot"), summary, _log_faults(recorded))


def _scored(what: str, summary: Row, notes: Sequence[str] = ()) -> FitReport:
    days = plural(summary["rows"][0]["days"], "day")
    return FitReport(f"{what}, {days} from {summary['first_day']}", summary, notes)


def _row(compared: Compared | ComparedSlots, ours: Compared | ComparedSlots, seed: int) -> Row:
    scores = compared.scores
    difference = scores.log_loss_beyond(ours.scores, np.random.default_rng(seed))
    return {
        "model": compared.model,
        **scores.means(),
        "difference": difference.value,
        "difference_ci95": [difference.low, difference.high],
        "coverage_90_by_band": scores.coverage_by_band(),
        "coverage_90_by_observed_band": scores.coverage_by_band(observed=True),
    }
