"""Curves fitted to the days of fleets at several demands, to call, and the files in which other models read them.

What a zone's searches are like is a monotone function of how lone searches fare there, how full it is around, how many
cars come, and both for the whole lot (gradient-boosted trees with monotone constraints, Poisson loss, over all zones),
times factors of the zone's own, shrunk towards 1 by as much as they may be chance (empirical Bayes). Of several towns,
search times are in units of the time to drive along all streets around a zone.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, partialmethod
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator
from scipy.optimize import nnls
from scipy.sparse import csr_matrix, vstack

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.errors import InputError, nearest, require, with_extra
from parkenv.files.atomic_write import write_text
from parkenv.files.csv_tables import write_csv
from parkenv.files.limited_reading import read_json
from parkenv.show.tables import Column
from parkenv.studies.curve.zones import INDEX, LONE, OF_CARS, STATE, SUMS, Zones
from parkenv.studies.fleet.day import ALL
from parkenv.studies.results import Row, Table, without_nan
from parkenv.studies.workers import SERIAL, Workers

CURVE, LONE_SEARCH = "curve", "lone search"
MAX_SAMPLING_ERROR = 0.3
FOLDS = 5  # parts of the zones, each of which is held out once
# Features that a curve may only grow with: `STATE`; not hour and purpose; the outcome of lone searches.
_GROWS, _PURPOSE = (1, 1, 1, 1, 0, 0, 1), 5
_TREES = {
    "max_iter": 80,
    "learning_rate": 0.12,
    "max_leaf_nodes": 12,
    "min_samples_leaf": 30,
    "l2_regularization": 1.0,
    "max_bins": 64,
}


class Outcome(NamedTuple):
    label: str
    total: Callable[[Mapping[str, FloatArray]], FloatArray]  # a sum for each car, of `OF_CARS`
    of: str  # the cars
    most: float = np.inf


OUTCOMES = {
    "search_s": Outcome("search time, s", lambda sums: sums["search_s"], "parked"),
    "walk_s": Outcome("walk, s", lambda sums: sums["walk_s"], "parked"),
    "failed_attempts": Outcome("failed attempts", lambda sums: sums["failed"], "cars"),
    "balked_fraction": Outcome(
        "share that finds no space", lambda sums: sums["cars"] - sums["parked"], "cars", 1.0
    ),
}
# Usual forms in the occupancy x: columns that are added with weights of at least 0, and the shapes b to try.
FORMS: Mapping[str, tuple[Callable[[FloatArray, float], list[FloatArray]], FloatArray]] = {
    "a/(1 - x)": (lambda x, _: [1.0 / (1.0 - np.minimum(x, 0.99))], np.zeros(1)),
    "t0 (1 + a x^b)": (lambda x, b: [np.ones(len(x)), x**b], np.linspace(1.0, 15.0, 29)),
    "a exp(b x)": (lambda x, b: [np.exp(b * x)], np.linspace(0.0, 15.0, 61)),
}
# What predicts searches: columns of errors.
PREDICTORS = {name: Column(name, name, share=True, digits=0) for name in (CURVE, LONE_SEARCH, *FORMS)}


def fit_form(name: str, x: FloatArray, y: FloatArray, weight: FloatArray) -> tuple[float, FloatArray]:
    columns, shapes = FORMS[name]
    bins = np.unique((200 * x).astype(int), return_inverse=True)[1]
    total = np.maximum(np.bincount(bins, weight), 1e-12)
    x, y = (np.bincount(bins, weight * values) / total for values in (x, y))
    root = np.sqrt(total)
    fits = [(*nnls(np.stack(columns(x, b), axis=1) * root[:, None], y * root), b) for b in shapes.tolist()]
    weights, _, b = min(fits, key=lambda fit: fit[1])
    return b, weights


def form_at(name: str, fit: tuple[float, FloatArray], x: FloatArray) -> FloatArray:
    return np.asarray(np.dot(fit[1], FORMS[name][0](x, fit[0])))


class Town(NamedTuple):
    zones: Zones
    purposes: Sequence[str]  # their names
    days: Sequence[Sequence[Row]]  # rows of `ZONES` by multiple and day
    usual: float = 1.0  # the multiple that is its own demand


@dataclass(frozen=True, eq=False)
class Paths:
    """Days of fleets: a path for each zone, purpose and hour in which cars come, through all multiples of demand."""

    towns: Mapping[str, Zones]
    purposes: tuple[str, ...]  # names of all of them
    multiples: FloatArray  # (m,) ascending; of demands in cars an hour, these
    usual: Mapping[str, int]  # by town, the number of the multiple that is nearest to its own demand
    first_hour: int  # clock hour of hour 0
    index: IntArray  # (n, 4) numbers of town, zone, purpose and hour of each path
    features: FloatArray  # (n, m, 6), see `_GROWS`; all but the last
    sums: Mapping[str, FloatArray]  # `SUMS`, (days, n, m) each

    @classmethod
    def of(cls, towns: Mapping[str, Town], multiples: Sequence[float], first_hour: int) -> Self:
        purposes = tuple(dict.fromkeys(name for town in towns.values() for name in town.purposes))
        parts: list[tuple[Any, ...]] = []
        for number, town in enumerate(towns.values()):
            n_zones, hours = np.shape(town.days[0][0]["occupancy"])
            shape = len(town.days[0]), len(multiples), n_zones, len(town.purposes), hours
            of_cars, state = np.zeros((len(SUMS), *shape)), np.zeros((4, len(multiples), n_zones, hours))
            for m, days in enumerate(town.days):
                for day, row in enumerate(days):
                    at = row["zone"], row["purpose"], row["hour"]
                    of_cars[(slice(None), day, m, *at)] = [row[name] for name in SUMS]
                    for values, name in zip(state[:, m], STATE, strict=True):
                        values += np.array(row[name]) / len(days)
            # More demand makes no zone emptier, but for chance.
            state = np.maximum.accumulate(state, axis=1)
            zone, purpose, hour = np.nonzero(of_cars[0].sum(axis=(0, 1)))
            known = np.array([purposes.index(name) for name in town.purposes])[purpose]
            fixed = np.broadcast_to(np.stack([hour, known])[:, None], (2, len(multiples), len(zone)))
            features = np.concatenate([state[:, :, zone, hour], fixed]).transpose(2, 1, 0)
            index = np.stack([np.full_like(zone, number), zone, known, hour], axis=1)
            parts.append((index, features, of_cars[:, :, :, zone, purpose, hour].transpose(0, 1, 3, 2)))
        index, features, of_cars = map(np.concatenate, zip(*parts, strict=True), (0, 0, 2))
        zones, x = {name: town.zones for name, town in towns.items()}, np.array(multiples)
        usual = {name: int(abs(x - town.usual).argmin()) for name, town in towns.items()}
        sums = dict(zip(SUMS, of_cars, strict=True))
        return cls(zones, purposes, x, usual, first_hour, index, features, sums)

    def groups(self, *columns: int) -> IntArray:
        return np.asarray(np.unique(self.index[:, columns], axis=0, return_inverse=True)[1].ravel())

    def totals(self, name: str) -> tuple[FloatArray, FloatArray]:
        return OUTCOMES[name].total(self.sums), self.sums[OUTCOMES[name].of]

    def lone(self, name: str) -> FloatArray:
        # An outcome as lone searches have it, (n, m), growing with the demand.
        of_lone = {of: self.sums[lone].sum(axis=0) for of, lone in zip(OF_CARS, ("cars", *LONE), strict=True)}
        total, cars = OUTCOMES[name].total(of_lone), of_lone[OUTCOMES[name].of]
        # Isotonic regression over the multiples (its min-max formula); k is the last of some, i the first.
        to = [np.pad(sums.cumsum(axis=1), ((0, 0), (1, 0))) for sums in (total, cars)]
        total, cars = (sums[:, None, 1:] - sums[:, :-1, None] for sums in to)
        means = _mean(total, cars, np.nan)
        grown = [np.fmin.reduce(means[:, : k + 1, k:], axis=2) for k in range(len(self.multiples))]
        return np.asarray(np.nan_to_num(np.stack([np.fmax.reduce(least, axis=1) for least in grown], axis=1)))

    def names(self, index: Sequence[int]) -> tuple[str, ...]:
        town, zone, purpose, hour = index
        name, zones = list(self.towns.items())[town]
        numbered = (zones.names, zone), (self.purposes, purpose), (range(self.first_hour, 48), hour)
        return name, *("all" if number < 0 else str(names[number]) for names, number in numbered)


def _mean(total: Any, cars: Any, missing: float = 0.0) -> FloatArray:
    return np.asarray(np.divide(total, cars, out=np.full(total.shape, missing), where=cars > 0.0))


def fit_curve(
    paths: Paths, name: str, train: FloatArray | BoolArray | float = 1.0, days: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Fit an outcome; return it as all zones have it in common, and with the factors of each zone, (n, m) each.

    `train` are weights of the cells to fit to, which broadcast to (n, m); each day counts once, or as `days` says.
    """
    with with_extra("a fit of curves", "fit"):
        from sklearn.ensemble import HistGradientBoostingRegressor
        from threadpoolctl import threadpool_limits

    of_days, cars_of_days = paths.totals(name)
    share = np.ones(len(of_days)) / len(of_days) if days is None else days / days.sum()
    total, cars = np.tensordot(share, of_days, 1), np.tensordot(share, cars_of_days, 1)
    unit: Any = 1.0
    if name == "search_s":  # how long the streets of the town of each path take, over those of all towns
        streets_s = np.array([zones.streets_s for zones in paths.towns.values()])
        unit = (streets_s / streets_s.mean())[paths.index[:, :1]]
    y, weight = _mean(total, cars) / unit, cars * train * unit
    if not (known := weight > 0.0).any() or not y[known].any():
        return np.zeros_like(y), np.zeros_like(y)
    features = np.concatenate([paths.features, (paths.lone(name) / unit)[..., None]], axis=-1)
    trees = HistGradientBoostingRegressor(
        loss="poisson", monotonic_cst=_GROWS, categorical_features=[_PURPOSE], early_stopping=False, **_TREES
    )
    # Threads that share cores wait for each other; and their sums are not the same on each machine.
    with threadpool_limits(1):
        trees.fit(features[known], y[known], sample_weight=weight[known])
        common = trees.predict(features.reshape(-1, len(_GROWS))).reshape(y.shape) * unit
    own, seen = common.copy(), np.broadcast_to(np.asarray(train) > 0.0, y.shape)
    for columns in ((0, 1), (0, 1, 2), (0, 1, 3)):
        group = paths.groups(*columns)
        own *= _factors(of_days * seen, cars * seen * own, group, share)[group][:, None]
    most = OUTCOMES[name].most
    return np.minimum(common, most), np.minimum(own, most)


