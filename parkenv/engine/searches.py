"""Memory of searches: the records of their scenarios, and those of the searches with the arrays they point to."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parkenv.compiled.arrays import IntArray
from parkenv.compiled.keyed_random import episode_key
from parkenv.compiled.memory import address_of, in_one_block, sparse_zeros, zeros_on_lines
from parkenv.engine.records import (
    ADDRESSES,
    BLOCK,
    BLOCK_BITS,
    BLOCK_SIZE,
    CUE,
    DECAY_RATE,
    FORECAST,
    HIDDEN_FIELDS,
    NEVER_OBSERVED,
    OBSERVED_AT,
    OPTION_FIELDS,
    P_OBSERVED,
    PROBLEM_FIELDS,
    PROGRESS_FIELDS,
    SCENARIO,
    SEARCH,
    SLOT,
    UNGUIDED,
    Value,
)
from parkenv.errors import InputError, require, require_number, require_one_of, require_whole
from parkenv.world.occupancy.arrival_window import DAY_NAMES, ArrivalWindow
from parkenv.world.occupancy.kernel import EXTERNAL_KIND, LOG_KIND, PROCESS_KIND, RECORDED_DAY
from parkenv.world.occupancy.process import Arrival, CompiledModel, PriorModel, World
from parkenv.world.scenario import Scenario, SearchProblem
from parkenv.world.week import DAY_S, WEEK_S

# Names of the options of `reset` that say how an episode begins.
START_OPTIONS = ("scenario", "entry", "arrival")
DENSE_SLOTS = 2**24  # slots of all searches up to which their tables, a gigabyte then, are in large pages
# Attributes of `Searches` with a row for each search; the SEARCH field of the name holds the row's address.
_ARRAYS = (
    "slots", "blocks", "columns", "external_forecast", "day_error", "p_occupied", "belief", "step_observed",
    "cue_table", "cues",
)  # fmt: skip


class ScenarioRecords:
    """Scenarios as records, and the arrays that the records point to: one set of tables for any number of searches.

    Problems without a world can stand for scenarios; their searches can only be followed from outside.
    """

    def __init__(self, scenarios: Sequence[Scenario] | Sequence[SearchProblem]) -> None:
        self._kept: list[Any] = []
        # What was given and the address of its copy, which scenarios share.
        self._kept_at: dict[tuple[int, str], tuple[Any, int]] = {}
        self._models: list[CompiledModel] = []
        self._model_at: dict[tuple[int, int], tuple[PriorModel, int]] = {}
        self.scenarios: tuple[Any, ...] = tuple(scenarios)
        self.records = np.zeros(len(scenarios), SCENARIO)
        for record, scenario in zip(self.records, scenarios, strict=True):
            self._write(record, PROBLEM_FIELDS, scenario)
            record["world_kind"] = record["prior_kind"] = EXTERNAL_KIND
            if isinstance(scenario, Scenario):
                self._write(record, HIDDEN_FIELDS, scenario)
                self._write_models(record, scenario)
        if len(scenarios) > 1:
            self._join()
        arrays = {id(array): array for array in _arrays_in(self._kept)}
        for model in self._models:
            of_model = _arrays_in([model.record, *model.tables.values(), *model.kept])
            arrays |= {id(array): array for array in of_model}
        self.n_bytes = self.records.nbytes + sum(array.nbytes for array in arrays.values())

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles make records of their own: these hold addresses."""
        return ScenarioRecords, (self.scenarios,)

    def __deepcopy__(self, memo: dict[int, Any]) -> ScenarioRecords:
        return self  # nothing changes

    def _join(self) -> None:
        of_models = [array for model in self._models for array in model.tables.values()]
        tables = [*self._kept, *of_models]
        copies = in_one_block(tables)
        moved = {
            address_of(old, old.dtype): address_of(new, new.dtype)
            for old, new in zip(tables, copies, strict=True)
        }
        models = []
        for model in self._models:
            record = model.record.copy()
            for name in model.tables:
                record[name] = moved[int(record[name][0])]
            moved[address_of(model.record, record.dtype)] = address_of(record, record.dtype)
            models.append(model._replace(record=record, tables={}))
        for name in ADDRESSES:
            self.records[name] = [moved.get(int(address), int(address)) for address in self.records[name]]
        self._kept, self._models = copies, models

    def _keep(self, values: ArrayLike, dtype: Any) -> int:
        key = id(values), str(np.dtype(dtype))
        if key not in self._kept_at:
            array = np.ascontiguousarray(values, dtype)
            array.flags.writeable = False
            self._kept.append(array)
            self._kept_at[key] = values, address_of(array, dtype)
        return self._kept_at[key][1]

    def _write(
        self, record: np.void, fields: Sequence[tuple[str, Any, Value]], scenario: SearchProblem
    ) -> None:
        for name, of, value_of in fields:
            value = value_of(scenario)
            if isinstance(of, list):
                value = 0 if value is None else self._keep(value, of[0])
            record[name] = value

    def _write_models(self, record: np.void, scenario: Scenario) -> None:
        occupancy, prior = scenario.occupancy, scenario.prior or scenario.occupancy
        record["world_kind"], record["world"] = occupancy.kind, self._address_of(occupancy, scenario)
        if prior is occupancy and record["world"]:
            record["prior_kind"], record["prior"] = record["world_kind"], record["world"]
        elif prior.kind == PROCESS_KIND and (address := self._address_of(prior, scenario)):
            record["prior_kind"], record["prior"] = PROCESS_KIND, address

    def _address_of(self, model: PriorModel, scenario: Scenario) -> int:
        key = id(model), id(scenario.arrival)
        if key not in self._model_at:
            compiled = model.compiled(scenario.arrival)
            if compiled is not None:
                self._models.append(compiled)
            address = 0 if compiled is None else address_of(compiled.record, compiled.record.dtype)
            self._model_at[key] = model, address
        return self._model_at[key][1]


