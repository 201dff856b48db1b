"""`parkenv fleet`: many cars search one lot, and what they know."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from parkenv.cli import arguments as args
from parkenv.cli.single_writer import writing_into
from parkenv.cli.tables import make_console, make_table, progress_bar, save_summary

Row = dict[str, Any]


def fleet(
    scenario: str | None = None,
    agents: str = "greedy-drive",
    episodes: int = 10,
    seed: int = 0,
    out: Path = Path("results/fleet"),
    *,
    arrivals_per_hour: str = "60,120,240",
    knows: str = "own,shared,reserve,full",
    share: str = "1",
    stay_min: float = 60.0,
    patience_min: float = 10.0,
    delay: float = 0.0,
    world: args.ObservedSearches,
    machines: args.Machines,
) -> None:
    """Let many cars arrive in one lot, search, park, stay and leave, and compare what they know.

    On a day, residents are parked when the hours of arrival begin, and leave after the rest of their stay; cars arrive
    as a Poisson process. All settings have the same days: arrivals, stays, patience and residents. The table gives
    the mean over cars and days with 95 % intervals over days. The price of anarchy is the total time over that of a
    guidance system that reserves slots for all cars; it needs reserve among --knows, and 1 among --share.

    Examples:
        parkenv fleet --scenario campus --arrivals-per-hour 60,120 --out crowd
        parkenv fleet --agents belief,greedy-drive --knows own,reserve -n 5
        parkenv fleet --knows own,shared --share 0.1,0.25,0.5,1 --delay 60

    Options:
        agents (NAME[,...]): Agents, each of which drives all cars in turn, with any options in brackets. greedy-drive,
            first-free and random are compiled; any other agent decides in Python.
        episodes, -n (1 <= N <= 100000): Days of each setting.
        seed (N >= 0): Seed of the days.
        out, -o (DIR): Folder for summary.json, days.csv and fleet.png.

    Demand:
        arrivals_per_hour (X[,...]): Cars an hour that arrive.
        stay_min (0.1 <= X <= 100000): Mean of the exponentially distributed stays, minutes.
        patience_min (0.1 <= X <= 100000): Minutes after which a searching car goes elsewhere, at the give-up penalty.

    Knowledge:
        knows (NAME[,...]): What members know. own: what they observe; shared: also a live map of what members observe;
            reserve: the slot that a guidance system has reserved; full: the state of every slot.
        share (X[,...]): Shares of the cars that are members, from 0 to 1; the others know what they observe.
        delay (0.0 <= X <= 100000): Age of the live map, s.
    """
    from parkenv.evaluation.experiments.agent_spec import split_agents
    from parkenv.evaluation.figures.fleet_figure import save_fleet_figure
    from parkenv.evaluation.fleet.experiment import FleetExperiment, summarize_days
    from parkenv.evaluation.plurals import plural
    from parkenv.files.csv_writing import write_csv
    from parkenv.scenarios.build import build

    spec = world.spec(scenario)
    experiment = FleetExperiment(
        spec,
        tuple(split_agents(agents)),
        tuple(args.words("--knows", knows)),
        tuple(args.numbers("--share", share)),
        tuple(args.numbers("--arrivals-per-hour", arrivals_per_hour)),
        episodes,
        seed,
        60.0 * stay_min,
        60.0 * patience_min,
        delay,
    )
    its = build(spec)
    settings = experiment.settings()
    for setting in settings:
        experiment.fleet(setting, its)  # raises an error before anything is run
    with writing_into(out):
        console = make_console()
        with machines.workers() as workers, progress_bar(console, "days") as progress:
            bar = progress.add_task("Driving", total=len(settings) * episodes)
            days = list(experiment.run(workers, lambda: progress.advance(bar)))
        rows = summarize_days(days)
        write_csv(out / "days.csv", list(days[0][0]), (day for of_setting in days for day in of_setting))
        save_summary(
            out, seed, [{"scenario": its.name, **row} for row in rows], stay_s=experiment.stay_s,
            patience_s=experiment.patience_s, delay_s=delay,
        )  # fmt: skip
        title = f"{its.name}: {its.lot.n_slots} slots, {plural(episodes, 'day')}"
        save_fleet_figure(rows, its, title, out / "fleet.png")
        headings = (
            "agents", "knows", "share", "per hour", "total s [95 %]", "search s", "p95 s", "failed", "balked",
            "cruising", "occupancy", "price of anarchy",
        )  # fmt: skip
        console.print(make_table(title, headings, map(_cells, rows)))
        console.print(f"Summary, days and figure are in {out}")


def _cells(row: Row) -> tuple[str, ...]:
    low, high = row["total_s_ci95"]
    cheap, dear = row["price_of_anarchy_ci95"]
    price = row["price_of_anarchy"]
    return (
        row["agents"],
        row["knows"],
        f"{row['share']:g}",
        f"{row['arrivals_per_hour']:g}",
        f"{row['total_s']:.1f} [{low:.1f}, {high:.1f}]",
        f"{row['search_s']:.1f}",
        f"{row['p95_s']:.0f}",
        f"{row['failed_attempts']:.3f}",
        f"{row['balked_fraction']:.1%}",
        f"{row['cruising_share']:.0%}",
        f"{row['occupancy']:.0%}",
        "" if price != price else f"{price:.3f} [{cheap:.3f}, {dear:.3f}]",
    )
