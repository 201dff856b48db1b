"""`parkenv occupancy`: fit models to recorded occupancy, and score their forecasts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.cli.arguments import iso_date, words
from parkenv.cli.command import add, group
from parkenv.cli.tables import make_console, make_table, progress_bar, save_summary
from parkenv.errors import InputError
from parkenv.show.plurals import plural

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.forecast.comparison import Compared
    from parkenv.forecast.counts import Counts
    from parkenv.forecast.slot_comparison import ComparedSlots

Row = dict[str, Any]
TIMEZONE = "Europe/Berlin"


def fit(
    log: Path, /, max_gap_h: float = 2.0, timezone: str = TIMEZONE, out: Path = Path("results/occupancy")
) -> None:
    """Fit a model to recorded occupancy by maximum likelihood.

    A log of slots: arrival and departure rates. Every slot is a two-state Markov chain. Its rates depend on the hour,
    separately for weekdays and weekends, and on a factor per slot. The log shows a slot only at single times; the
    likelihood covers all possible changes in between. Days differ from these rates by the day error, which is estimated
    along. Use the result, process.json, as --occupancy of `parkenv
    compare`: unchanged on a lot with the same number of slots, on any other lot with the fullest slots nearest to the
    goal.

    Counts of whole car parks: by how much days differ from their forecasts, which readings are faulty, and the week of
    the car park of median level.

    Examples:
        parkenv occupancy fit CNR-EXT.csv.gz --out results/pisa
        parkenv compare --occupancy results/pisa/process.json
        parkenv occupancy fit car_parks.csv.gz --out results/car-parks

    Options:
        log (FILE): A log, datetime,camera,slot_id,weather,occupied, or counts, car_park,capacity,hour,free (or
            hour_utc), as .csv or .csv.gz.
        max_gap_h (H >= 0): Observations of a log farther apart than this, h, are not linked.
        timezone (NAME): Local time of counts with hour_utc.
        out, -o (DIR): Folder for summary.json and, of a log, process.json and rates.png.
    """
    from parkenv.files.atomic_write import make_folder
    from parkenv.forecast.counts import Counts, is_counts

    make_folder(out)
    console = make_console()
    if is_counts(log):
        _fit_counts(Counts.read(log, timezone), out, console)
    else:
        _fit_log(log, max_gap_h, out, console)


def _fit_log(log: Path, max_gap_h: float, out: Path, console: Console) -> None:
    from dataclasses import asdict

    import numpy as np

    from parkenv.show.figures.rates import save_rates
    from parkenv.world.occupancy.fit import fit_process
    from parkenv.world.occupancy.log import OccupancyLog
    from parkenv.world.week import DAY_S, HOUR_S

    record = OccupancyLog.read(log)
    with console.status("Fitting rates"):
        fitted = fit_process(record, max_gap_s=3600.0 * max_gap_h)
    process = fitted.process
    process.to_file(out / "process.json")
    save_rates(process, out / "rates.png", title=log.name)

    def mean_rate(profile: str, day: int, hour: int) -> float:
        return float(getattr(process, f"{profile}_profile")[24 * day + hour] * 3600.0)

    rows, cells = [], []
    for name, day in (("weekday", 0), ("weekend", 5)):
        for hour in range(7, 19):
            occupied = float(np.mean(process.marginal(day * DAY_S + hour * HOUR_S)))
            arrive, leave = mean_rate("arrival", day, hour), mean_rate("departure", day, hour)
            rows.append(
                {
                    "day": name, "hour": hour, "arrival_rate_per_h": arrive, "departure_rate_per_h": leave,
                    "occupancy": occupied,
                }
            )  # fmt: skip
            cells.append((name, f"{hour:02d}", f"{arrive:.3f}", f"{leave:.3f}", f"{occupied:.0%}"))
    counts = {"log_likelihood": fitted.log_likelihood, "intervals": fitted.n_intervals}
    save_summary(out, None, rows, **counts, day_error=asdict(process.day_error))
    title = f"{log.name}: {len(fitted.slot_ids)} slots, {fitted.n_intervals} intervals"
    headings = ("day", "hour", "arrivals an hour", "departures an hour", "occupied")
    console.print(make_table(title, headings, cells))
    console.print(
        f"Days differ from the process by a standard deviation of {process.day_error.level:.2f} logits"
    )
    console.print(f"Process, picture and summary are in {out}")


def _fit_counts(counts: Counts, out: Path, console: Console) -> None:
    from dataclasses import asdict

    import numpy as np

    from parkenv.forecast.day_curves import FIT_STEPS, fit_settings, forecast_days
    from parkenv.forecast.typical_week_fit import LEVEL_SHARES, fit_typical_week

    n = len(counts.days)
    with progress_bar(console) as progress:
        steps, days = progress.add_task("Fit", total=FIT_STEPS), progress.add_task("Forecast days", total=n)
        settings = fit_settings(counts, n, lambda: progress.advance(steps))
        forecast = forecast_days(
            counts, 0, "rolling", settings, lambda day: progress.update(days, completed=day)
        )
    rows, cells = [], []
    for i, name in enumerate(counts.car_parks):
        seen = np.isfinite(counts.occupied[i])
        counted = np.flatnonzero(seen.any(axis=1))
        row = {
            "car_park": name,
            "capacity": float(counts.capacity[i, -1]),
            "days": int(counted.size),
            "mean_occupancy": float(counts.occupied[i][seen].mean()) if counted.size else None,
            "day_error": float(np.median(forecast.level_sd[i, counted[-28:]])) if counted.size else None,
        } | counts.faults[i]
        rows.append(row)
        cells.append([f"{value:.2f}" if isinstance(value, float) else str(value) for value in row.values()])
    idle = counts.idle()
    drift = float(np.sqrt(7 * settings.level_drift))
    week = fit_typical_week(counts)
    typical_week = week and {
        "occupied": week.occupied.round(3).tolist(),
        "levels": dict(zip(map(str, LEVEL_SHARES), week.levels.round(3).tolist(), strict=True)),
        "day_error": float(np.nanmedian(week.day_errors).round(3)),
    }
    save_summary(
        out,
        None,
        rows,
        idle=idle,
        variances=asdict(settings),
        level_drift_per_week=drift,
        faults=counts.total_faults(),
        typical_week=typical_week,
    )
    headings = [str(key).replace("_", " ") for key in rows[0]]
    console.print(make_table(f"{counts.source}: {plural(n, 'day')}", headings, cells))
    _print_notes(counts, console)
    console.print(f"Levels drift by {drift:.2f} logits a week. The summary is in {out}")


def evaluate(
    log: Path,
    /,
    from_: str | None = None,
    car_parks: str | None = None,
    timezone: str = TIMEZONE,
    seed: int = 0,
    out: Path = Path("results/forecasts"),
) -> None:
    """Score forecasts of occupancy, each day from the days before it, beside simple ones.

    Models: day-curves (ours); last-four-weekdays, the mean of the hour on the last four same weekdays; last-week;
    hour-mean, of all weekdays or weekend days before; gradient-boosting. The variances of ours are fitted to the days
    before --from. Differences of log-losses are to ours, with 95 % intervals over car parks and weeks.

    Of a log of slots, every slot is forecast in each half-hour, by slot-days (ours), and all models are of the slots.

    Examples:
        parkenv occupancy evaluate car_parks.csv.gz --from 2024-01-01
        parkenv occupancy evaluate CNR-EXT.csv.gz --from 2015-12-03

    Options:
        log (FILE): Counts, car_park,capacity,hour,free (or hour_utc), or a log of slots,
            datetime,camera,slot_id,weather,occupied, as .csv or .csv.gz.
        from_ (DATE): First day that is scored.  [default: halfway]
        car_parks (NAME[,...]): Car parks.  [default: all]
        timezone (NAME): Local time of hour_utc.
        seed (N >= 0): Seed of the bootstrap.
        out, -o (DIR): Folder for summary.json and a picture of each model.
    """
    from dataclasses import asdict

    import numpy as np

    from parkenv.files.atomic_write import make_folder
    from parkenv.forecast.comparison import MODELS, compare
    from parkenv.forecast.counts import Counts, is_counts
    from parkenv.forecast.day_curves import FIT_STEPS, fit_settings
    from parkenv.show.figures.forecast import save_forecast, shown_counts, shown_week

    make_folder(out)
    console = make_console()
    if not is_counts(log):
        _evaluate_log(log, from_, seed, out, console)
        return
    with console.status("Reading"):
        counts = Counts.read(log, timezone)
    if car_parks is not None:
        counts = counts.chosen(words("--car-parks", car_parks))
    n = len(counts.days)
    first = n // 2 if from_ is None else counts.day_index(iso_date("--from", from_))
    if not np.isfinite(counts.occupied[:, first:]).any():
        raise InputError(f"--from is {from_}: {log} has no usable readings from then on")
    models: list[Compared] = []
    rows, cells = [], []
    with progress_bar(console) as progress:
        steps, days, done = (
            progress.add_task(name, total=total)
            for name, total in (("Fit", FIT_STEPS), ("Forecast days", n), ("Models", len(MODELS)))
        )
        settings = fit_settings(counts, first, lambda: progress.advance(steps))
        week = shown_week(counts, first)
        for compared in compare(counts, first, settings, lambda day: progress.update(days, completed=day)):
            save_forecast(shown_counts(compared, counts, week), out / f"{compared.model}.png")
            models.append(compared)
            progress.advance(done)
    for compared in models:
        row = _row(compared, models[0], seed)
        shown = [f"{row[key]:.1%}" for key in ("coverage_90", "coverage_90_hours")]
        shown += [
            f"{band['coverage_90']:.1%}" if band["days"] else "-" for band in row["coverage_90_by_band"]
        ]
        rows.append(row)
        cells.append(_cells(row, shown))
    save_summary(
        out,
        seed,
        rows,
        first_day=counts.days[first].isoformat(),
        faults=counts.total_faults(),
        faults_by_car_park=dict(zip(counts.car_parks, counts.faults, strict=True)),
        idle=counts.idle(),
        variances=asdict(settings),
    )
    band_names = [f"{band['from']:.0%}-{band['to']:.0%}" for band in rows[0]["coverage_90_by_band"]]
    headings = (
        "model",
        "log-loss",
        "Brier",
        "CRPS",
        "90 %: days",
        "hours",
        *band_names,
        "log-loss more than ours",
    )
    title = f"{plural(rows[0]['car_parks'], 'car park')}, {plural(rows[0]['days'], 'day')} from {counts.days[first]}"
    console.print(make_table(title, headings, cells))
    console.print(
        "90 %: days whose mean lies in its 90 % interval, in all and by forecast fullness.", soft_wrap=True
    )
    _print_notes(counts, console)
    console.print(f"Pictures and summary are in {out}")


def _row(compared: Compared | ComparedSlots, ours: Compared | ComparedSlots, seed: int) -> Row:
    """Return the row of a model in the summary; differences are to `ours`."""
    import numpy as np

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


def _cells(row: Row, coverage: list[str]) -> list[str]:
    """Return the row as the table shows it."""
    low, high = row["difference_ci95"]
    losses = [f"{row[key]:.4f}" for key in ("log_loss", "brier", "crps")]
    return [row["model"], *losses, *coverage, f"{row['difference']:+.4f} [{low:+.4f}, {high:+.4f}]"]


def _print_notes(counts: Counts, console: Console) -> None:
    """Print what was wrong with the counts."""
    faults = ", ".join(f"{name.replace('_', ' ')} {n:,}" for name, n in counts.total_faults().items() if n)
    console.print(f"Faults: {faults or 'none'}", soft_wrap=True)
    for name, what in counts.idle().items():
        console.print(f"{name}: {what}", soft_wrap=True)


def _evaluate_log(log: Path, from_: str | None, seed: int, out: Path, console: Console) -> None:
    import numpy as np

    from parkenv.forecast.slot_comparison import compare_slot_days
    from parkenv.show.figures.forecast import save_forecast, shown_slots
    from parkenv.world.occupancy.log import OccupancyLog

    recorded = OccupancyLog.read(log)
    first = recorded.days[len(recorded.days) // 2] if from_ is None else str(iso_date("--from", from_))
    classes = [np.flatnonzero(recorded.weekend == weekend) for weekend in (False, True)]
    days = [recorded.slot_days(days) for days in classes if days.size]
    with progress_bar(console) as progress:
        done = progress.add_task("Forecast days", total=sum(day >= first for day in recorded.days))
        found = compare_slot_days(days, iso_date("--from", first).toordinal(), lambda: progress.advance(done))
    if not found:
        raise InputError(f"--from is {first}: {log} has no day from then on with one of its class before it")
    rows, cells = [], []
    for compared in found:
        row = _row(compared, found[0], seed)
        rows.append(row)
        cells.append(_cells(row, [f"{row['coverage_90']:.0%}"]))
        save_forecast(shown_slots(compared, log.name), out / f"{compared.model}.png")
    save_summary(out, seed, rows, first_day=first)
    headings = ("model", "log-loss", "Brier", "CRPS", "90 %: days", "log-loss more than ours")
    title = f"{plural(len(recorded.slot_ids), 'slot')}, {plural(rows[0]['days'], 'day')} from {first}"
    console.print(make_table(title, headings, cells))
    console.print(f"Pictures and summary are in {out}")


app = group("occupancy", "Fit models to recorded occupancy, and score forecasts.")
add(app, "fit", fit)
add(app, "evaluate", evaluate)