def _factors(of_days: FloatArray, expected: FloatArray, group: IntArray, share: FloatArray) -> FloatArray:
    seen = np.array([np.bincount(group, day.sum(axis=1)) for day in of_days])
    mean = np.bincount(group, expected.sum(axis=1))
    away = _mean(share @ seen - mean, mean)
    # One day gives no estimate of the variance between days.
    several = len(seen) > 1
    chance = _mean(seen.var(axis=0, ddof=1) / len(seen), mean**2) if several else np.full(len(mean), 1e12)
    spread = max(float((mean * (away**2 - chance)).sum() / max(mean.sum(), 1e-9)), 0.0)
    return np.asarray(1.0 + away * spread / np.maximum(spread + chance, 1e-12))


def held_out_parts(paths: Paths, seed: int) -> Iterator[tuple[str, BoolArray]]:
    # Cells, (n, m), of zones, towns, and demands: one of the multiples between the least and the most.
    zone, n = paths.groups(0, 1), len(paths.multiples)
    every, count = np.ones((len(zone), n), bool), int(zone.max()) + 1
    part = np.random.default_rng(seed).permutation(count) % FOLDS
    for number in range(min(FOLDS, count) if count > 1 else 0):
        yield "zones", every & (part[zone] == number)[:, None]
    for town in range(len(paths.towns) if len(paths.towns) > 1 else 0):
        yield "towns", every & (paths.index[:, 0] == town)[:, None]
    for multiple in range(1, n - 1):
        yield "demands", every & (np.arange(n) == multiple)


