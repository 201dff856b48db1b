"""`parkenv benchmark`: fixed suites with comparable, checkable results."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.cli import arguments as args
from parkenv.cli.command import add, group
from parkenv.cli.study_run import run_study
from parkenv.cli.tables import command_line, make_console, make_table
from parkenv.cli.trust import readable_models, require_trust
from parkenv.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.studies.runner import Result

PLACES = "-places"
"""End of the name of a suite of places."""


def run(
    suite: str = "v2",
    /,
    agents: str | None = None,
    out: Path | None = None,
    *,
    places: bool = False,
    by: str | None = None,
    trust: bool = False,
    trust_model: bool = False,
    folder: args.ReportedRun,
    machines: args.Machines,
) -> None:
    """Run agents through all episodes of a suite, and write a result that others can check.

    The suite defines scenarios, costs, speeds and seeds. An agent's score in a task is the mean total time of the
    clairvoyant bound divided by the agent's own; its score in the suite is the mean over the tasks, at most 1.

    Examples:
        parkenv benchmark run v2 --agents belief,mdp --out results/v2
        parkenv benchmark run v2 --places --agents belief,mdp --out results/v2-places
        parkenv benchmark check results/v2/result.json

    Options:
        suite (SUITE): The suite.  [default: v2]
        out, -o (DIR): Folder for result.json and the episodes.  [default: results/SUITE]
        places: Run the places of the suite instead of its packaged scenarios: 24 real car parks that agents are never
            trained on (the suite v2-places).
        by (TEXT): Who submits the result: a name, an address of the code.  [default: nobody]
    """
    from parkenv.studies.agent_spec import split_agents
    from parkenv.studies.benchmark.study import Benchmark

    suite += PLACES if places else ""
    out = out or Path("results") / suite
    base = args.saved(out, Benchmark) if folder.resume else Benchmark()
    require_trust(base, out, trust, given=args.not_none(agents=agents) | machines.given)
    named = None if agents is None else readable_models(split_agents(agents), trust_model)
    given = args.not_none(by=by, agents=named)
    spec = base.changed(suite=suite, **given, **machines.given)
    run_study(spec, out, folder, show_scores)


def show_scores(console: Console, result: Result) -> None:
    """Print the scores of a finished suite."""
    from parkenv.files.limited_reading import read_json
    from parkenv.studies.benchmark.study import RESULT

    if result.complete:
        _print(console, [read_json(result.folder / RESULT)])


def check(results: list[Path], /) -> None:
    """Check that results are complete and from the suite's own worlds, and print them side by side.

    Every episode must be present. Means, scores and the clairvoyant bounds of all episodes are recomputed; the bounds
    differ in other worlds or at other costs and speeds. The times of an agent cannot be verified without running it.

    Examples:
        parkenv benchmark check results/v2/result.json others.json

    Options:
        results (FILE): Result files.
    """
    from parkenv.studies.benchmark.suite import check_result

    console = make_console()
    with console.status("Checking"):
        checked = [check_result(file) for file in results]
    if len({result["suite"] for result in checked}) > 1:
        raise InputError("the results are of different suites; check those of one at a time")
    _print(console, checked)
    console.print(f"{'Complete and consistent' if len(checked) == 1 else 'All complete and consistent'}.")


def page(results: list[Path], /, out: Path = Path("results/benchmark.html")) -> None:
    """Check submitted results of a suite, and write a page that compares them.

    The page needs no network and no other file. Its tables sort by a click on a heading. A result that fails
    `parkenv benchmark check` is refused, and no page is written.

    Examples:
        parkenv benchmark page results/v2 yours/result.json --out v2.html

    Options:
        results (FILE|DIR): Result files, or folders with result.json files in them.
        out, -o (FILE.html): The page.
    """
    from parkenv.files.atomic_write import make_folder
    from parkenv.show.report.page import write_page
    from parkenv.studies.benchmark.page import benchmark_data
    from parkenv.studies.benchmark.study import RESULT
    from parkenv.studies.benchmark.suite import check_result

    files = [each for path in results for each in (sorted(path.rglob(RESULT)) if path.is_dir() else [path])]
    if not files:
        raise InputError(f"{results[0]}: no {RESULT} below it")
    make_folder(out.parent)
    console = make_console()
    with console.status("Checking"):
        checked = [check_result(file) for file in files]
    write_page(benchmark_data(checked, command_line()), out)
    agents = sum(len(result["scores"]) for result in checked)
    console.print(f"Written: {out}, {agents} agents in {len(checked)} results")


def show(suite: str = "v2", /, places: bool = False) -> None:
    """Show the tasks and settings of a suite.

    Examples:
        parkenv benchmark show v2
        parkenv benchmark show v2 --places

    Options:
        suite (SUITE): The suite.  [default: v2]
        places: Show the places of the suite instead of its packaged scenarios.
    """
    from parkenv.studies.benchmark.suite import SUITES, Suite

    its = Suite.named(suite + PLACES if places else suite)
    console = make_console()
    console.print(f"{its.name}: {its.description}")
    cells = []
    for task in its.tasks:
        made = task.made(its.arrival)
        level = "as it comes" if task.occupancy_level is None else f"{task.occupancy_level:.0%}"
        walk = f"{made.v_walk * 3.6:g} km/h"
        days = ", ".join(f"{size:g}" for size in task.day_error)
        cells.append(
            (
                task.name,
                task.group or task.scenario,
                str(made.lot.n_slots),
                level,
                days,
                task.sensor_model,
                walk,
            )
        )
    scenario = "scenario" if its.tasks[0].group is None else "kind of place"
    headings = ["task", scenario, "slots", "mean occupancy", "day error", "sensor model", "walking"]
    console.print(make_table(None, headings, cells))
    console.print(
        f"{len(its.seeds)} episodes a task, seeds {its.seeds[0]} to {its.seeds[-1]}; suite {its.fingerprint[:16]}"
    )
    if its.name + PLACES in SUITES:
        console.print(f"Its places, real car parks: parkenv benchmark show {its.name} --places")


def _print(console: Console, results: list[dict[str, Any]]) -> None:
    from parkenv.studies.benchmark.suite import by_group

    lines = []
    columns: list[str] = []
    for result in results:
        mean = {(agent, group): time for agent, group, time, _ in by_group(result)}
        mean = mean or {(row["agent"], row["task"]): row["total_s"] for row in result["rows"]}
        columns = list(dict.fromkeys(column for _, column in mean))
        for agent, score in result["scores"].items():
            lines.append((score, agent, [f"{mean[agent, column]:.1f}" for column in columns]))
    lines.sort(key=lambda line: -line[0])
    cells = ((agent, *times, f"{score:.4f}") for score, agent, times in lines)
    console.print(make_table("Mean total time, s, and the score", ["agent", *columns, "score"], cells))


app = group("benchmark", "Run a fixed benchmark suite, and check the results of others.")
add(app, "run", run)
add(app, "check", check)
add(app, "page", page)
add(app, "show", show)
