"""`parkenv benchmark`: fixed suites with comparable, checkable results."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from parkenv.cli.options import Command, Given
from parkenv.cli.study_command import AgentStudyCommand
from parkenv.cli.tables import command_line, make_console, make_table
from parkenv.errors import InputError
from parkenv.files.option import option
from parkenv.files.spec_file import Several
from parkenv.show.plurals import plural
from parkenv.studies.benchmark.study import RESULT, Benchmark

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.studies.runner import Result

PLACES = "-places"
"""End of the name of a suite of places."""


class RunSuite(AgentStudyCommand):
    """The suite defines scenarios, costs, speeds and seeds.

    An agent's score in a task is the mean total time of the clairvoyant bound divided by the agent's own; its score in
    the suite is the mean over the tasks, at most 1.
    """

    examples = """
        parkenv benchmark run v2 --agents belief,mdp --out results/v2
        parkenv benchmark run v2 --places --agents belief,mdp --out results/v2-places
        parkenv benchmark check results/v2/result.json
        """

    suite: str = option("v2", "The suite.", name="SUITE", argument=True)
    places: bool = option(
        False,
        "Run the places of the suite instead of its packaged scenarios: 24 real car parks that agents are "
        "never trained on (the suite v2-places).",
    )
    study: Benchmark = Benchmark()
    out: Path | None = option(
        None, "Folder for result.json and the episodes.", short="-o", default="results/SUITE"
    )

    @classmethod
    def of(cls, given: Given) -> Self:
        """See `StudyCommand`."""
        suite = f"{given.get('SUITE', 'v2')}{PLACES if '--places' in given else ''}"
        command = super().of({"--out": f"results/{suite}", **given})
        return command.changed(study=command.study.changed(suite=suite))

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

    examples = "parkenv benchmark check results/v2/result.json others.json"

    results: Several[Path] = option(..., "Result files.", takes="FILE", argument=True)

    def run(self) -> None:
        """See `Command`."""
        from parkenv.studies.benchmark.result_file import check_result

        console = make_console()
        with console.status("Checking"):
            checked = [check_result(file) for file in self.results]
        if len({result["suite"] for result in checked}) > 1:
            raise InputError("the results are of different suites; check those of one at a time")
        _print(console, checked)
        console.print(f"{'Complete and consistent' if len(checked) == 1 else 'All complete and consistent'}.")


class Page(Command):
    """The page needs no network and no other file. Click a heading to sort its table.

    A result that fails `parkenv benchmark check`, or whose agents are not part of parkenv and have no address of their
    code, is refused, and no page is written.
    """

    examples = """
        parkenv benchmark page results/v2 yours/result.json --out v2.html
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
        """See `Command`."""
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

    examples = """
        parkenv benchmark show v2
        parkenv benchmark show v2 --places
        """

    suite: str = option("v2", "The suite.", name="SUITE", argument=True)
    places: bool = option(False, "Show the places of the suite instead of its packaged scenarios.")

    def run(self) -> None:
        """See `Command`."""
        from parkenv.studies.benchmark.suite import SUITES, Suite

        its = Suite.named(self.suite + PLACES if self.places else self.suite)
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
        counts = [len(its.seeds_of(task)) for task in its.tasks]
        if its.seeds:
            drawn = f"{counts[0]} episodes a task, seeds {its.seeds[0]} to {its.seeds[-1]}"
        else:
            drawn = (
                f"{min(counts)} to {max(counts)} episodes a task, {sum(counts):,} in all, weighted by stratum"
            )
        console.print(f"{drawn}; suite {its.fingerprint[:16]}")
        if its.name + PLACES in SUITES:
            console.print(f"Its places, real car parks: parkenv benchmark show {its.name} --places")


def _print(console: Console, results: list[dict[str, Any]]) -> None:
    from parkenv.studies.benchmark.result_file import by_group

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