def held_out_errors(
    paths: Paths, seed: int, workers: Workers = SERIAL, progress: Callable[[], None] = lambda: None
) -> tuple[list[Row], list[Row]]:
    """Return how far curves and usual forms are off where they were not fitted, and the zone-hours of held-out zones.

    Errors are over the zone-hours of each demand, weighted by the cars there, and relative to what was measured; those
    of a perfect curve are chance in the days, half the difference between even and odd ones. Where chance is more than
    `MAX_SAMPLING_ERROR`, nothing is said.
    """
    rows, zone_hours = list[Row](), list[Row]()
    parts = list(held_out_parts(paths, seed))
    fits = workers.in_order(
        [partial(fit_curve, paths, name, ~held) for name in OUTCOMES for _, held in parts]
    )
    for name in OUTCOMES:
        total, cars = (sums.mean(axis=0) for sums in paths.totals(name))
        y, lone = _mean(total, cars), paths.lone(name)
        predicted: dict[str, dict[str, FloatArray]] = {}
        for what, held in parts:
            common, own = next(fits)
            progress()
            by_form = {CURVE: own if what == "demands" else common, LONE_SEARCH: lone}
            by_form |= {form: _form_elsewhere(paths, form, y, cars, held) for form in FORMS}
            for form, values in by_form.items():
                of_form = predicted.setdefault(what, {}).setdefault(form, np.full_like(y, np.nan))
                of_form[held] = values[held]
        for what, by_form in predicted.items() if y.any() else ():
            errors = {form: _errors(paths, name, by_form[form]) for form in PREDICTORS}
            relative = {form: error.pop("relative") for form, error in errors.items()}
            if errors[CURVE]["chance"] < MAX_SAMPLING_ERROR:
                rows.append({"held_out": what, "outcome": OUTCOMES[name].label} | relative | errors[CURVE])
        if name == "search_s" and "zones" in predicted:
            zone_hours = _zone_hours(paths, predicted["zones"][CURVE])
    return rows, zone_hours


