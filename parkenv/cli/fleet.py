"""`parkenv fleet`: many cars search one lot, and what they know."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.cli import arguments as args
from parkenv.cli.study_run import run_study
from parkenv.cli.tables import make_table
from parkenv.cli.trust import readable_models, require_trust
from parkenv.studies.results import Row

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.studies.runner import Result


def fleet(
    agents: str | None = None,
    scenario: str | None = None,
    episodes: int | None = None,
    seed: int | None = None,
    out: Path = Path("results/fleet"),
    *,
    arrivals_per_hour: str | None = None,
    stay_min: float | None = None,
    patience_min: float | None = None,
    knows: str | None = None,
    share: str | None = None,
    delay: float | None = None,
    manoeuvre: float | None = None,
    calibrated: Path | None = None,
    leaving_soon: float | None = None,
    sees_cars: bool | None = None,
    decision_limit: float | None = None,
    world: args.ObservedSearches,
    figures: bool | None = None,
    trust: bool = False,
    trust_model: bool = False,
    folder: args.ReportedRun,
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
        parkenv fleet --manoeuvre 15 --leaving-soon 10
        parkenv fleet --resume --episodes 20

    Options:
        agents (NAME[,...]): Agents, each of which drives all cars in turn, with any options in brackets. greedy-drive,
            first-free and random are compiled; any other agent decides in Python.  [default: greedy-drive]
        episodes, -n (N >= 1): Days of each setting.  [default: 10]
        seed (N >= 0): Seed of the days.  [default: 0]
        out, -o (DIR): Folder for experiment.json, days.csv, summary.json and fleet.png.

    Demand:
        arrivals_per_hour (X[,...]): Cars an hour that arrive.  [default: 60,120,240]
        stay_min (0.1 <= X <= 100000): Mean of the exponentially distributed stays, minutes.  [default: 60]
        patience_min (0.1 <= X <= 100000): Minutes after which a searching car goes elsewhere, at the give-up penalty.
            [default: 10]

    Knowledge:
        knows (NAME[,...]): What members know. own: what they observe; shared: also a live map of what members observe;
            reserve: the slot that a guidance system has reserved; full: the state of every slot.  [default:
            own,shared,reserve,full]
        share (X[,...]): Shares of the cars that are members, from 0 to 1; the others know what they observe.
            [default: 1]
        delay (0.0 <= X <= 100000): Age of the live map, s.  [default: 0]

    Interactions:
        manoeuvre (0.0 <= X <= 3600): Seconds for which a car that parks or leaves blocks its lane; queues form behind
            it, and behind a car that stands.  [default: as in --calibrated; else 0, cars pass through each other]
        calibrated (FILE): Take driving speed, failure cost and manoeuvre from a calibrated.json of `parkenv calibrate`.
        leaving_soon (0.0 <= X <= 3600): Seconds for which cars show that they leave; a car that stands before such a
            slot holds it.  [default: 0]
        sees_cars: Let agents observe other cars in view, in a further key of the observation.  [default: no-sees-cars]

    Agents:
        decision_limit (0.01 <= X <= 100000): Stop the run if an agent in Python takes longer for a decision, in seconds
            of wall time, compiling included.  [default: none]

    Results:
        figures: Draw the picture.  [default: figures]
    """
    from parkenv.studies.agent_spec import split_agents
    from parkenv.studies.fleet.study import FleetStudy

    base = FleetStudy()
    if folder.resume:
        base = args.saved(out, FleetStudy)
        require_trust(base, out, trust, given=args.not_none(agents=agents) | machines.given)
    spec = base.changed(**args.not_none(days=episodes, seed=seed, figures=figures), **machines.given)
    if agents is not None:
        spec = spec.changed(agents=readable_models(split_agents(agents), trust_model))
    spec = spec.changed(scenario=args.one_scenario(world.specs(scenario, [base.scenario])))
    if knows is not None:
        spec = spec.changed("--knows", knows=args.words("--knows", knows))
    if share is not None:
        spec = spec.changed("--share", shares=args.numbers("--share", share))
    if arrivals_per_hour is not None:
        its = args.numbers("--arrivals-per-hour", arrivals_per_hour)
        spec = spec.changed("--arrivals-per-hour", arrivals_per_hour=its)
    if stay_min is not None:
        spec = spec.changed("--stay-min", stay_s=60.0 * stay_min)
    if patience_min is not None:
        spec = spec.changed("--patience-min", patience_s=60.0 * patience_min)
    if delay is not None:
        spec = spec.changed("--delay", delay_s=delay)
    if calibrated is not None:
        spec = spec.changed("--calibrated", calibrated=calibrated)
    spec = spec.changed(**args.not_none(
        manoeuvre_s=manoeuvre, leaving_soon_s=leaving_soon, sees_cars=sees_cars, decision_limit_s=decision_limit,
    ))  # fmt: skip
    run_study(spec, out, folder, show)


def show(console: Console, result: Result) -> None:
    """Print the table of a study of many cars."""
    study: Any = result.study
    if not result.rows:
        return
    headings = (
        "agents", "knows", "share", "per hour", "total s [95 %]", "search s", "p95 s", "failed", "balked",
        "cruising", "occupancy", "price of anarchy", "over bound",
    )  # fmt: skip
    console.print(make_table(study.title, headings, map(_cells, result.rows)))


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
        f"{row['price_over_bound']:.3f}",
    )