def _arrays_in(kept: Sequence[Any]) -> Iterator[NDArray[Any]]:
    for owner in kept:
        if isinstance(owner, np.ndarray):
            yield owner
        else:
            yield from (value for value in vars(owner).values() if isinstance(value, np.ndarray))


class Searches:
    """One or more running searches as records, and the arrays that the records point to.

    Args:
        scenarios: scenarios of the searches; if there are several, one is drawn for each episode.
        n: number of searches.
        full_belief: whether to keep `p_occupied` and `belief` up to date.
        most_observed: maximum number of slots that a step observes; None: those in view, and one more, or 0 without
            the full belief; with 0, `step_observed` is not kept.
        sparse: whether tables take memory only where they are written, by small pages, which are slower; None: if the
            searches have more than `DENSE_SLOTS` in all.

    Attributes:
        records: (n,) of the dtype SEARCH.
        slots: (n, m + 1) of the dtype SLOT, a column for each slot that a search has observed or queried, in order of
            first use; the first column is the sentinel. m is the number of slots of the largest lot.
        external_forecast: (n, 2, m), forecast and decay rate of priors that only Python can compute; else (0, 2, 0).
        needs_python: whether an arrival is complete only after `complete_arrival`.
        day_error, p_occupied, belief, step_observed, cues: as the environment observes them; empty if not kept.
        cue_table: (n, m + 1) of the dtype CUE, by column; empty where no scenario has cues.
    """

    def __init__(
        self,
        scenarios: ScenarioRecords,
        n: int,
        full_belief: bool,
        most_observed: int | None = None,
        sparse: bool | None = None,
    ) -> None:
        m = int(scenarios.records["n_slots"].max())
        external = bool((scenarios.records["prior_kind"] == EXTERNAL_KIND).any())
        self.needs_python = external or bool((scenarios.records["world"] == 0).any())
        self._worlds: dict[int, World] = {}  # made in Python, by search
        self.scenarios = scenarios
        self.records = zeros_on_lines((n,), SEARCH)
        if sparse is None:
            sparse = n * m > DENSE_SLOTS
        # Zeros stand for the sentinel. A search observes a small part of a large lot.
        zeros = sparse_zeros if sparse else zeros_on_lines
        self.slots = zeros((n, m + 1), SLOT)
        self.blocks = zeros((n, (m + BLOCK_SIZE) >> BLOCK_BITS), BLOCK)
        self.columns = zeros((n, m), np.int32)
        self.external_forecast = np.zeros((n, 2, m) if external else (0, 2, 0))
        self.day_error = np.zeros((n, 2), np.float32)
        # Padding past the last slot of a smaller lot: taken, constant, never observed.
        self.p_occupied = np.ones((n, m) if full_belief else (0, 0), np.float32)
        self.belief = np.zeros((n, 4, m) if full_belief else (0, 4, 0), np.float32)
        self.belief[:, [FORECAST, P_OBSERVED]] = 1.0
        self.belief[:, OBSERVED_AT] = NEVER_OBSERVED
        if most_observed is None:
            most_observed = most_observed_in(scenarios.scenarios) if full_belief else 0
        k = most_observed
        self.step_observed = np.zeros((n, 4, k) if k > 0 else (0, 4, 0), np.float32)
        has_cues = bool((scenarios.records["lead_s"] > 0.0).any())
        self.cue_table = zeros((n if has_cues else 0, m + 1), CUE)
        self.cues = np.zeros((n if has_cues and full_belief else 0, 3, m), np.float32)
        self.records["width"], self.records["most_observed"], self.records["n_step_used"] = m, k, k
        self.records["walks"], self.records["reserved"] = 1.0, UNGUIDED
        self.records["scenarios"] = address_of(scenarios.records, SCENARIO)
        self.records["n_scenarios"] = len(scenarios.records)
        self._find_scenarios()
        for name, array in self._arrays().items():
            self._write_addresses(name, array)

    def _write_addresses(self, name: str, array: NDArray[Any]) -> None:
        first = address_of(array, array.dtype)
        self.records[name] = first + np.arange(len(self.records)) * array.strides[0] if len(array) else 0

    def copiers(self, search: int) -> tuple[Callable[[], NDArray[Any]], ...]:
        """Return what copies a search's `clock`, `p_occupied`, `belief`, `step_observed` and `day_error`; flat arrays.

        Bound methods: looking them up would take a tenth of a step.
        """
        parts = (self.p_occupied, self.belief, self.step_observed, self.day_error)
        return (self.records["clock"][search].copy, *(part[search].reshape(-1).copy for part in parts))

    def copier_of_cues(self, search: int) -> Callable[[], NDArray[Any]] | None:
        return self.cues[search].reshape(-1).copy if len(self.cues) else None

    def complete_arrival(self, search: int) -> None:
        scenario, record = self.scenario_of(search), self.records[search]
        self._make_world(search)
        if self.scenarios.records["prior_kind"][record["scenario_index"]] != EXTERNAL_KIND:
            return
        forecast = scenario.forecast(arrival_of(scenario, record))
        n = len(forecast.p_occupied)
        self.external_forecast[search, :, :n] = forecast.p_occupied, forecast.decay_rate
        self.day_error[search] = forecast.day_error.level, forecast.day_error.slope

    def begin_outside(self, scenario: int, observation: Mapping[str, Any]) -> None:
        self.records["scenario_index"] = scenario
        self._find_scenarios()
        n = self.external_forecast.shape[2]
        self.external_forecast[0] = observation["belief"].reshape(4, -1)[[FORECAST, DECAY_RATE], :n]

    def scenario_of(self, search: int) -> Scenario:
        return self.scenarios.scenarios[int(self.records["scenario_index"][search])]  # type: ignore[no-any-return]

    def _find_scenarios(self) -> None:
        index, scenarios = self.records["scenario_index"], self.scenarios.records
        self.records["scenario"] = self.records["scenarios"] + index * SCENARIO.itemsize
        by_day = (scenarios["world_kind"][index] == LOG_KIND) * self.records["day"] * RECORDED_DAY.itemsize
        self.records["world"] = scenarios["world"][index] + by_day

    def _make_world(self, search: int) -> None:
        scenario, record = self.scenario_of(search), self.records[search]
        if not self.scenarios.records["world"][record["scenario_index"]]:
            world = scenario.occupancy.world(np.uint64(record["key"]), arrival_of(scenario, record))
            self._worlds[search], record["world"] = world, world.address

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {name: getattr(self, name) for name in _ARRAYS}

    @property
    def address(self) -> int:
        return address_of(self.records, SEARCH)

    @property
    def n_bytes(self) -> int:
        return sum(array.nbytes for array in (self.records, *self._arrays().values()))

    def row(self, i: int) -> Searches:
        single, rows = object.__new__(Searches), slice(i, i + 1)
        vars(single).update(vars(self))
        single.records = self.records[rows]
        for name in _ARRAYS:
            setattr(single, name, getattr(self, name)[rows])
        return single

    def save(self, rows: IntArray | None = None) -> tuple[NDArray[Any], ...]:
        rows = np.arange(len(self.records)) if rows is None else rows
        parts = (self.records, *self._arrays().values())
        return tuple(array[rows] if len(array) else array.copy() for array in parts)

    def restore(self, saved: tuple[NDArray[Any], ...], fields: Sequence[str] = PROGRESS_FIELDS) -> None:
        records, *arrays = saved
        records, n = records.view(SEARCH), len(self.records)
        require(len(records) == n, f"state is of {len(records)} searches, want {n}")
        widths, own_widths = records["width"], self.records["width"]
        if (widths != own_widths).any():
            raise InputError(f"state is of a lot with {widths[0]} slots, this one has {own_widths[0]}")
        for name in fields:
            self.records[name] = records[name]
        if not (
            (self.records["scenario_index"] >= 0)
            & (self.records["scenario_index"] < len(self.scenarios.records))
        ).all():
            raise InputError("state is of other scenarios")
        self._find_scenarios()
        for own, array in zip(self._arrays().values(), arrays, strict=True):
            own[...] = array.view(own.dtype)
        if self.needs_python:
            for search in np.flatnonzero(self.records["key"]):  # the others have not begun
                self._make_world(int(search))

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles have arrays of their own: records hold addresses."""
        most_observed, full_belief = self.step_observed.shape[2], len(self.p_occupied) > 0
        return Searches, (self.scenarios, len(self.records), full_belief, most_observed), self.save()

    def __setstate__(self, saved: tuple[NDArray[Any], ...]) -> None:
        self.restore(saved, (*PROGRESS_FIELDS, *OPTION_FIELDS))


def most_observed_in(problems: Sequence[SearchProblem]) -> int:
    return 1 + max(int(np.diff(problem.slots_in_view[0]).max(initial=0)) for problem in problems)


def arrival_of(scenario: Scenario, record: np.void) -> Arrival:
    return Arrival(float(record["arrival"]), scenario.arrival_days[int(record["day"])].date)


def choose_start(searches: Searches, index: int, episode: int, options: Mapping[str, Any]) -> None:
    """Let the next episode of a search, with this number, begin as some `START_OPTIONS` of `reset` say.

    `scenario` is its name or index; `entry` an index among the scenario's; `arrival` s since Monday 00:00, or a text
    such as "Tue 08:30", on a weekday of the scenario's. The rest, and one of several such days, is drawn.
    """
    scenarios, record = searches.scenarios.scenarios, searches.records[index]
    chosen, names = options.get("scenario", 0 if len(scenarios) == 1 else None), [s.name for s in scenarios]
    if chosen is None or isinstance(chosen, str):
        require_one_of("option scenario", chosen, names)
        chosen = names.index(chosen)
    require_whole("option scenario", chosen, most=len(scenarios) - 1)
    record["chosen_scenario"] = chosen + 1
    if "entry" in options:
        last = int(searches.scenarios.records["n_entries"][chosen]) - 1
        require_whole("option entry", options["entry"], most=last)
        record["chosen_entry"] = options["entry"] + 1
    if "arrival" in options:
        arrival = options["arrival"]
        if isinstance(arrival, str):
            day, _, hour = arrival.strip().partition(" ")
            try:
                require_one_of("day", day.lower(), DAY_NAMES)
                arrival = DAY_S * DAY_NAMES.index(day.lower()) + ArrivalWindow.parse(f"{hour}-{hour}").start_s
            except InputError:
                wanted = "seconds since Monday 00:00 or a text such as 'Tue 08:30'"
                raise InputError(f"option arrival is {arrival!r:.60}, want {wanted}") from None
        require_number("option arrival", arrival, least=0.0, below=WEEK_S)
        weekday, record["chosen_second"] = divmod(float(arrival), DAY_S)
        days = [day.weekday for day in scenarios[chosen].arrival_days]
        require_one_of(
            "day of option arrival", DAY_NAMES[int(weekday)], [DAY_NAMES[i] for i in sorted(set(days))]
        )
        same = [i for i, other in enumerate(days) if other == weekday]
        record["chosen_day"] = 1 + same[int(episode_key(record["seed_state"], episode)) % len(same)]
