"""`parkenv benchmark`: a fixed suite with comparable, checkable results."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from parkenv.cli.options import Command
from parkenv.cli.study_command import AgentStudyCommand
from parkenv.cli.tables import command_line, make_console, make_table
from parkenv.files.option import option
from parkenv.files.spec_file import Several
from parkenv.show.plurals import plural
from parkenv.studies.benchmark.study import RESULT, Benchmark

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.studies.runner import Result


class RunSuite(AgentStudyCommand):
    """The suite defines scenarios, costs, speeds and seeds.

    An agent's score in a task is the mean total time of the clairvoyant bound divided by the agent's own; its score in
    the suite is the mean over the tasks, at most 1.
    """

    examples = """
        parkenv benchmark run v3 --agents belief,mdp --out results/v3
        parkenv benchmark check results/v3/result.json
        """

    study: Benchmark = Benchmark()
    out: Path | None = option(Path("results/v3"), "Folder for result.json and the episodes.", short="-o")

    def show(self, console: Console, result: Result) -> None:
        """Print the scores of a finished suite."""
        from parkenv.files.limited_reading import read_json

        if result.complete:
            _print(console, [read_json(result.folder / RESULT)])


class Check(Command):
    """Every episode must be present. The command recomputes means, scores and the clairvoyant bounds of all episodes.

    A total time below the bound means another world, other costs or other speeds. The times of an agent cannot be
    verified without running it.
    """

    examples = "parkenv benchmark check results/v3/result.json others.json"

    results: Several[Path] = option(..., "Result files.", takes="FILE", argument=True)

    def run(self) -> None:
        from parkenv.studies.benchmark.result_file import check_result

        console = make_console()
        with console.status("Checking"):
            checked = [check_result(file) for file in self.results]
        _print(console, checked)
        console.print(f"{'Complete and consistent' if len(checked) == 1 else 'All complete and consistent'}.")


class Page(Command):
    """The page needs no network and no other file. Click a heading to sort its table.

    A result that fails `parkenv benchmark check`, or whose agents are not part of parkenv and have no address of their
    code, is refused, and no page is written.
    """

    examples = """
        parkenv benchmark page results/v3 yours/result.json --out v3.html
        parkenv benchmark page docs/leaderboard/results --out leaderboard.html
        """

    results: Several[Path] = option(
        ...,
        "Result files, or folders: of these every result.json below them, or if there is none every .json.",
        takes="FILE|DIR",
        argument=True,
    )
    out: Path = option(Path("results/benchmark.html"), "The page.", short="-o", takes="FILE.html")

    def run(self) -> None:
        from parkenv.files.atomic_write import make_folder
        from parkenv.show.report.page import write_page
        from parkenv.studies.benchmark.page import benchmark_data, result_files
        from parkenv.studies.benchmark.result_file import check_result

        files = [file for path in self.results for file in result_files(path)]
        make_folder(self.out.parent)
        console = make_console()
        with console.status("Checking"):
            checked = [check_result(file) for file in files]
        write_page(benchmark_data(checked, command_line()), self.out)
        agents = sum(len(result["scores"]) for result in checked)
        console.print(f"Written: {self.out}, {plural(agents, 'agent')} in {plural(len(checked), 'result')}")


class Show(Command):
    """For each task: scenario, slots, mean occupancy, day error, sensor model and walking speed."""

    examples = "parkenv benchmark show"

    suite: Literal["v3"] = option("v3", "The suite.", argument=True)

    def run(self) -> None:
        from parkenv.studies.benchmark.suite import Suite

        suite = Suite.packaged()
        console = make_console()
        console.print(f"{suite.name}: {suite.description}")
        cells = []
        for task in suite.tasks:
            made = task.made(suite.arrival)
            level = "as it comes" if task.occupancy_level is None else f"{task.occupancy_level:.0%}"
            walk = f"{made.v_walk * 3.6:g} km/h"
            days = ", ".join(f"{size:g}" for size in task.day_error)
            cells.append(
                (
                    task.name,
                    task.scenario,
                    str(made.lot.n_slots),
                    level,
                    days,
                    task.sensor_model,
                    walk,
                )
            )
        headings = ["task", "scenario", "slots", "mean occupancy", "day error", "sensor model", "walking"]
        console.print(make_table(None, headings, cells))
        counts = [len(task.seeds) for task in suite.tasks]
        console.print(
            f"{min(counts)} to {max(counts)} episodes a task, {sum(counts):,} in all, weighted by stratum; "
            f"suite {suite.fingerprint[:16]}"
        )


def _print(console: Console, results: list[dict[str, Any]]) -> None:
    lines = []
    columns: list[str] = []
    for result in results:
        mean = {(row["agent"], row["task"]): row["total_s"] for row in result["rows"]}
        columns = list(dict.fromkeys(column for _, column in mean))
        for agent, score in result["scores"].items():
            lines.append((score, agent, [f"{mean[agent, column]:.1f}" for column in columns]))
    lines.sort(key=lambda line: -line[0])
    cells = ((agent, *times, f"{score:.4f}") for score, agent, times in lines)
    console.print(make_table("Mean total time, s, and the score", ["agent", *columns, "score"], cells))
