"""`parkenv benchmark`: fixed suites with comparable, checkable results."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from parkenv import __version__
from parkenv.cli import arguments as args
from parkenv.cli.compare import episode_progress
from parkenv.cli.tables import make_console, make_table
from parkenv.cli.trust import TrustModelOption, TrustOption, readable_models, require_trust
from parkenv.errors import InputError

if TYPE_CHECKING:
    from parkenv.evaluation.experiments.spec import BenchmarkSpec

RESULT = "result.json"

app = typer.Typer(
    help="Run a fixed benchmark suite, and check the results of others.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)


@app.command("run")
def run(
    suite: Annotated[str, typer.Argument(help="The suite; `parkenv benchmark show v1` describes it.")] = "v1",
    agents: args.AgentsOption = None,
    jobs: args.JobsOption = 0,
    backend: args.BackendOption = "loky",
    address: args.AddressOption = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help=f"Folder for {RESULT} and the episodes.  [default: results/SUITE]"),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Finish the run in --out. It needs no other option.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the results in --out.")] = False,
    trust: TrustOption = False,
    trust_model: TrustModelOption = False,
) -> None:
    """Run agents through all episodes of a suite, and write a result that others can check.

    The suite defines scenarios, costs, speeds and seeds. An agent's score in a task is the mean total time of the
    clairvoyant bound divided by the agent's own; its score in the suite is the mean over the tasks, at most 1.

    Examples:
    * `parkenv benchmark run v1 --agents belief,mdp --out results/v1`

    * `parkenv benchmark check results/v1/result.json`
    """
    from parkenv.evaluation.experiments.agent_spec import split_agents
    from parkenv.evaluation.experiments.spec import SPEC_FILE, BenchmarkSpec

    out = out or Path("results") / suite
    base = args.saved(out, SPEC_FILE, BenchmarkSpec) if resume else BenchmarkSpec()
    if agents is None:
        require_trust(base, out, trust)
    given = {} if agents is None else {"agents": readable_models(split_agents(agents), trust_model)}
    spec = base.changed(suite=suite, jobs=jobs, backend=backend, address=address, **given)
    run_suite(spec, out, resume=resume, overwrite=overwrite)


def run_suite(spec: BenchmarkSpec, out: Path, *, resume: bool = False, overwrite: bool = False) -> None:
    """Run a suite with a progress bar, write its result and print the scores.

    Raises:
        InputError: an agent cannot be made, or the folder cannot be used.
    """
    from parkenv.evaluation.experiments.benchmark import Suite, result_of
    from parkenv.evaluation.experiments.compare import run_cases
    from parkenv.evaluation.experiments.experiment import agent_fingerprints
    from parkenv.evaluation.experiments.results import ResultFolder, write_summary
    from parkenv.evaluation.experiments.spec import SPEC_FILE

    suite = Suite.named(spec.suite)
    cases = suite.cases(spec.agents)
    settings = {
        "version": __version__,
        "suite": suite.name,
        "suite_sha256": suite.fingerprint,
        "agent files": agent_fingerprints(case.agent for case, _ in cases),
    }
    console = make_console()
    complete = True
    with (
        args.workers_of(spec.jobs, spec.backend, spec.address) as workers,
        episode_progress(console) as progress,
    ):
        folder = ResultFolder(out, settings, resume=resume, overwrite=overwrite)
        spec.write(out / SPEC_FILE)
        bar = progress.add_task("Searching", total=sum(len(seeds) for _, seeds in cases))
        try:
            run_cases(cases, folder, workers=workers, on_progress=lambda n: progress.advance(bar, n))
        except KeyboardInterrupt:
            complete = False
    order = [case.key(seed) for case, seeds in cases for seed in seeds]
    command = ["parkenv", *sys.argv[1:]]
    if not complete:
        folder.finish(order, {"command": command, "complete": False}, complete=False)
        console.print(f"Interrupted. What was finished is in {out}; --resume --out {out} goes on.")
        raise typer.Exit(130)
    result = result_of(suite, cases, folder, command)
    folder.finish(
        order, {"command": command, "version": __version__, "complete": True, "rows": result["rows"]}
    )
    write_summary(out, result, RESULT)
    _print(console, [result])
    console.print(f"Written: {out / RESULT}, and every episode beside it")


@app.command("check")
def check(
    files: Annotated[list[Path], typer.Argument(help="Result files.")],
) -> None:
    """Check that results are complete and from the suite's own worlds, and print them side by side.

    Every search must be present. Means, scores and the clairvoyant bounds of all searches are recomputed; the bounds
    differ in other worlds or at other costs and speeds. The times of an agent cannot be verified without running it.
    """
    from parkenv.evaluation.experiments.benchmark import check_result

    console = make_console()
    with console.status("Checking"):
        results = [check_result(file) for file in files]
    if len({result["suite"] for result in results}) > 1:
        raise InputError("the results are of different suites; check those of one at a time")
    _print(console, results)
    console.print(f"{'Complete and consistent' if len(files) == 1 else 'All complete and consistent'}.")


@app.command("show")
def show(suite: Annotated[str, typer.Argument(help="The suite.")] = "v1") -> None:
    """Show the tasks and settings of a suite."""
    from parkenv.evaluation.experiments.benchmark import Suite

    its = Suite.named(suite)
    console = make_console()
    console.print(f"{its.name}: {its.description}")
    table = make_table(None, ["task", "scenario", "slots", "mean occupancy", "sight", "walking"])
    for task in its.tasks:
        made = task.made(its.arrival)
        level = "as it comes" if task.occupancy_level is None else f"{task.occupancy_level:.0%}"
        table.add_row(
            task.name, task.scenario, str(made.lot.n_slots), level, task.sight, f"{made.v_walk * 3.6:g} km/h"
        )
    console.print(table)
    console.print(
        f"{len(its.seeds)} searches a task, seeds {its.seeds[0]} to {its.seeds[-1]}; suite {its.fingerprint[:16]}"
    )


def _print(console: Console, results: list[dict[str, Any]]) -> None:
    tasks = list(dict.fromkeys(row["task"] for result in results for row in result["rows"]))
    table = make_table("Mean total time, s, and the score", ["agent", *tasks, "score"])
    lines = []
    for result in results:
        mean = {(row["agent"], row["task"]): row["total_s"] for row in result["rows"]}
        for agent, score in result["scores"].items():
            lines.append((score, agent, [f"{mean[agent, task]:.1f}" for task in tasks]))
    for score, agent, cells in sorted(lines, key=lambda line: -line[0]):
        table.add_row(agent, *cells, f"{score:.4f}")
    console.print(table)