def _form_elsewhere(paths: Paths, form: str, y: FloatArray, cars: FloatArray, held: BoolArray) -> FloatArray:
    values, x = np.full_like(y, np.nan), paths.features[..., 0]
    for purpose in range(len(paths.purposes)):
        of_purpose = (paths.index[:, 2] == purpose)[:, None]
        train, test = of_purpose & ~held & (cars > 0.0), of_purpose & held
        if train.any():
            values[test] = form_at(form, fit_form(form, x[train], y[train], cars[train]), x[test])
    return values


def _adding(groups: IntArray) -> Any:
    return csr_matrix((np.ones(len(groups)), (groups, np.arange(len(groups)))))


def _added(groups: IntArray, *values: FloatArray) -> list[FloatArray]:
    return [np.asarray(_adding(groups) @ of_paths) for of_paths in values]


def _zone_hours(paths: Paths, predicted: FloatArray) -> list[Row]:
    total, cars = (sums.mean(axis=0) for sums in paths.totals("search_s"))
    groups = paths.groups(0, 1, 3)
    first = np.unique(groups, return_index=True)[1]
    cars, total, expected = _added(groups, cars, total, cars * predicted)
    sums = {"occupancy": cars * paths.features[first, :, 0], "measured": total, "predicted": expected}
    rows = []
    for k, m in np.argwhere(cars > 0.0).tolist():
        scenario, zone, _, hour = paths.names(paths.index[first[k]].tolist())
        row = {"scenario": scenario, "zone": zone, "hour": int(hour), "multiple": float(paths.multiples[m])}
        means = {name: float(values[k, m] / cars[k, m]) for name, values in sums.items()}
        rows.append({**row, "cars": float(cars[k, m]), **means})
    return rows


