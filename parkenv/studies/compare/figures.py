"""The figures of a comparison.

To add one, write a function that takes `ComparisonResults` and yields (scenario, setting, figure), and add a line to
`FIGURES`. `parkenv compare` writes it to `NAME_SCENARIO_SETTING.png`, and the report shows it under its caption.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from parkenv.compiled.arrays import FloatArray
from parkenv.files.file_names import file_name
from parkenv.files.known_names import UNBEATEN
from parkenv.scenarios.selection import BLIND
from parkenv.show.columns import SETTING_AXES
from parkenv.show.figures.picture_files import save_picture
from parkenv.show.figures.searches import draw_searches
from parkenv.show.figures.times import (
    BOUND,
    draw_time_against_decision_time,
    draw_time_against_failure_cost,
    draw_time_against_map,
    draw_time_against_occupancy,
    draw_time_distribution,
    draw_time_split,
)
from parkenv.studies.compare.cases import Case, against_occupancy

Row = Mapping[str, Any]
Setting = tuple[float, float, float]
"""Failure cost, s, walking and driving speed, km/h."""
Drawn = tuple[str, Setting | None, Figure]
"""What a figure shows: a scenario, or \"\" for several; a setting, or None for several; and the figure."""


PICTURED = ("belief", "oracle", "first-free", "greedy-goal")
"""Agents whose paths are drawn beside those of the first and of the fastest agent, the most interesting first."""
MOST_PICTURED = 4
OCCUPANCY_BINS = (0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0001)
"""Bin edges for averaging episodes if the run has no occupancy levels."""


@dataclass(frozen=True)
class ComparisonResults:
    """Results from which the figures of a comparison are drawn.

    Attributes:
        cases: cases, each with the seeds of its episodes.
        episodes: finished episodes, rows of `episodes.csv` by `Case.key`.
        rows: rows of the table, one per case with finished episodes.
        occupancy_rows: the same at the occupancy levels.
        flat_forecasts: scenarios with the same forecast for every slot: the scenario that each is a variant of, and
            the probability.
        seed: seed of the episode shown in pictures of single searches.
    """

    cases: Sequence[tuple[Case, Sequence[int]]]
    episodes: Mapping[tuple[Any, ...], Row]
    rows: Sequence[Row]
    occupancy_rows: Sequence[Row] = ()
    flat_forecasts: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    seed: int = 0

    @property
    def scenarios(self) -> list[str]:
        """Names, in order, without the variants of flat forecasts and of failure-cost sweeps."""
        names = dict.fromkeys(row["scenario"] for row in self.rows)
        sweep = {name for name in names if f"{name}{BLIND}" in names}
        return [n for n in names if n.removesuffix(BLIND) not in sweep and n not in self.flat_forecasts]

    @property
    def failure_cost_sweeps(self) -> list[str]:
        """Names of the scenarios that were also run without observations of slots."""
        names = dict.fromkeys(row["scenario"] for row in self.rows)
        return [name for name in names if f"{name}{BLIND}" in names]

    def rows_of(self, scenario: str) -> list[Row]:
        """Return the table's rows of a scenario."""
        return [row for row in self.rows if row["scenario"] == scenario]

    def episodes_of(self, case: Case, seeds: Sequence[int]) -> list[Row]:
        """Return the finished episodes of a case."""
        return [self.episodes[key] for seed in seeds if (key := case.key(seed)) in self.episodes]


def time_splits(results: ComparisonResults) -> Iterator[Drawn]:
    """Yield `draw_time_split` of each scenario."""
    for name in results.scenarios:
        yield name, None, draw_time_split(results.rows_of(name))


def times_against_occupancy(results: ComparisonResults) -> Iterator[Drawn]:
    """Yield `draw_time_against_occupancy` of each scenario, at the first speeds."""
    for name in results.scenarios:
        rows = [
            {**row, "occupancy": row["occupancy_level"]}
            for row in results.occupancy_rows
            if row["scenario"] == name
        ]
        about = ""
        if not rows:
            cases = [(case, seeds) for case, seeds in results.cases if case.scenario.name == name]
            speeds = cases[0][0].scenario.v_walk, cases[0][0].scenario.v_drive
            if len({(case.scenario.v_walk, case.scenario.v_drive) for case, _ in cases}) > 1:
                about = f", walking at {3.6 * speeds[0]:g} and driving at {3.6 * speeds[1]:g} km/h"
            episodes = [
                episode
                for case, seeds in cases
                if (case.scenario.v_walk, case.scenario.v_drive) == speeds
                for episode in results.episodes_of(case, seeds)
            ]
            rows = against_occupancy(episodes, OCCUPANCY_BINS)
        if rows:
            yield name, None, draw_time_against_occupancy(rows, about)


def times_against_failure_cost(results: ComparisonResults) -> Iterator[Drawn]:
    """Yield `draw_time_against_failure_cost` of each scenario of a sweep."""
    for name in results.failure_cost_sweeps:
        yield name, None, draw_time_against_failure_cost(results.rows_of(name), results.rows_of(name + BLIND))


def times_against_map(results: ComparisonResults) -> Iterator[Drawn]:
    """Yield `draw_time_against_map` of each scenario with flat forecasts, at the first cost and speeds."""
    forecasts = results.flat_forecasts
    if not forecasts:
        return
    setting = {c: results.rows[0][c] for c in SETTING_AXES}
    rows = [row for row in results.rows if setting.items() <= row.items()]
    for name in dict.fromkeys(varied for varied, _ in forecasts.values()):
        probability = {flat: p for flat, (varied, p) in forecasts.items() if varied == name}
        flat = [row for row in rows if row["scenario"] in probability]
        own = [row for row in rows if row["scenario"] == name]
        yield name, None, draw_time_against_map(flat, own, probability)


