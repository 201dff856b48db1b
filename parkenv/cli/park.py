"""`parkenv park`: success rates and times of parking agents."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.cli import arguments as args
from parkenv.cli.single_writer import writing_into
from parkenv.cli.tables import make_console, make_table, progress_bar, save_summary
from parkenv.cli.trust import readable_models
from parkenv.errors import InputError, nearest
from parkenv.files.file_names import file_name
from parkenv.show.plurals import plural

if TYPE_CHECKING:
    from parkenv.studies.trips.parking_runs import Parking, ParkingCase
    from planners.agent import Agent

SCENARIOS = "campus,street"
SHOWN_FAILURES = 6
SHOWN_ROWS = 20


def park(
    agents: str = "planner",
    scenario: str | None = None,
    episodes: int = 100,
    seed: int = 0,
    out: Path = Path("results/park"),
    *,
    kind: str = "all",
    way: str = "both",
    occupied: float = 0.85,
    slack: float = 0.0,
    lot: str | None = None,
    trust_model: bool = False,
    machines: args.Machines,
) -> None:
    """Evaluate agents that drive the car into a slot: success rate, planning time, driving time, manoeuvres.

    Writes pictures of one successful episode per kind of slot and orientation, an animation of one, and pictures of
    failures, if any; with several agents, into one folder per agent.

    Examples:
        parkenv park --episodes 250 --scenario campus,street,jam
        parkenv park --agents planner,sac:results/drive-sac/seed_0/model.safetensors
        parkenv park --lot parking_map.yml --way back-in

    Options:
        agents (NAME[,...]): Parking agents, compared on the same tasks: planner, or ALGORITHM:FILE for a model of
            `parkenv train --env drive`.
        scenario (NAME|FILE|DIR[,...]): {scenarios}; scenario files (.toml), lots (.geojson), or folders.  [default:
            campus,street]
        episodes, -n (1 <= N <= 1000000): Episodes per lot.
        out, -o (DIR): Folder for pictures, episodes.csv and summary.json.

    Parking tasks:
        kind (NAME[,...]|all): Slots: perpendicular, oblique, parallel.
        way (NAME|both): Orientation in the slot: nose-in, back-in.
        occupied (0 <= P <= 1): Fraction of the other slots that are taken.
        slack (M >= 0): Distance around the slot kept clear of parked cars, m.
    """
    from parkenv.driving.parking_task import KINDS, WAYS
    from parkenv.files.atomic_write import make_folder
    from parkenv.scenarios.build import build
    from parkenv.studies.trips.parking_runs import ParkingCase, park_all, parking_table, write_parkings
    from planners.driving.parking_agents import make_parking_agent

    kinds = None if kind == "all" else _chosen("--kind", kind, KINDS)
    ways = WAYS if way == "both" else _chosen("--way", way, WAYS)
    cases = []
    for spec in args.World(lot=lot).specs(scenario, default=SCENARIOS):
        case = ParkingCase(build(spec).lot, kinds, ways, occupied, slack)
        case.environment().close()  # validates the options before the first episode
        cases.append(case)
    labels = _labels(readable_models(args.words("--agents", agents), trust_model))
    parking_agents = {label: make_parking_agent(name) for label, name in labels.items()}
    with writing_into(out):
        console = make_console()
        seeds = range(seed, seed + episodes)
        parkings: dict[str, list[Parking]] = {label: [] for label in labels}
        with progress_bar(console, "episodes") as progress, machines.workers() as workers:
            for label, name in labels.items():
                what = "Parking" if len(labels) == 1 else label
                bar = progress.add_task(what, total=len(cases) * episodes)
                for some in park_all(cases, seeds, workers, name):
                    parkings[label] += some
                    progress.advance(bar, len(some))

        rows = [{"agent": label, **p.row} for label, its in parkings.items() for p in its]
        table = [
            {"agent": label, **row}
            for label, its in parkings.items()
            for row in parking_table([p.row for p in its])
        ]
        names = [case.lot.name for case in cases]
        write_parkings(rows, out / "episodes.csv")
        save_summary(out, seed, table, lots=names, agents=labels)
        film = _to_film(next(iter(parkings.values())))
        for label, its in parkings.items():
            folder = out if len(labels) == 1 else out / file_name(label)
            make_folder(folder)
            _picture(its, cases, parking_agents[label], film, folder)
        _show(console, f"{', '.join(names)}: {plural(episodes, 'episode')} per lot", table)
        for row in [row for row in rows if not row["parked"]][:SHOWN_ROWS]:
            who = f"{row['agent']}, " if len(labels) > 1 else ""
            console.print(
                f"failed: {who}{row['lot']}, seed {row['seed']}, {row['slot']} {row['way']}: {row['reason']}"
            )
        console.print(f"Episodes, summary and pictures are in {out}")


def _labels(names: list[str]) -> dict[str, str]:
    """Return a short label per agent, usable as a folder name, and the agent's full name."""
    labels: dict[str, str] = {}
    for name in names:
        word = name.partition(":")[0]
        alike = sum(known.partition(":")[0] == word for known in labels.values())
        labels[f"{word}-{alike + 1}" if alike else word] = name
    return labels