def _errors(paths: Paths, name: str, predicted: FloatArray) -> Row:
    of_days = [np.where(np.isfinite(predicted), sums, 0.0) for sums in paths.totals(name)]
    odd, groups = np.arange(len(of_days[0])) % 2 == 1, paths.groups(0, 1, 3)
    means = [sums.mean(axis=0) for sums in of_days]
    values = *means, np.nan_to_num(predicted) * means[1]
    total, cars, expected = _added(groups, *values)
    halves = [_added(groups, *(sums[days].mean(axis=0) for sums in of_days)) for days in (~odd, odd)]
    of_even, of_odd = (_mean(half_total, half_cars, np.nan) for half_total, half_cars in halves)
    of_zones, _, expected_of_zones = _added(paths.groups(0, 1), *values)
    whole = float(total.sum()) or np.nan  # of what never happens nothing is relative
    return {
        "relative": float(abs(total - expected).sum() / whole),
        "chance": float(np.nansum(cars * abs(of_even - of_odd)) / 2.0 / whole),
        "of_zones": float(abs(of_zones - expected_of_zones).sum() / whole),
        "measured": float(total.sum() / cars.sum()),
        "bias": float((expected - total).sum() / whole),
        "zone_hours": int((cars > 0.0).sum()),
    }


class CurveTable(NamedTuple):
    """Curves as columns of (r, m): each row a zone, purpose and hour or all of them, over the multiples of the demand.

    Columns are `occupancy` and `demand`, and of each outcome the value, its 95 % interval (`_low`, `_high`), and what
    was measured (`_seen`; NaN without cars).
    """

    numbers: IntArray  # (r, 4) of town, zone, purpose and hour; -1 for all
    cars: FloatArray  # (r,) that come on a day, in the mean over the multiples
    columns: dict[str, FloatArray]


def curve_table(
    paths: Paths,
    bootstraps: int,
    seed: int,
    workers: Workers = SERIAL,
    progress: Callable[[], None] = lambda: None,
) -> CurveTable:
    """Fit all outcomes, with intervals by a bootstrap over days and zones, and add up zones, purposes and hours."""
    numbers, adds = [], []
    for alls in range(8):
        whole = [1 + column for column in range(len(INDEX)) if alls >> column & 1]
        if 2 in whole and len(paths.purposes) == 1:
            continue
        index = paths.index.copy()
        index[:, whole] = -1
        rows, row = np.unique(index, axis=0, return_inverse=True)
        numbers.append(rows)
        adds.append(_adding(row.ravel()))
    sums = vstack(adds).tocsr()
    # The mix of the searches is that of all demands together, so that what is monotone stays so.
    mix = paths.sums["cars"].mean(axis=(0, 2))[:, None]

    def added(values: FloatArray) -> FloatArray:
        return np.asarray((sums @ (mix * values)) / (sums @ mix))

    rng, zone = np.random.default_rng(seed), paths.groups(0, 1)
    n_days, n_zones = len(paths.sums["cars"]), int(zone.max()) + 1
    draws: list[Any] = [()]
    for _ in range(bootstraps):
        days, zones = (
            np.bincount(rng.integers(0, n, n), minlength=n).astype(float) for n in (n_days, n_zones)
        )
        # Zones that are drawn weigh in what all have in common; each keeps factors of its own.
        draws.append(((zones[zone][:, None] if n_zones > 1 else 1.0) + 1e-9, days))
    fits = workers.in_order([partial(fit_curve, paths, name, *draw) for name in OUTCOMES for draw in draws])
    columns = {name: added(paths.features[..., k]) for k, name in enumerate(STATE[:2])}
    for name in OUTCOMES:
        drawn = []
        for _ in draws:
            drawn.append(added(next(fits)[1]))
            progress()
        half = 1.96 * np.std(drawn[1:], axis=0, ddof=1)
        total, cars = (np.asarray(sums @ of_days.mean(axis=0)) for of_days in paths.totals(name))
        columns[f"{name}_seen"] = _mean(total, cars, np.nan)
        columns[name] = drawn[0]
        columns[f"{name}_low"] = np.maximum.accumulate(np.maximum(drawn[0] - half, 0.0), axis=1)
        high = np.minimum(drawn[0] + half, OUTCOMES[name].most)
        columns[f"{name}_high"] = np.maximum.accumulate(high, axis=1)
    return CurveTable(np.concatenate(numbers), np.asarray(sums @ mix)[:, 0], columns)


