"""`parkenv benchmark`: a fixed suite with comparable, checkable results."""

from pathlib import Path

from parkenv.cli.options import Command
from parkenv.cli.tables import command_line, print_rows, print_table
from parkenv.files.atomic_write import make_folder
from parkenv.files.known_names import SuiteName
from parkenv.files.option import option
from parkenv.files.spec_file import Several
from parkenv.show.tables import Column, plural, shared
from parkenv.studies.benchmark.study import score_table


class Check(Command):
    """Every episode must be present. The command recomputes means, scores and the clairvoyant bounds of all episodes.

    A total time below the bound means another world, other costs or other speeds. The times of an agent cannot be
    verified without running it.
    """

    examples = "parkenv benchmark check results/v3/result.json others.json"

    results: Several[Path] = option(..., "Result files.", takes="FILE", argument=True)

    def run(self) -> None:
        from parkenv.studies.benchmark.suite import check_result

        with self.console.status("Checking"):
            checked = [check_result(file) for file in self.results]
        print_table(self.console, score_table(checked))
        self.say(f"{'Complete and consistent' if len(checked) == 1 else 'All complete and consistent'}.")


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
        from parkenv.show.report.page import write_page
        from parkenv.studies.benchmark.page import benchmark_data, result_files
        from parkenv.studies.benchmark.suite import check_result

        files = [file for path in self.results for file in result_files(path)]
        make_folder(self.out.parent)
        with self.console.status("Checking"):
            checked = [check_result(file) for file in files]
        write_page(benchmark_data(checked, command_line()), self.out)
        agents = sum(len(result["scores"]) for result in checked)
        self.say(f"Written: {self.out}, {plural(agents, 'agent')} in {plural(len(checked), 'result')}")


class Show(Command):
    """For each task: scenario, slots, goal, arrival, mean occupancy, day error, sensor model and walking speed."""

    examples = "parkenv benchmark show streets-v1"

    suite: SuiteName = option("v3", "The suite.", argument=True)

    def run(self) -> None:
        from parkenv.studies.benchmark.suite import Suite

        suite = Suite.packaged(self.suite)
        self.say(f"{suite.name}: {suite.description}")
        rows = []
        for task in suite.tasks:
            scenario, level = task.made(suite.arrival), task.occupancy_level
            rows.append(
                {
                    "task": task.name,
                    "scenario": task.scenario,
                    "slots": scenario.lot.n_slots,
                    "goal": scenario.goal,
                    "arrival": "the suite's" if task.arrival is None else f"{task.days} {task.arrival}",
                    "mean_occupancy": "as it comes" if level is None else f"{level:.0%}",
                    "day_error": ", ".join(f"{size:g}" for size in task.day_error),
                    "sensor_model": task.sensor_model,
                    "v_walk_kmh": scenario.v_walk * 3.6,
                }
            )
        print_rows(
            self.console,
            "Tasks",
            rows,
            columns=(Column("task", "task"), *shared("scenario"), Column("slots", "slots")),
        )
        counts = [len(task.seeds) for task in suite.tasks]
        self.say(
            f"{min(counts)} to {max(counts)} episodes a task, {sum(counts):,} in all, weighted by stratum; "
            f"suite {suite.fingerprint[:16]}"
        )
