"""`parkenv compare`: compare agents in the same worlds; `parkenv plan`: what the thesis's planner intends."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

from pydantic import Field

from parkenv.cli.options import Command, Given
from parkenv.cli.study_command import AgentStudyCommand, Rerun
from parkenv.cli.tables import WIDE, make_console, make_table, print_recorded, save_summary
from parkenv.errors import InputError
from parkenv.files.option import Inside, option
from parkenv.scenarios.spec import scenario_spec
from parkenv.show.plurals import number_text, plural
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.comparison import Comparison, Grid
from parkenv.studies.fields import TRAFFIC, OneAgent, OneScenario, Seed
from parkenv.studies.results import Row
from parkenv.world.cost_terms import COST_TERMS

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from parkenv.studies.compare.cases import Case
    from parkenv.studies.runner import Result

LEVELS = (0.5, 0.7, 0.8, 0.9, 0.95, 0.99)
"""Default occupancy levels of a comparison."""
MOST_TABLES = 12
"""Maximum number of settings to print; see the figures and files for larger grids."""


class Compare(AgentStudyCommand):
    """Episode i has the same seed for every agent, hence the same cars at the same times.

    The table gives the mean total time (drive + failed attempts + walk) with its 95 % interval, the paired difference
    to the first agent, and the regret to the clairvoyant bound. Options are shortcuts for an experiment file, which
    `parkenv run` takes.
    """

    examples = """
        parkenv compare --scenario campus,jam --failure-cost 10,90 --out results
        parkenv compare --agents "mdp(failure_s=90),belief,oracle" --report
        parkenv compare --agents mdp,mdp-tuned,oracle --failure-cost sweep
        parkenv compare --scenario lots --largest 5 --report
        parkenv compare --lot lot.geojson --occupancy log.csv.gz -n 300
        parkenv compare --resume --episodes 1000
        """

    study: Comparison = Comparison().changed(grid={"occupancy_levels": LEVELS})
    largest: int | None = option(
        None, "Of the scenarios, only those with the N largest lots.", panel="World", default="all", ge=1
    )
    rerun: Rerun = None
    out: Path = option(
        Path("results/compare"),
        "Folder for experiment.json, episodes.csv, summary.json and the figures.",
        short="-o",
    )

    @classmethod
    def of(cls, given: Given) -> Self:
        """See `StudyCommand`; a sweep of failure costs has no occupancy levels, and also blind searches."""
        command = super().of(given)
        study, sweep = command.study, given.get("--failure-cost") == "sweep"
        if sweep and "--occupancy-levels" not in given and not command.resume:
            study = study.changed(grid=study.grid.changed(occupancy_levels=()))
        if sweep or ("--failure-cost" in given and study.grid.blind):
            study = study.changed(grid=study.grid.changed(blind=sweep))
        if command.largest is not None:
            from parkenv.scenarios.build import largest_lots

            study = study.changed(scenarios=tuple(largest_lots(study.scenarios, command.largest)))
        return command.changed(study=study)

    def run(self) -> None:
        """See `Command`; also record the first episode on request."""
        if self.rerun is not None:
            from parkenv.studies.trips.sensor_log import require_viewer

            if self.study.rig is None:
                raise InputError("--rerun records what sensors measure: add --rig laser")
            require_viewer()
        super().run()
        if self.rerun is not None:
            console = make_console()
            with console.status(f"Running the first episode once more for {self.rerun}"):
                _record(*self.study.cases[0], self.rerun)
            print_recorded(console, self.rerun)

    def show(self, console: Console, result: Result) -> None:
        """Print the tables of a comparison."""
        from parkenv.world.scenario import KMH

        count = setting_count(result.rows)
        few = count <= MOST_TABLES
        tables = result_tables(result.rows, console.width) if few else cost_tables(result.rows)
        for printed in tables if few or len(tables) <= MOST_TABLES else []:
            console.print(printed)
        if not few:
            console.print(f"{count} settings: intervals and paired differences are in summary.json")
        if (measured := result.summary.get("calibrated")) is not None:
            console.print(
                f"Calibrated over {plural(measured['trips'], 'trip')}: failure cost {measured['failure_s']:.4g} s, "
                f"drive {measured['v_drive'] / KMH:.4g} km/h. Parking takes {measured['manoeuvre_s']:.1f} s more for "
                "the manoeuvre into the slot, under either cost; the tables leave that out."
            )


def setting_count(rows: list[Row]) -> int:
    """Return the number of different scenarios and settings in rows."""
    return len({(r["scenario"], r["failure_cost_s"], r["v_walk_kmh"], r["v_drive_kmh"]) for r in rows})


def _record(case: Case, seeds: Sequence[int], path: Path) -> None:
    """Record the first episode of a case with its sensors."""
    from parkenv.envs.perception import SearchPerceptionEnv
    from parkenv.studies.trips.sensor_log import record_search, sensor_log
    from planners.agent import make_agent

    env = SearchPerceptionEnv(case.scenario, rig=str(case.rig), detector=case.detector)
    with sensor_log(path, case.scenario.lot, env.rig) as log:
        record_search(env, make_agent(case.agent, env.scenario, **case.options), seeds[0], log)


Column = tuple[str, Callable[[Row], str]]

_DETAILS: tuple[Column, ...] = (
    ("parked", lambda r: f"{r['parked_fraction']:.0%}"),
    ("replans", lambda r: f"{r['replans']:.1f}"),
    ("ms/decision", lambda r: f"{r['decision_ms']:.2f}" if "decision_ms" in r else ""),
    ("p99 ms", lambda r: f"{r['decision_ms_p99']:.2f}" if "decision_ms" in r else ""),
)
_OF_GIVING_UP: tuple[Column, ...] = (
    ("median s", lambda r: _seconds(r["median_s"])),
    ("found no slot", lambda r: f"{r['gave_up_fraction']:.0%}"),
)


def result_tables(rows: list[Row], width: int) -> list[Table]:
    """Make the tables of each setting: one, or two if the terminal is narrow."""
    settings: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        key = (row["scenario"], row["failure_cost_s"], row["v_walk_kmh"], row["v_drive_kmh"])
        settings.setdefault(key, []).append(row)
    tables, short = [], _short_labels(row["agent"] for row in rows)
    for (name, failure, walk, drive), its_rows in settings.items():
        first = its_rows[0]["agent"]
        results: tuple[Column, ...] = (
            ("total s [95 %]", lambda r: _interval(r["total_s"], r["total_s_ci95"])),
            *(_OF_GIVING_UP if any(row["gave_up_fraction"] for row in its_rows) else ()),
            (f"minus {short[first]} [95 %]", lambda r, a=first: _difference(r, a)),  # type: ignore[misc]
            ("regret s", lambda r: _seconds(r["regret_s"])),
        )
        if any("gap_to_exact" in row for row in its_rows):
            results = (*results, ("over exact", lambda r: number_text(r["gap_to_exact"], "+.2%")))
        title = (
            f"{name}: failure cost {failure:g} s, walk {walk:g} km/h, drive {drive:g} km/h, "
            f"{plural(max(r['episodes'] for r in its_rows), 'episode')}"
        )
        details = (*_cost_columns(its_rows), *_DETAILS)
        for columns in [results + details] if width >= WIDE else [results, details]:
            headings = ("agent", *(heading for heading, _ in columns))
            cells = ((short[row["agent"]], *(text(row) for _, text in columns)) for row in its_rows)
            tables.append(make_table(title if columns is not details else None, headings, cells))
    return tables


def cost_tables(rows: list[Row]) -> list[Table]:
    """Make the tables of mean total times by failure cost: one of each scenario and speeds."""
    grids: dict[tuple[Any, ...], dict[str, dict[float, str]]] = {}
    for row in rows:
        grid = grids.setdefault((row["scenario"], row["v_walk_kmh"], row["v_drive_kmh"]), {})
        grid.setdefault(row["agent"], {})[row["failure_cost_s"]] = _seconds(row["total_s"])
    tables, short = [], _short_labels(row["agent"] for row in rows)
    for (name, walk, drive), grid in grids.items():
        costs = sorted({cost for cells in grid.values() for cost in cells})
        title = f"{name}: mean total time, s, by failure cost, s; walk {walk:g} km/h, drive {drive:g} km/h"
        cells = ((short[agent], *(its.get(cost, "") for cost in costs)) for agent, its in grid.items())
        tables.append(make_table(title, ("agent", *(f"{cost:g}" for cost in costs)), cells))
    return tables


def _short_labels(agents: Iterable[str]) -> dict[str, str]:
    """Return labels without the folders of files, or whole where two agents would have the same."""
    short = {agent: re.sub(r":[^()]*[/\\]", ":", agent) for agent in agents}
    times = Counter(short.values())
    return {agent: label if times[label] == 1 else agent for agent, label in short.items()}


def _cost_columns(rows: Sequence[Row]) -> Iterator[Column]:
    """Yield a column for each term of the costs, but for optional ones that are 0."""
    for term in COST_TERMS:
        if not term.optional or any(row[term.field] for row in rows):
            yield f"{term.name.replace('_', ' ')} s", lambda row, field=term.field: _seconds(row[field])  # type: ignore[misc]


def _difference(row: Row, first_agent: str) -> str:
    if row["agent"] == first_agent:
        return ""
    return _interval(row["difference_s"], row["difference_s_ci95"], signed=True)


def _interval(mean: float, ends: list[float], *, signed: bool = False) -> str:
    if ends[0] != ends[0]:
        return _seconds(mean, signed)
    return f"{_seconds(mean, signed)} [{_seconds(ends[0], signed)}, {_seconds(ends[1], signed)}]"


def _seconds(value: float, signed: bool = False) -> str:
    return number_text(value, f"{'+' if signed else ''}{'.0f' if abs(value) >= 1000 else '.1f'}")


class Plan(Command):
    """The picture shows the true occupancy (inner disc) and the forecast (outer ring) of each slot.

    It also shows the planned action at each vertex (arrow), the path driven with replanning, and the walk.
    """

    examples = """
        parkenv plan --scenario jam --failure-cost 10,90
        parkenv plan --scenario campus --failure-cost 90 --v-walk-kmh 4,10
        """

    scenario: Annotated[OneScenario, Inside(without=TRAFFIC)] = scenario_spec("campus")
    agent: OneAgent = Field(
        AgentSpec(name="mdp"),
        description="mdp or mdp-static, with any options in brackets: mdp(failure_s=90).",
    )
    seed: Seed = Field(0, description="Seed of the world.")
    grid: Annotated[Grid, Inside(only=("--failure-cost", "--v-walk-kmh", "--v-drive-kmh"))] = Grid()
    out: Path = option(Path("results/plan"), "Folder for plan.png and summary.json.", short="-o")

    def run(self) -> None:
        """See `Command`."""
        from parkenv.files.atomic_write import make_folder
        from parkenv.scenarios.build import build
        from parkenv.show.figures.picture_files import save_picture
        from parkenv.show.figures.searches import draw_searches
        from parkenv.studies.compare.plans import plan_searches

        console = make_console()
        with console.status("Planning"):
            rows, traces = plan_searches(build(self.scenario), self.agent, self.grid, self.seed)
            make_folder(self.out)
            save_picture(draw_searches(traces), self.out / "plan.png")
        save_summary(self.out, self.seed, rows)
        cells = (
            (
                f"{row['failure_cost_s']:g}", f"{row['v_walk_kmh']:g}", f"{row['v_drive_kmh']:g}",
                f"{row['expected_s']:.1f}", f"{row['total_s']:.1f}", f"{row['driven_m']:.0f}", row["slot"],
                f"{row['walked_m']:.0f}", str(row["replans"]),
            )
            for row in rows
        )  # fmt: skip
        headings = (
            "failure s", "walk km/h", "drive km/h", "expected s", "took s", "driven m", "slot", "walked m", "replans",
        )  # fmt: skip
        title = f"{self.scenario.title}: plans of {self.agent.label}, seed {self.seed}"
        console.print(make_table(title, headings, cells))
        console.print(f"Picture and summary are in {self.out}")


class Pomdp(Command):
    """The file holds the model of the planner exact: while the car searches, slots stay as they are.

    They are observed without error, and the level and the slope of the day are on a grid. A move is a step; a reward is
    minus its seconds.

    Each slot doubles the number of states, so the lot has to be small: mini, of ten slots, has 12,289.
    """

    examples = """
        parkenv pomdp --scenario mini --out mini.pomdp
        parkenv pomdp --lot small.geojson --seed 3 --discount 0.999 --out small.pomdp
        """

    scenario: Annotated[OneScenario, Inside(without=TRAFFIC)] = scenario_spec("mini")
    seed: Seed = Field(0, description="Seed of the entry and the time of arrival.")
    discount: float = option(1.0, "Discount of each step; many solvers want less than 1.", gt=0.0, le=1.0)
    out: Path = option(..., "File to write.", short="-o", takes="FILE.pomdp")

    def run(self) -> None:
        """See `Command`."""
        import gymnasium as gym

        from parkenv.scenarios.build import build
        from planners.bounds.pomdp_file import write_first

        scenario = build(self.scenario)
        observation, _ = gym.make("parkenv/Search-v2", scenario=scenario).reset(seed=self.seed)
        console = make_console(soft_wrap=True)
        with console.status("Writing"):
            size, expected_s = write_first(self.out, scenario.public(), observation, self.discount)
        console.print(
            f"Wrote {self.out}: {size.n_states:,} states, {size.n_actions} actions, "
            f"{plural(size.n_observations, 'observation')}. Least expected time, by exact: {expected_s:.6f} s"
        )