def time_distributions(results: ComparisonResults) -> Iterator[Drawn]:
    """Yield a figure for each setting of costs and speeds, with a panel per scenario.

    The clairvoyant lower bound is added if the oracle is not among the agents.
    """
    settings: dict[Setting, dict[str, dict[str, FloatArray]]] = {}
    for case, seeds in results.cases:
        episodes = results.episodes_of(case, seeds)
        c = case.columns
        if not episodes or c["scenario"] not in results.scenarios:
            continue
        panels = settings.setdefault(tuple(c[name] for name in SETTING_AXES), {})
        totals = panels.setdefault(c["scenario"], {})
        totals[case.label] = np.array([episode["total_s"] for episode in episodes])
        totals[BOUND] = np.array([episode["bound_s"] for episode in episodes])
    for setting, panels in settings.items():
        for totals in panels.values():
            bound = totals.pop(BOUND)
            if "oracle" not in totals:
                totals[BOUND] = bound
        yield "", setting, draw_time_distribution(panels)


def searches(results: ComparisonResults) -> Iterator[Drawn]:
    """Yield `draw_searches` for each scenario and setting: some agents in the same world.

    These are the first agent, the fastest one, and those in `PICTURED`; at most `MOST_PICTURED`.
    """
    settings: dict[tuple[str, Setting], list[Case]] = {}
    for case, _ in results.cases:
        if case.scenario.name in results.scenarios:
            c = case.columns
            setting = tuple(c[name] for name in SETTING_AXES)
            settings.setdefault((c["scenario"], setting), []).append(case)
    totals = {(*_setting_of(row), row["agent"]): row["total_s"] for row in results.rows}
    for (name, setting), cases in settings.items():
        acting = [case for case in cases if case.agent not in UNBEATEN]
        fastest = min(
            acting,
            key=lambda case: totals.get((*_setting_of(case.columns), case.label), np.inf),
            default=cases[0],
        )
        wanted = [cases[0], fastest, *(c for word in PICTURED for c in cases if c.agent == word)]
        labels = list(dict.fromkeys(case.label for case in wanted))[:MOST_PICTURED]
        drawn = [case for case in cases if case.label in labels]
        yield name, setting, draw_searches([case.runner().run(results.seed) for case in drawn])


def times_against_decision_time(results: ComparisonResults) -> Iterator[Drawn]:
    """Yield a figure for each setting of costs and speeds in which agents plan for different times."""
    settings: dict[Setting, dict[str, list[Row]]] = {}
    for row in results.rows:
        if row["scenario"] in results.scenarios and "decision_ms" in row:
            panels = settings.setdefault(tuple(row[name] for name in SETTING_AXES), {})
            panels.setdefault(row["scenario"], []).append(row)
    for setting, panels in settings.items():
        if len({row.get("budget_ms") for rows in panels.values() for row in rows} - {None}) > 1:
            yield "", setting, draw_time_against_decision_time(panels)


def _setting_of(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(row[name] for name in ("scenario", *SETTING_AXES))


@dataclass(frozen=True)
class ComparisonFigure:
    """One kind of figure.

    Attributes:
        name: prefix of the file names.
        caption: caption in reports.
        draw: yields the figures of a comparison; none if the figure does not apply.
    """

    name: str
    caption: str
    draw: Callable[[ComparisonResults], Iterator[Drawn]]

    def named(self, results: ComparisonResults) -> Iterator[tuple[str, str, Figure]]:
        """Yield file name (without suffix), caption and figure."""
        for scenario, setting, figure in self.draw(results):
            names, words = [scenario] * bool(scenario), [scenario] * bool(scenario)
            if setting is not None:
                names.append("failure{:g}_walk{:g}_drive{:g}".format(*setting))
                words.append("failure cost {:g} s, walk {:g} km/h, drive {:g} km/h".format(*setting))
            yield "_".join([self.name, *names]), f"{self.caption}: {', '.join(words)}", figure


FIGURES = (
    ComparisonFigure("time_split", "Where the time goes", time_splits),
    ComparisonFigure("time_distribution", "How many searches took at most how long", time_distributions),
    ComparisonFigure(
        "time_against_occupancy", "The fuller the lot, the longer it takes", times_against_occupancy
    ),
    ComparisonFigure("time_against_failure_cost", "What failed attempts cost", times_against_failure_cost),
    ComparisonFigure("time_against_map", "If the forecast is the same for every slot", times_against_map),
    ComparisonFigure(
        "time_against_decision_time", "What time to think is worth", times_against_decision_time
    ),
    ComparisonFigure("searches", "Searches on the same day", searches),
)
"""All figures, in the order of reports."""


def draw_figures(results: ComparisonResults, folder: Path, names: Sequence[str] | None = None) -> list[Path]:
    """Draw the figures of a comparison to PNG files."""
    files = []
    for kind in FIGURES:
        if names is None or kind.name in names:
            for name, caption, figure in kind.named(results):
                files.append(folder / file_name(name, ".png"))
                save_picture(figure, files[-1], caption)
    return files


def remove_figures(folder: Path) -> None:
    """Delete the figures of an earlier comparison from a folder."""
    for picture in folder.glob("*.png"):
        if picture.name.startswith(tuple(f"{kind.name}_" for kind in FIGURES)):
            picture.unlink()
