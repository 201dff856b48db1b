"""Benchmark of planning and replanning against general MDP solvers, and of searches in cities."""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from importlib.util import find_spec
from multiprocessing import active_children, get_context
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, vstack

from benchmarks.rows import Row, duration, peak_memory_gib, seconds_each
from parkenv.lots import city_lot, packaged_lot
from parkenv.scenarios.build import make_scenario
from parkenv.studies.simulate import simulate
from parkenv.studies.workers import worker_start
from parkenv.world.lot import PARK, ParkingLot
from planners.agent import make_agent
from planners.thesis import label_setting
from planners.thesis.label_setting import Labels, StoppingGraph, repair
from planners.thesis.mdp import ParkingMDP
from planners.thesis.policy_iteration import policy_iteration

Solver = Callable[[], NDArray[np.int64]]

SIZES = (200, 2_000, 20_000, 200_000, 2_000_000)
CITY = 1_000_000  # number of slots of the city in which agents search
CITY_SEARCHES = 3  # number of searches of each agent in the city
PATIENCE_S = 60.0  # peers are not measured on lots where they are expected to take longer, s
MDPTOOLBOX_STATES = 5_000
"""Maximum number of states for pymdptoolbox, which checks its input with a dense matrix of states by states."""
LONG_S = 2.0  # solvers that take longer are timed only once, s
EPSILON = 0.01  # tolerance of the values of iterative peers, s


def planning_rows(seed: int = 0, seconds: float = 0.6, *, largest: int = SIZES[-1]) -> list[Row]:
    """Return the rows of `python benchmarks/run.py planning`, on one core.

    Args:
        seed: seed of the cities and of the observations.
        seconds: duration of each measurement.
        largest: number of slots of the largest city.
    """
    sizes = [n for n in SIZES if n <= largest]
    return [
        *solving_rows(sizes, seed, seconds),
        *repair_rows(packaged_lot("campus"), seed, seconds),
        *city_rows_apart(min(CITY, largest), seed),
    ]


def solving_rows(sizes: list[int], seed: int, seconds: float) -> list[Row]:
    """Measure planning from scratch in cities of increasing size, and its growth.

    Raises:
        AssertionError: a peer's plan is worse than ours.
    """
    rows: list[Row] = []
    expected: dict[str, float] = {}
    measured: dict[str, float] = {}
    vertices, own = [], []
    for n_slots in sizes:
        mdp = forecast_process(city_lot(n_slots, seed), seed)
        graph, n = StoppingGraph.of(mdp), mdp.n_states
        labels = label_setting.set_labels(graph, mdp.p_free)
        ours = seconds_each(lambda _, g=graph, p=mdp.p_free: label_setting.set_labels(g, p), seconds)  # type: ignore[misc]
        vertices.append(n)
        own.append(ours)
        theirs = {}
        for name, prepare in peers(n).items():
            if expected.get(name, 0.0) > PATIENCE_S:
                continue
            solve = prepare(mdp)
            policy, took = _timed(solve, seconds)
            _require_optimal(name, mdp, labels, policy)
            theirs[name] = 1e3 * took
            # The time grows faster than the lot, which grows tenfold: assume at least the last growth factor.
            expected[name] = took * max(12.0, took / measured.get(name, took))
            measured[name] = took
        rows += duration("plan", f"city, {n:,} vertices", 1e3 * ours, "ms", **theirs)
    if len(sizes) > 1:
        size = np.log(np.array(vertices) * np.log(vertices))
        power = float(np.polyfit(size, np.log(own), 1)[0])
        rows += duration("plan", "time grows as (n log n) to the power of", power, "")
    return rows


