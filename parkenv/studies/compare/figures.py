"""The figures of a comparison, each a line of `FIGURES` that says which rows it shows."""

from collections import defaultdict
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
from parkenv.show.figures import times
from parkenv.show.figures.picture_files import save_picture
from parkenv.show.figures.searches import draw_searches
from parkenv.show.tables import SETTING_AXES
from parkenv.studies.compare.cases import Case, against_occupancy
from parkenv.world.scenario import KMH

Row = Mapping[str, Any]
Setting = tuple[float, ...]  # failure cost, s, walking and driving speed, km/h
# What figures show: a scenario, or "" for several; a setting, or () for several; and the figure.
Drawn = Iterator[tuple[str, Setting, Figure]]

# Agents whose paths are drawn beside those of the first and of the fastest agent, the most interesting first.
PICTURED = ("belief", "oracle", "first-free", "greedy-goal")
MOST_PICTURED = 4
# Bin edges for averaging episodes if the run has no occupancy levels.
OCCUPANCY_BINS = (0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0001)


@dataclass(frozen=True)
class ComparisonResults:
    cases: Sequence[tuple[Case, Sequence[int]]]
    episodes: Mapping[tuple[Any, ...], Row]
    rows: Sequence[Row]
    occupancy_rows: Sequence[Row] = ()
    # scenarios with the same forecast for every slot: the scenario that each is a variant of, and the probability
    flat_forecasts: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    seed: int = 0  # of the episode shown in pictures of single searches

    @property
    def sweeps(self) -> list[str]:
        """Names of the scenarios that were also run without observations of slots."""
        names = dict.fromkeys(row["scenario"] for row in self.rows)
        return [name for name in names if f"{name}{BLIND}" in names]

    @property
    def scenarios(self) -> list[str]:
        """Names, in order, without the variants of flat forecasts and of failure-cost sweeps."""
        names = dict.fromkeys(row["scenario"] for row in self.rows)
        return [n for n in names if n.removesuffix(BLIND) not in self.sweeps and n not in self.flat_forecasts]

    def rows_of(self, scenario: str) -> list[Row]:
        return [row for row in self.rows if row["scenario"] == scenario]

    def episodes_of(self, case: Case, seeds: Sequence[int]) -> list[Row]:
        return [self.episodes[key] for seed in seeds if (key := case.key(seed)) in self.episodes]


def _setting(row: Row) -> Setting:
    return tuple(row[name] for name in SETTING_AXES)


def _time_splits(results: ComparisonResults) -> Drawn:
    for name in results.scenarios:
        yield name, (), times.draw_time_split(results.rows_of(name))


def _times_against_occupancy(results: ComparisonResults) -> Drawn:
    """Yield a figure of each scenario, at the first speeds."""
    for name in results.scenarios:
        levels = [row for row in results.occupancy_rows if row["scenario"] == name]
        rows, about = [{**row, "occupancy": row["occupancy_level"]} for row in levels], ""
        if not rows:
            cases = [(case, seeds) for case, seeds in results.cases if case.scenario.name == name]
            speeds = [(case.scenario.v_walk, case.scenario.v_drive) for case, _ in cases]
            if len(set(speeds)) > 1:
                walk, drive = speeds[0]
                about = f", walking at {walk / KMH:g} and driving at {drive / KMH:g} km/h"
            first = [case for case, of_case in zip(cases, speeds, strict=True) if of_case == speeds[0]]
            episodes = [episode for case, seeds in first for episode in results.episodes_of(case, seeds)]
            rows = against_occupancy(episodes, OCCUPANCY_BINS)
        if rows:
            yield name, (), times.draw_time_against_occupancy(rows, about)


def _times_against_failure_cost(results: ComparisonResults) -> Drawn:
    for name in results.sweeps:
        blind = results.rows_of(name + BLIND)
        yield name, (), times.draw_time_against_failure_cost(results.rows_of(name), blind)