def _to_film(parkings: list[Parking]) -> dict[str, Any] | None:
    """Return the row of the successful episode with the most direction changes; None without success."""
    parked = [p.row for p in _one_of_each(parkings)]
    return max(parked, key=lambda row: row["direction_changes"], default=None)


def _one_of_each(parkings: list[Parking]) -> list[Parking]:
    """Return the first success per kind of slot and orientation."""
    kept = {(p.row["kind"], p.row["way"]): p for p in reversed(parkings) if p.row["parked"]}
    return [kept[key] for key in sorted(kept)]


def _picture(
    parkings: list[Parking],
    cases: list[ParkingCase],
    agent: Agent,
    film: dict[str, Any] | None,
    folder: Path,
) -> None:
    """Write pictures of successes and failures, and an animation of the episode `film`."""
    from parkenv.show.figures.parkings import save_parkings
    from parkenv.show.figures.picture_files import save_film
    from parkenv.studies.trips.parking_runs import park_once

    lots = {case.lot.name: case.lot for case in cases}
    failures = [p for p in parkings if not p.row["parked"]][:SHOWN_FAILURES]
    for shown, name in ((_one_of_each(parkings), "parkings.png"), (failures, "failures.png")):
        if shown:
            save_parkings([(lots[p.row["lot"]], p.state) for p in shown], folder / name)
    if film is not None:
        case = next(case for case in cases if case.lot.name == film["lot"])
        frames = park_once(case.environment("rgb_array"), agent, film["seed"], every=2).frames
        save_film(frames, folder / "parking.gif", fps=10.0)


def _chosen(option: str, text: str, known: tuple[str, ...]) -> tuple[str, ...]:
    words = args.words(option, text)
    for word in words:
        if word not in known:
            raise InputError(f"{option} has {word!r}; {nearest(word, known)}")
    return tuple(words)


def _show(console: Any, title: str, table: list[dict[str, Any]]) -> None:
    headings = (
        "agent", "slot", "parked", "success [95 %]", "contacts", "plan ms (p95)", "drive s (p95)", "changes (p95)",
        "driven m", "turned rad",
    )  # fmt: skip
    cells = (
        (
            row["agent"],
            f"{row['kind']} {row['way']}".strip(),
            f"{row['parked']}/{row['episodes']}",
            f"{row['success']:.1%} [{row['success_ci95'][0]:.1%}, {row['success_ci95'][1]:.1%}]",
            str(row["contacts"]),
            _pair(row, "planning_ms", 0),
            _pair(row, "time_s", 1),
            _pair(row, "direction_changes", 0),
            _known(row["driven_m"], 1),
            _known(row["turned_rad"], 1),
        )
        for row in table
    )
    console.print(make_table(title, headings, cells))


def _pair(row: dict[str, Any], name: str, digits: int) -> str:
    """Format a median with its 95th percentile; empty for agents without the quantity, e.g. planning time."""
    median, p95 = (_known(row[key], digits) for key in (name, f"{name}_p95"))
    return median and f"{median} ({p95})"


def _known(value: float, digits: int) -> str:
    return "" if value != value else f"{value:.{digits}f}"
