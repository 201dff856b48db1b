"""`parkenv occupancy`: estimate rates from a recorded log."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from parkenv import __version__
from parkenv.cli.tables import make_console, make_table

app = typer.Typer(help="Learn from recorded occupancy.", no_args_is_help=True)


@app.callback()
def _occupancy() -> None:
    """Fit models to recorded occupancy."""


@app.command()
def fit(
    log: Annotated[
        Path, typer.Argument(help="A log: datetime,camera,slot_id,weather,occupied as .csv or .csv.gz.")
    ],
    max_gap_h: Annotated[
        float, typer.Option("--max-gap-h", min=0.0, help="Looks farther apart than this, h, are not linked.")
    ] = 2.0,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for process.json, rates.png, summary.json.")
    ] = Path("results/occupancy"),
) -> None:
    """Fit arrival and departure rates to a log by maximum likelihood.

    Every slot is a two-state Markov chain. Its rates depend on the hour, separately for weekdays and weekends, and on a
    factor per slot. The log shows a slot only at single times; the likelihood covers all possible changes in between.
    Use the result, process.json, as --occupancy of `parkenv compare`: unchanged on a lot with the same number of slots,
    on any other lot with the fullest slots nearest to the goal.
    """
    from parkenv.evaluation.experiments.results import make_folder, write_summary
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

    rows = []
    table = make_table(
        f"{log.name}: {len(fitted.slot_ids)} slots, {fitted.n_intervals} intervals",
        ("day", "hour", "arrivals an hour", "departures an hour", "occupied"),
    )
    for name, day in (("weekday", 0), ("weekend", 5)):
        for hour in range(7, 19):
            occupied = float(np.mean(process.marginal(day * DAY_S + hour * HOUR_S)))
            rates = mean_rate("arrival", day, hour), mean_rate("departure", day, hour)
            rows.append(
                {
                    "day": name,
                    "hour": hour,
                    "arrival_rate_per_h": rates[0],
                    "departure_rate_per_h": rates[1],
                    "occupancy": occupied,
                }
            )
            table.add_row(name, f"{hour:02d}", f"{rates[0]:.3f}", f"{rates[1]:.3f}", f"{occupied:.0%}")
    summary = {
        "command": ["parkenv", *sys.argv[1:]],
        "version": __version__,
        "seed": None,
        "log_likelihood": fitted.log_likelihood,
        "intervals": fitted.n_intervals,
        "rows": rows,
    }
    write_summary(out, summary)
    console.print(table)
    console.print(f"Process, picture and summary are in {out}")