JSON = "curve.json"
NAMES = ("scenario", "zone", "purpose", "hour")
# Clock hours of the day, and of the time periods of ActivitySim's example (`network_los.yaml` of `prototype_mtc`).
PERIODS = {"": (0, 48), "_EA": (3, 5), "_AM": (5, 9), "_MD": (9, 14), "_PM": (14, 18), "_EV": (18, 27)}
MOST_BYTES = 500_000_000  # largest file of curves that is read
_DIGITS = 5


class CurveValue(NamedTuple):
    """Values of a curve, and the ends of their 95 % intervals, in the shape of the arguments."""

    value: FloatArray
    low: FloatArray
    high: FloatArray


class Curves:
    """Outcomes of a search by zone, purpose and hour, as functions of occupancy or demand.

    A curve is defined between the lowest and the highest simulated demand, and constant beyond these.

    Args:
        curves: by scenario, zone, purpose and hour, its columns: `occupancy`, `demand`, and value, low and high end of
            each outcome, as `search_s`, `search_s_low` and `search_s_high`.

    Raises:
        InputError: there are none.

    Examples:
        >>> curve = {"occupancy": [0.2, 0.8], "demand": [0.1, 0.4]}
        >>> curve |= {"search_s": [10.0, 70.0], "search_s_low": [8.0, 60.0], "search_s_high": [12.0, 80.0]}
        >>> Curves({("town", "all", "all", "all"): curve}).search_s(occupancy=[0.2, 0.5, 0.9]).value
        array([10., 40., 70.])
    """

    def __init__(self, curves: Mapping[tuple[str, ...], Mapping[str, Sequence[float]]]) -> None:
        self.curves = dict(curves)
        require(self.curves, "curves is empty, want at least one")

    def at(
        self,
        outcome: str,
        *,
        occupancy: ArrayLike | None = None,
        demand: ArrayLike | None = None,
        zone: Any = ALL,
        hour: Any = ALL,
        purpose: Any = ALL,
        scenario: Any = None,
    ) -> CurveValue:
        """Return an outcome, such as `search_s`, with its interval; all arguments broadcast against each other.

        Args:
            outcome: one of `parkenv.studies.curve.fit.OUTCOMES`.
            occupancy: share of the spaces around that is taken, from 0 to 1.
            demand: or instead, cars that arrive in an hour for each space around.
            zone: names of zones.
            hour: clock hours of the arrival.
            purpose: purposes.
            scenario: scenarios; None for the first.

        Raises:
            InputError: both or neither of occupancy and demand are given, or there is no such outcome or curve.
        """
        require(
            (occupancy is None) != (demand is None),
            "occupancy and demand are both given or both missing, want one of them",
        )
        along, given = ("occupancy", occupancy) if demand is None else ("demand", demand)
        first = next(iter(self.curves))[0] if scenario is None else scenario
        x, *names = np.broadcast_arrays(np.asarray(given, float), first, zone, purpose, hour)
        values = np.empty((3, *x.shape))
        asked = np.stack([of_axis.astype(str) for of_axis in names], axis=-1)
        for key in {*map(tuple, asked.reshape(-1, len(NAMES)).tolist())}:
            at, curve = (asked == key).all(axis=-1), self._curve(key)
            require(outcome in curve, f"outcome is {outcome!r:.40}; {nearest(outcome, OUTCOMES)}")
            knots, unique = np.unique(np.array(curve[along], float), return_index=True)
            inside = np.clip(x[at], knots[0], knots[-1])
            for k, column in enumerate((outcome, f"{outcome}_low", f"{outcome}_high")):
                y = np.array(curve[column], float)[unique]
                values[k, at] = PchipInterpolator(knots, y)(inside) if len(knots) > 1 else y[0]
        return CurveValue(*values)

    def _curve(self, key: tuple[str, ...]) -> Mapping[str, Sequence[float]]:
        if key not in self.curves:
            for part, name, known in zip(NAMES, key, zip(*self.curves, strict=True), strict=True):
                require(name in known, f"{part} is {name!r}; {nearest(name, dict.fromkeys(known))}")
            raise InputError(f"{', '.join(key)}: no cars come, so there is no curve")
        return self.curves[key]

    search_s = partialmethod(at, "search_s")
    walk_s = partialmethod(at, "walk_s")
    failed_attempts = partialmethod(at, "failed_attempts")
    balked_fraction = partialmethod(at, "balked_fraction")