def _times_against_map(results: ComparisonResults) -> Drawn:
    """Yield a figure of each scenario with flat forecasts, at the first cost and speeds."""
    forecasts = results.flat_forecasts
    rows = [row for row in results.rows if _setting(row) == _setting(results.rows[0])]
    for name in dict.fromkeys(varied for varied, _ in forecasts.values()):
        probability = {flat: p for flat, (varied, p) in forecasts.items() if varied == name}
        flat = [row for row in rows if row["scenario"] in probability]
        own = [row for row in rows if row["scenario"] == name]
        yield name, (), times.draw_time_against_map(flat, own, probability)


def _time_distributions(results: ComparisonResults) -> Drawn:
    """Yield a figure of each setting, with the clairvoyant lower bound unless the oracle is among the agents."""
    settings: dict[Setting, dict[str, dict[str, FloatArray]]] = defaultdict(lambda: defaultdict(dict))
    bounds: dict[tuple[Setting, str], FloatArray] = {}
    for case, seeds in results.cases:
        episodes, scenario = results.episodes_of(case, seeds), case.scenario.name
        if episodes and scenario in results.scenarios:
            setting = _setting(case.columns)
            settings[setting][scenario][case.label] = np.array([row["total_s"] for row in episodes])
            bounds[setting, scenario] = np.array([row["bound_s"] for row in episodes])
    for setting, panels in settings.items():
        for scenario, totals in panels.items():
            if "oracle" not in totals:
                totals[times.BOUND] = bounds[setting, scenario]
        yield "", setting, times.draw_time_distribution(panels)


def _searches(results: ComparisonResults) -> Drawn:
    """Yield a figure of each scenario and setting: some agents in the same world.

    These are the first agent, the fastest one, and those in `PICTURED`; at most `MOST_PICTURED`.
    """
    settings: dict[tuple[str, Setting], list[Case]] = defaultdict(list)
    for case, _ in results.cases:
        if case.scenario.name in results.scenarios:
            settings[case.scenario.name, _setting(case.columns)].append(case)
    totals = {(row["scenario"], _setting(row), row["agent"]): row["total_s"] for row in results.rows}
    for where, cases in settings.items():
        acting = [case for case in cases if case.agent not in UNBEATEN] or cases[:1]
        fastest = min(acting, key=lambda case: totals.get((*where, case.label), np.inf))
        wanted = [cases[0], fastest, *(c for word in PICTURED for c in cases if c.agent == word)]
        labels = list(dict.fromkeys(case.label for case in wanted))[:MOST_PICTURED]
        records = [case.runner().run(results.seed) for case in cases if case.label in labels]
        yield *where, draw_searches(records)


# Caption of all figures of each kind and what draws them, by the prefix of their files, in the order of reports.
FIGURES: Mapping[str, tuple[str, Callable[[ComparisonResults], Drawn]]] = {
    "time_split": ("Where the time goes", _time_splits),
    "time_distribution": ("How many searches took at most how long", _time_distributions),
    "time_against_occupancy": ("The fuller the lot, the longer it takes", _times_against_occupancy),
    "time_against_failure_cost": ("What failed attempts cost", _times_against_failure_cost),
    "time_against_map": ("If the forecast is the same for every slot", _times_against_map),
    "searches": ("Searches on the same day", _searches),
}


def draw_figures(
    results: ComparisonResults, folder: Path, names: Sequence[str] = tuple(FIGURES)
) -> list[Path]:
    files = []
    for name in names:
        caption, draw = FIGURES[name]
        for scenario, setting, figure in draw(results):
            parts, words = [name, *[scenario] * bool(scenario)], [scenario] * bool(scenario)
            if setting:
                parts.append("failure{:g}_walk{:g}_drive{:g}".format(*setting))
                words.append("failure cost {:g} s, walk {:g} km/h, drive {:g} km/h".format(*setting))
            files.append(folder / file_name("_".join(parts), ".png"))
            save_picture(figure, files[-1], f"{caption}: {', '.join(words)}")
    return files


def remove_figures(folder: Path) -> None:
    for picture in folder.glob("*.png"):
        if picture.name.startswith(tuple(f"{name}_" for name in FIGURES)):
            picture.unlink()