def repair_rows(lot: ParkingLot, seed: int, seconds: float) -> list[Row]:
    """Measure replanning after each observed slot; peers plan from scratch, or by policy iteration."""
    mdp = forecast_process(lot, seed)
    graph = StoppingGraph.of(mdp)
    repair(graph, label_setting.set_labels(graph, mdp.p_free.copy()), np.array([0]), np.ones(1))
    times = []
    end = time.perf_counter() + max(seconds, 0.1)
    rng = np.random.default_rng(seed)
    while time.perf_counter() < end:
        labels = label_setting.set_labels(graph, mdp.p_free.copy())
        for slot, p_free in drive(graph, labels, lot.n_slots, rng):
            start = time.perf_counter()
            repair(graph, labels, slot, p_free)
            times.append(time.perf_counter() - start)
    fresh = 1e6 * seconds_each(lambda _: label_setting.set_labels(graph, mdp.p_free), seconds)
    known, _ = label_setting.by_policy_iteration(mdp)
    seen = mdp.p_free.copy()
    seen[: lot.n_slots // 20] = 0.0
    after = dataclasses.replace(mdp, p_free=seen)
    warm = 1e6 * seconds_each(lambda _: label_setting.by_policy_iteration(after, known), seconds)
    peers = {"plan from scratch": fresh, "policy iteration from the last plan": warm}
    case = f"after an observation; {lot.name}, {lot.n_vertices} vertices"
    return [
        *duration("replan", f"{case}: median", 1e6 * float(np.median(times)), "µs", **peers),
        *duration("replan", f"{case}: 99 %", 1e6 * float(np.quantile(times, 0.99)), "µs", **peers),
    ]


def city_rows_apart(n_slots: int, seed: int) -> list[Row]:
    """Run `city_rows` in a separate process, to measure its peak memory alone."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), **worker_start()) as apart:
        try:
            return apart.submit(city_rows, n_slots, seed).result()
        except KeyboardInterrupt:
            for process in active_children():
                process.kill()
            raise


def city_rows(n_slots: int, seed: int) -> list[Row]:
    """Measure searches in a city: an agent's time for the first and for later decisions, and peak memory.

    Args:
        n_slots: number of slots of the city.
        seed: seed of the city and of the worlds.
    """
    scenario = make_scenario(city_lot(n_slots, seed))
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    rows: list[Row] = []
    for name in ("mdp", "mdp-tuned", "belief"):
        first, decisions = [], []
        agent = make_agent(name, scenario)
        for episode in range(CITY_SEARCHES):
            times = simulate(env, agent, seed + episode).decision_s
            first.append(times[0])
            decisions += times[1:]
        case = f"{name}, city, {n_slots:,} slots"
        rows += duration("search", f"{case}: first plan", float(np.median(first)), "s")
        rows += duration("search", f"{case}: decision, median", 1e3 * float(np.median(decisions)), "ms")
        rows += duration("search", f"{case}: decision, 99 %", 1e3 * float(np.quantile(decisions, 0.99)), "ms")
    return rows + duration("search", f"city, {n_slots:,} slots: peak memory", peak_memory_gib(), "GiB")


def drive(
    graph: StoppingGraph, labels: Labels, n_slots: int, rng: np.random.Generator
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Yield the observations of a drive along the plan: slots passed, which are free less often than predicted."""
    vertex = int(rng.integers(len(labels.cost)))
    seen: set[int] = set()
    for _ in range(1000):
        if vertex < n_slots and vertex not in seen:
            seen.add(vertex)
            free = rng.random() < labels.p_free[vertex] / 3.0
            yield np.array([vertex]), np.array([1.0 if free else 0.0])
        move = label_setting.best_move(graph, labels.p_free, labels.cost, vertex)
        if move == PARK or graph.neighbors[vertex, move] < 0:
            return
        vertex = int(graph.neighbors[vertex, move])


def forecast_process(lot: ParkingLot, seed: int) -> ParkingMDP:
    """Build the planning problem of an arrival on a typical working day."""
    scenario = make_scenario(lot)
    arrival = scenario.occupancy.draw_arrival(scenario.arrival, np.uint64(seed))
    return ParkingMDP.from_belief(scenario, scenario.forecast(arrival).p_occupied)


def peers(n_states: int) -> dict[str, Callable[[ParkingMDP], Solver]]:
    """Return the installed peers, each a function that prepares a solver for a process."""
    found: dict[str, Callable[[ParkingMDP], Solver]] = {
        "policy iteration, sparse LU": lambda mdp: lambda: policy_iteration(mdp).policy
    }
    if find_spec("quantecon") is not None:
        found["QuantEcon, value iteration"] = lambda mdp: quantecon_solver(mdp, "value_iteration")
        found["QuantEcon, policy iteration"] = lambda mdp: quantecon_solver(mdp, "policy_iteration")
    if find_spec("mdptoolbox") is not None and n_states <= MDPTOOLBOX_STATES:
        found["pymdptoolbox, value iteration"] = pymdptoolbox_solver
    return found


def quantecon_solver(mdp: ParkingMDP, method: str) -> Solver:
    """Make a solver with QuantEcon's `DiscreteDP` on sparse state-action pairs; the last state is the goal."""
    n, n_actions = mdp.n_states, PARK + 1
    process: Any = import_module("quantecon.markov").DiscreteDP(
        np.append(mdp.rewards().ravel(), 0.0),
        transitions(mdp),
        mdp.gamma,
        np.append(np.repeat(np.arange(n), n_actions), n),
        np.append(np.tile(np.arange(n_actions), n), 0),
    )
    limit = 10_000_000

    def solve() -> NDArray[np.int64]:
        return np.asarray(process.solve(method, epsilon=EPSILON, max_iter=limit).sigma[:n], dtype=np.int64)

    return solve


def pymdptoolbox_solver(mdp: ParkingMDP) -> Solver:
    """Make a solver with pymdptoolbox's value iteration, one sparse matrix per action; the last state is the goal."""
    n, n_actions = mdp.n_states, PARK + 1
    by_pair = transitions(mdp)
    stay = csr_matrix(([1.0], ([0], [n])), shape=(1, n + 1))
    matrices = [vstack([by_pair[a : n * n_actions : n_actions], stay]).tocsr() for a in range(n_actions)]
    reward = np.vstack([mdp.rewards(), np.zeros(n_actions)])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings of its input checks
        process: Any = import_module("mdptoolbox.mdp").ValueIteration(
            matrices, reward, mdp.gamma, epsilon=EPSILON, max_iter=1_000_000
        )

    def solve() -> NDArray[np.int64]:
        process.V, process.iter = np.zeros(n + 1), 0
        process.run()
        return np.asarray(process.policy[:n], dtype=np.int64)

    return solve


def transitions(mdp: ParkingMDP) -> csr_matrix[np.float64]:
    """Build the transition matrix, (5n + 1, n + 1), a row per state and action, the goal last."""
    n, successors = mdp.n_states, mdp.successors()
    n_actions = successors.shape[1]
    pair = np.arange(n * n_actions)
    stays = np.ones((n, n_actions))
    stays[:, PARK] = 1.0 - mdp.p_free
    rows = np.concatenate([pair, pair[PARK::n_actions], [n * n_actions]])
    columns = np.concatenate([successors.ravel(), np.full(n + 1, n)])
    chances = np.concatenate([stays.ravel(), mdp.p_free, [1.0]])
    matrix = csr_matrix((chances, (rows, columns)), shape=(n * n_actions + 1, n + 1))
    matrix.eliminate_zeros()
    return matrix


def _timed(solve: Solver, seconds: float) -> tuple[NDArray[np.int64], float]:
    """Return a policy and the time to compute it, s; slow solvers run once."""
    start = time.perf_counter()
    policy = solve()
    once = time.perf_counter() - start
    return policy, once if once > LONG_S else seconds_each(lambda _: solve(), seconds)


def _require_optimal(name: str, mdp: ParkingMDP, labels: Labels, policy: NDArray[np.int64]) -> None:
    q = mdp.action_values(-labels.cost)
    lost = float((q.max(axis=1) - q[np.arange(mdp.n_states), policy]).max())
    if lost > EPSILON:
        raise AssertionError(f"{name}: an action of its plan costs {lost:g} s more than ours")