def load_curves(folder: Path | str) -> Curves:
    """Read the curves in the folder of a run of `parkenv curve`.

    Raises:
        InputError: there are none, or the file is damaged.
    """
    path = Path(folder) / JSON
    content = read_json(path, MOST_BYTES)
    try:
        return Curves({tuple(str(curve[name]) for name in NAMES): curve for curve in content["curves"]})
    except (InputError, KeyError, TypeError) as error:
        raise InputError(f"{path}: want curves with {', '.join(NAMES)}") from error


def write_curves(paths: Paths, table: CurveTable, folder: Path) -> None:
    names, multiples = [paths.names(index) for index in table.numbers.tolist()], paths.multiples.tolist()
    columns = {name: values.round(_DIGITS).tolist() for name, values in table.columns.items()}
    curves = [
        dict(zip(NAMES, key, strict=True)) | {name: values[k] for name, values in columns.items()}
        for k, key in enumerate(names)
    ]
    lists = [
        {name: [curve[name]] * len(multiples) for name in NAMES} | {"multiple": multiples} for curve in curves
    ]
    lines = Table("curve.csv", (), (*NAMES, "multiple", *columns), long=True)
    lines.write(folder, [curve | repeated for curve, repeated in zip(curves, lists, strict=True)])
    whole = without_nan({"multiples": multiples, "curves": curves})
    write_text(folder / JSON, json.dumps(whole, allow_nan=False) + "\n")
    terminal, links = zone_rows(paths, table)
    write_csv(folder / "activitysim.csv", tuple(terminal[0]), terminal)
    write_csv(folder / "matsim.csv", tuple(links[0]), links)


def zone_rows(paths: Paths, table: CurveTable) -> tuple[list[Row], list[Row]]:
    """Return a row of each zone for ActivitySim, and for MATSim.

    ActivitySim's land use has the terminal time, minutes: search and walk at `Paths.usual`. MATSim's parking in QSim
    has spaces of links and a `BellochePenaltyFunction`: alpha exp(-beta occupancy) s of search.
    """
    terminal, links, column = [], [], table.columns
    town, zone, purpose, hour = table.numbers.T
    of_all = (purpose == (-1 if len(paths.purposes) > 1 else 0)) & (hour >= 0) & (zone >= 0)
    for number, (name, zones) in enumerate(paths.towns.items()):
        minutes = (column["search_s"] + column["walk_s"])[:, paths.usual[name]] / 60.0
        for at, zone_name in enumerate(zones.names):
            hours = np.flatnonzero(of_all & (town == number) & (zone == at))
            if not hours.size:
                continue
            row: Row = {"scenario": name, "zone_id": zone_name}
            for period, (begin, end) in PERIODS.items():
                clock = paths.first_hour + hour[hours]
                inside = hours[(clock >= begin) & (clock < end)]
                mean = np.average(minutes[inside], weights=table.cars[inside]) if inside.size else np.nan
                row[f"TERMINAL{period}"] = round(float(mean), 2) if inside.size else None
            terminal.append(row)
            weight = np.repeat(table.cars[hours], len(paths.multiples))
            b, (alpha,) = fit_form(
                "a exp(b x)", column["occupancy"][hours].ravel(), column["search_s"][hours].ravel(), weight
            )
            x, y = zones.xy[at].round(2).tolist()
            row = {"scenario": name, "zone": zone_name, "x": x, "y": y}
            row |= dict(zip(("onstreet_spots", "offstreet_spots"), zones.own[at].tolist(), strict=True))
            links.append(row | {"alpha": round(float(alpha), _DIGITS), "beta": -b})
    return terminal, links
