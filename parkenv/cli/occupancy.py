"""`parkenv occupancy`: estimate rates from a recorded log."""

from __future__ import annotations

from pathlib import Path

from parkenv.cli.command import add, group
from parkenv.cli.tables import make_console, make_table, save_summary


def fit(log: Path, /, max_gap_h: float = 2.0, out: Path = Path("results/occupancy")) -> None:
    """Fit arrival and departure rates to a log by maximum likelihood.

    Every slot is a two-state Markov chain. Its rates depend on the hour, separately for weekdays and weekends, and on a
    factor per slot. The log shows a slot only at single times; the likelihood covers all possible changes in between.
    Use the result, process.json, as --occupancy of `parkenv compare`: unchanged on a lot with the same number of slots,
    on any other lot with the fullest slots nearest to the goal.

    Examples:
        parkenv occupancy fit CNR-EXT.csv.gz --out results/pisa
        parkenv compare --occupancy results/pisa/process.json

    Options:
        log (FILE): A log: datetime,camera,slot_id,weather,occupied as .csv or .csv.gz.
        max_gap_h (H >= 0): Observations farther apart than this, h, are not linked.
        out, -o (DIR): Folder for process.json, rates.png, summary.json.
    """
    import numpy as np

    from parkenv.evaluation.experiments.results import make_folder
    from parkenv.evaluation.figures.rates_picture import save_rates
    from parkenv.world.occupancy_fit import fit_process
    from parkenv.world.occupancy_log import OccupancyLog
    from parkenv.world.week import DAY_S, HOUR_S

    make_folder(out)
    console = make_console()
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
    save_summary(out, None, rows, **counts)
    title = f"{log.name}: {len(fitted.slot_ids)} slots, {fitted.n_intervals} intervals"
    headings = ("day", "hour", "arrivals an hour", "departures an hour", "occupied")
    console.print(make_table(title, headings, cells))
    console.print(f"Process, picture and summary are in {out}")


app = group("occupancy", "Fit models to recorded occupancy.")
add(app, "fit", fit)
