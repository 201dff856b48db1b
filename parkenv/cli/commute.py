"""`parkenv commute`: drivers come day after day, with a map that learns from their trips."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.cli import arguments as args
from parkenv.cli.study_run import run_study
from parkenv.cli.tables import make_table
from parkenv.cli.trust import readable_models, require_trust
from parkenv.show.plurals import plural

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from parkenv.studies.runner import Result


def commute(
    agents: str | None = None,
    scenario: str | None = None,
    map: str | None = None,
    days: int | None = None,
    drivers: int | None = None,
    fleet: int | None = None,
    seed: int | None = None,
    out: Path = Path("results/commute"),
    *,
    world: args.Commutes,
    figures: bool | None = None,
    trust: bool = False,
    trust_model: bool = False,
    folder: args.ReportedRun,
    machines: args.Machines,
) -> None:
    """Let drivers come day after day, with a map that learns from every trip.

    Each driver comes at the same time of day, on the next of the scenario's weekdays or recorded days. What the car
    observes on a search goes into its map in the evening, with the sensor's error rates; the next day's forecast is
    corrected by it. Nobody tells the map what else was free.

    The table and the picture show mean total time and forecast error (Brier score of P(taken) at the arrival, over
    all slots) against the day. For comparison, each agent also drives with the right map that does not learn (fixed);
    agents that use no map (first-free, greedy-drive, ...) have one level. All meet the same worlds.

    Examples:
        parkenv commute --scenario jam --map wrong
        parkenv commute --scenario campus,jam --map empty,wrong --days 20
        parkenv commute --agents belief,first-free --drivers 100
        parkenv commute --fleet 5 --map empty
        parkenv commute --resume --days 60

    Options:
        agents (NAME[,...]): Agents, with any options in brackets; differences in `weeks` of summary.json are to the
            first that uses no map.  [default: belief,mdp,first-free,greedy-drive]
        scenario (NAME|FILE|DIR[,...]): {scenarios}; scenario files (.toml), lots (.geojson), or folders.  [default:
            campus]
        map (empty|right|wrong[,...]): The map on the first day. empty: 50 % for every slot. right: the forecast of the
            scenario's occupancy. wrong: the forecast of the scenario where it differs from that (jam), else the right
            one with near and far slots exchanged.  [default: empty]
        days (N >= 1): Days on which each driver comes, at most those of a recorded log.  [default: 30]
        drivers (N >= 1): Drivers (or fleets), each with a map of their own: the more, the narrower the intervals.
            [default: 40]
        fleet (N >= 1): Drivers who share a map, and come every day.  [default: 1]
        seed (N >= 0): Seed of days and drivers.  [default: 0]
        out, -o (DIR): Folder for experiment.json, episodes.csv, summary.json, commute.png and the maps.

    World:
        forecast_from (past|rolling|others): Days that the right map's forecast is made from. past: those before
            --replay-from; rolling: those before the earliest that a world replays; others: all that it does not replay.
            [default: the scenario's; others, with counts rolling]
        mapping (FILE): CSV slot_id,log_slot_id that assigns the log's slots to the lot's.  [default: the log's fullest
            slots are nearest to the goal; the same slots on every day]
        hours (HH:MM-HH:MM): Drivers come between these hours.  [default: the scenario's, 08:00-13:00]

    Sensors:
        sensor_model (NAME|FILE): How slots are observed. perfect: without error; blind: by attempts alone; laser,
            stereo: as measured with that rig; a file of `parkenv fit-sensor-model`.  [default: the scenario's]

    Results:
        figures: Draw the picture.  [default: figures]
    """
    from parkenv.studies.agent_spec import split_agents
    from parkenv.studies.commute.study import Commute

    base = Commute()
    if folder.resume:
        base = args.saved(out, Commute)
        if agents is None:
            require_trust(base, out, trust)
    given = args.not_none(days=days, drivers=drivers, fleet=fleet, seed=seed, figures=figures)
    if agents is not None:
        given["agents"] = readable_models(split_agents(agents), trust_model)
    if map is not None:
        given["maps"] = tuple(args.words("--map", map))
    study = base.changed(scenarios=tuple(world.specs(scenario, base.scenarios)), **given, **machines.given)
    run_study(study, out, folder, show)


def show(console: Console, result: Result) -> None:
    """Print the tables of a commute."""
    weeks = result.summary["weeks"]
    for name in dict.fromkeys(row["scenario"] for row in weeks):
        console.print(_table(name, [row for row in weeks if row["scenario"] == name]))


def _table(scenario: str, rows: list[dict[str, Any]]) -> Table:
    """Make a table of mean total times, s, by map, agent and week, each with its forecast error."""
    weeks = list(dict.fromkeys(row["days"] for row in rows))
    cells: dict[tuple[str, str], dict[str, str]] = {}
    for row in rows:
        error = "" if row["forecast_error"] != row["forecast_error"] else f" ({row['forecast_error']:.3f})"
        cells.setdefault((row["map"], row["agent"]), {})[row["days"]] = f"{row['total_s']:.1f}{error}"
    return make_table(
        f"{scenario}: total s (forecast error) by days, {plural(rows[0]['courses'], 'driver')}",
        ("map", "agent", *(f"days {week}" for week in weeks)),
        ((*key, *(its.get(week, "") for week in weeks)) for key, its in cells.items()),
    )
