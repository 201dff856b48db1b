"""Training of search agents with stable-baselines3: learn, evaluate in held-out worlds, test, compare with planners."""

from __future__ import annotations

import itertools
import random
import threading
import time
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import LinearSchedule

from parkenv.envs.sb3 import SearchVecEnv
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.errors import InputError, require
from parkenv.files.atomic_write import atomic_write
from parkenv.files.csv_tables import write_csv
from parkenv.scenarios.build import build
from parkenv.scenarios.selection import lot_share, require_different_names, split_by_lot
from parkenv.show.figures.times import save_learning_curves
from parkenv.show.tables import plural
from parkenv.studies.compare.cases import Case, rows_of
from parkenv.studies.compare.search_replay import search_replay
from parkenv.studies.fields import AgentSpec, require_agents
from parkenv.studies.results import Results, Row, fingerprints, flat_tables
from parkenv.studies.simulate import charge_truncation
from parkenv.studies.statistics import mean_interval
from parkenv.studies.study import Progress, ReplayJob, ReportOptions
from parkenv.studies.training.configs import MAX_STEPS, REWARD_SCALE, SEARCH_CONFIGS, TrainingConfig
from parkenv.studies.training.curve_file import CURVE, read_curve
from parkenv.studies.workers import Workers
from parkenv.world.scenario import Scenario
from planners.model_file import LearnedAgent, algorithm_class, save_model, slots_observed

if TYPE_CHECKING:
    from parkenv.studies.training.spec import TrainingSpec

# First world seeds of the evaluations during training, and of the final test.
EVALUATION_SEED, TEST_SEED = 2_000_000, 3_000_000
# World seeds of training seed s start at (s + 1) times this, far from those of evaluations and benchmark suites.
TRAINING_SEEDS = 10_000_000
# Number of evaluations, and decisions between two at most, if the specification does not say.
EVALUATIONS, MOST_BETWEEN = 10, 100_000
MODEL, FIGURE, CHECKPOINT = "model.safetensors", "learning_curve.png", "checkpoint.pt"
METRICS = ("total_s", "low_s", "high_s", "parked_fraction")
HELD_OUT = ("held_out_s", "held_out_low_s", "held_out_high_s", "held_out_parked_fraction")
BESIDE_MODELS = 3  # number of planners replayed beside a trained model
_FORMAT = "parkenv-checkpoint-3"
PLANNERS = tuple(
    AgentSpec(name=name)
    for name in ("belief", "mdp-tuned", "mdp", "first-free", "greedy-drive", "greedy-goal")
)
# The same with held-out places: those that need no time on each lot.
PLANNERS_OF_PLACES = tuple(spec for spec in PLANNERS if spec.name not in ("mdp-tuned", "greedy-goal"))
# Fields of a specification that do not change its trainings, that `settings` gives in other words, or that a resumed
# training may change.
_OUTSIDE = {
    "kind", "jobs", "backend", "address", "trainings", "seed", "steps", "agents", "tensorboard", "scenarios",
    "held_out", "evaluate_on", "test_on",
}  # fmt: skip
# Total time of each episode, s, and whether its car parked.
Times = tuple[NDArray[np.float64], NDArray[np.bool_]]


class Training:
    """Trainings of a search agent in one scenario or several; the score is the mean total time in held-out worlds."""

    def __init__(self, spec: TrainingSpec) -> None:
        self.spec = spec
        self.evaluation_seeds = range(EVALUATION_SEED, EVALUATION_SEED + spec.evaluation_episodes)
        self.test_seeds = range(TEST_SEED, TEST_SEED + 2 * spec.evaluation_episodes)

    @property
    def holds_out(self) -> bool:
        return self.spec.held_out is not None or self.spec.evaluate_on is not None

    @property
    def compared(self) -> tuple[AgentSpec, ...]:
        usual = PLANNERS_OF_PLACES if self.holds_out else PLANNERS
        return usual if self.spec.agents is None else self.spec.agents

    @cached_property
    def sides(self) -> tuple[Sequence[Scenario], Sequence[Scenario]]:
        """Scenarios to train in, and places to evaluate in and not to train in."""
        given = [build(scenario) for scenario in self.spec.scenarios]
        if self.spec.held_out is not None:
            sides = split_by_lot(given, self.spec.held_out)
        else:
            sides = given, [build(scenario) for scenario in self.spec.evaluate_on or ()]
        require_apart(*sides)
        return sides

    @cached_property
    def tests(self) -> dict[str, Sequence[Scenario]]:
        """The tests in the end, by name: each is in one scenario, or in many of which every search draws one."""
        learned, held_out = self.sides
        if self.spec.test_on is None and self.holds_out:
            return {f"{_places(learned)} trained on": learned, f"{_places(held_out)} held out": held_out}
        tested = learned if self.spec.test_on is None else [build(one) for one in self.spec.test_on]
        return {scenario.name: [scenario] for scenario in tested}

    @property
    def metrics(self) -> tuple[str, ...]:
        """Mean total time, s, its 95 % interval, and the fraction of episodes that ended parked; also held out."""
        return METRICS + (HELD_OUT if self.sides[1] else ())

    @property
    def columns(self) -> tuple[str, ...]:
        return ("steps", *self.metrics, "wall_s")

    def check(self) -> None:
        algorithm_class(self.spec.algorithm)
        learned = self.sides[0]
        require_agents(self.compared, [learned[0], *(places[0] for places in self.tests.values())])

    def settings(self) -> Row:
        given = (*self.spec.scenarios, *(self.spec.evaluate_on or ()))
        learned, held_out = self.sides
        return {
            **self.spec.model_dump(mode="json", exclude=_OUTSIDE),
            "scenarios": {s.title: flat_tables(s.model_dump(mode="json")) for s in given},
            "files": fingerprints([file for s in given for file in s.files()]),
            "scenario": [world.name for world in learned],
            "held_out": [world.name for world in held_out],
        }

    @contextmanager
    def watched(self, out: Path, seeds: Sequence[int], progress: Progress) -> Iterator[None]:
        over = threading.Event()

        def follow() -> None:
            while not over.wait(2.0):
                for seed in seeds:
                    # The training itself reports a damaged curve.
                    with suppress(InputError):
                        if curve := read_curve(out / f"seed_{seed}" / CURVE, self.columns):
                            progress(f"seed {seed}", curve[-1]["steps"], self.spec.steps)

        watcher = threading.Thread(target=follow, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            over.set()
            watcher.join()

    # Learning

    @property
    def evaluate_every(self) -> int:
        return self.spec.evaluate_every or min(max(1, self.spec.steps // EVALUATIONS), MOST_BETWEEN)

    def make_env(self, n_envs: int) -> SearchVecEnv:
        return SearchVecEnv(n_envs, self.sides[0], REWARD_SCALE, self.spec.k, "local", MAX_STEPS)

    def train(self, seed: int, folder: Path, command: Sequence[str] = ()) -> list[Row]:
        """Train with one seed; go on from the folder's checkpoint if there is one, in worlds of its own.

        `model.safetensors` is the model with the best evaluation, `curve.csv` lists all evaluations. The checkpoint
        stays, so that a training can be made longer: what depends on how much of it is over, such as the learning
        rate, goes on as at that point of the longer one. A replay buffer begins empty.

        The `command` line stands in the model's card. Return the rows of `curve.csv`.
        """
        folder.mkdir(parents=True, exist_ok=True)
        checkpoint, curve = folder / CHECKPOINT, read_curve(folder / CURVE, self.columns)
        if curve and curve[-1]["steps"] >= self.spec.steps:
            return curve
        if len(curve) > 1 and not checkpoint.exists():
            raise InputError(
                f"{checkpoint}: is gone; the training cannot go on from {curve[-1]['steps']} steps"
            )
        begun = read_checkpoint(checkpoint) if checkpoint.exists() else None
        config = SEARCH_CONFIGS[self.spec.algorithm].for_steps(
            self.spec.steps, begun["n_envs"] if begun else None
        )
        env, rate = self.make_env(config.n_envs), config.settings["learning_rate"]
        model = algorithm_class(self.spec.algorithm)(
            config.policy,
            env,
            seed=seed,
            device="cpu",
            tensorboard_log=str(folder / "tensorboard") if self.spec.tensorboard else None,
            **dict(config.settings)
            | {"learning_rate": LinearSchedule(rate, rate * config.final_learning_rate, 1.0)},
        )
        if not self.spec.tensorboard:
            # Otherwise stable-baselines3 makes a new folder for logs in the system's folder of temporary files.
            model.set_logger(Logger(None, []))
        if begun is not None:
            restore(begun, model, checkpoint)
        # stable-baselines3 has seeded the environment with the network's seed.
        env.seed(TRAINING_SEEDS * (seed + 1) + model.num_timesteps)
        curve = [row for row in curve if begun and row["steps"] <= model.num_timesteps]
        evaluator = _Evaluator(self, config, folder, curve, command)
        left = self.spec.steps - model.num_timesteps
        if left > 0:
            model.learn(left, callback=evaluator, reset_num_timesteps=False, tb_log_name="run")
        if curve[-1]["steps"] < model.num_timesteps:
            evaluator.evaluate(model)
        return curve

    def evaluate(self, policy: Any) -> Row:
        """Run one episode in each held-out world, in the places trained on and in those held out."""
        runs = (episode_times(policy, places, self.evaluation_seeds) for places in filter(None, self.sides))
        values = ((*mean_interval(times), float(parked.mean())) for times, parked in runs)
        return dict(zip(self.metrics, itertools.chain.from_iterable(values), strict=True))

    def description(self, config: TrainingConfig) -> dict[str, Any]:
        learned, held_out = self.sides
        return {
            "scenarios": [place.name for place in learned],
            "held_out": [place.name for place in held_out],
            "settings": {"n_envs": config.n_envs, "policy": config.policy, **config.settings},
        }  # fmt: skip

    # Testing

    def report(self, results: Results) -> Row:
        progress, seeds = results.progress, range(self.spec.seed, self.spec.seed + self.spec.trainings)
        folders = {seed: results.path / f"seed_{seed}" for seed in seeds}
        curves = [read_curve(folder / CURVE, self.columns) for folder in folders.values()]
        lines, planners = self._test_planners(progress, results.workers)
        rows, transfer = list[Row](), list[Row]()
        # Of tests on either side of a split, the one on held-out places stands for the model.
        main = -1 if self.holds_out and self.spec.test_on is None else 0
        for number, (seed, folder) in enumerate(folders.items()):
            progress("Testing", number, len(folders))
            model, last = folder / MODEL, curves[number][-1]
            tested = [{"agent": self.spec.algorithm, "seed": seed, **row} for row in self.test(model)]
            transfer += tested
            rows.append({
                "agent": self.spec.algorithm, "scenario": tested[main]["test_scenario"], "seed": seed,
                "steps": last["steps"], "total_s": tested[main]["total_s"],
                "total_s_ci95": tested[main]["total_s_ci95"],
                "steps_per_s": last["steps"] / max(last["wall_s"], 1e-9), "model": str(model),
            })  # fmt: skip
        drawn = self._drawn(curves)
        means = {label: across_seeds(runs) for label, runs in drawn.items()}
        save_learning_curves(drawn, means, lines, self._title, results.path / FIGURE)
        progress("Testing", len(rows), len(rows))
        return {
            "rows": rows, "transfer": transfer, "planners": planners, "evaluated": lines,
            "curve": across_seeds(curves),
        }  # fmt: skip

    def _test_planners(self, progress: Progress, workers: Workers) -> tuple[dict[str, float], list[Row]]:
        lines, rows = dict[str, float](), list[Row]()
        if self.compared:
            doing, count = "Planners in the same worlds", 1 + len(self.tests)
            progress(doing, 0, count)
            learned, held_out = self.sides
            evaluated = rows_of(self.compared, held_out or learned, self.evaluation_seeds, workers)
            lines = {row["agent"]: row["total_s"] for row in evaluated}
            lines["clairvoyant bound"] = evaluated[0]["bound_s"]
            for number, (name, places) in enumerate(self.tests.items(), start=1):
                progress(doing, number, count)
                rows += rows_of(self.compared, places, self.test_seeds, workers, name)
            progress(doing, count, count)
        return lines, rows

    def test(self, model: Path) -> list[Row]:
        with own_thread_and_seeds():
            policy = LearnedAgent(self.sides[0][0], self.spec.algorithm, model).model
            return [
                {"test_scenario": name, **times_row(*episode_times(policy, places, self.test_seeds))}
                for name, places in self.tests.items()
            ]

    def replays(self, summary: Row, folder: Path, options: ReportOptions) -> Sequence[ReplayJob]:
        """Return the tests of the best model and of the best planners; nothing without a test."""
        if not summary.get("transfer"):
            return ()
        best = min(summary["rows"], key=lambda row: float(row["total_s"]))
        model = folder / f"seed_{int(best['seed'])}" / MODEL
        seeds = range(TEST_SEED, TEST_SEED + int(summary["transfer"][0]["episodes"]))
        cases: list[tuple[Case, Sequence[int]]] = []
        for name, (scenario, *_) in self.tests.items():
            planners = [row for row in summary.get("planners", []) if row["scenario"] == name]
            beside = sorted(planners, key=lambda row: float(row["total_s"]))[:BESIDE_MODELS]
            cases.append((Case(scenario, f"{self.spec.algorithm}:{model}"), seeds))
            compared = (Case(scenario, agent.name, options=agent.options) for agent in self.compared)
            by_label = {case.label: case for case in compared}
            cases += [(by_label[row["agent"]], seeds) for row in beside if row["agent"] in by_label]
        return [search_replay(cases, folder, options)]

    @property
    def _title(self) -> str:
        learned, held_out = self.sides
        where = learned[0].name if len(learned) == 1 else _places(learned)
        where = f"{_places(held_out)} held out" if self.holds_out else where
        return f"{where}: {self.spec.evaluation_episodes} searches in held-out worlds"

    def _drawn(self, curves: list[list[Row]]) -> dict[str, list[list[Row]]]:
        scenarios = f" on {', '.join(s.name for s in self.sides[0])}" if len(self.sides[0]) > 1 else ""
        name = self.spec.algorithm + scenarios
        if not self.holds_out:
            return {name: curves}
        apart = [[row | {"total_s": row["held_out_s"]} for row in curve] for curve in curves]
        return {f"{name}, {_places(self.sides[0])} trained on": curves, f"{name}, held out": apart}


class _Evaluator(BaseCallback):  # type: ignore[misc]
    def __init__(
        self,
        training: Training,
        config: TrainingConfig,
        folder: Path,
        curve: list[Row],
        command: Sequence[str],
    ) -> None:
        super().__init__()
        self.subject, self.config, self.folder, self.curve = training, config, folder, curve
        self.command = command
        self._start = time.monotonic() - (curve[-1]["wall_s"] if curve else 0.0)
        self._due = self._due_after(curve[-1]["steps"] if curve else 0)

    def _due_after(self, steps: int) -> int:
        return self.subject.evaluate_every * (1 + steps // self.subject.evaluate_every)

    def _on_rollout_start(self) -> None:
        # Between rollouts, so that a checkpoint loses no samples.
        if not self.curve or self.num_timesteps >= self._due:
            self._due = self._due_after(self.num_timesteps)
            for name, value in self.evaluate(self.model).items():
                self.logger.record(f"evaluation/{name}", value)

    def _on_step(self) -> bool:
        return True

    def evaluate(self, model: Any) -> Row:
        """Evaluate; keep the model if it is the best so far; write the curve and a checkpoint; return the metrics."""
        scores = self.subject.evaluate(model.policy)
        best = min((row["total_s"] for row in self.curve), default=np.inf)
        self.curve.append({"steps": model.num_timesteps, **scores, "wall_s": time.monotonic() - self._start})
        if scores["total_s"] <= best:
            described = self.subject.description(self.config)
            save_model(model, self.folder / MODEL, results=scores, command=self.command, **described)
        write_csv(self.folder / CURVE, list(self.curve[0]), self.curve)
        # Last: a training that is killed before this line repeats what it has just done.
        save_checkpoint(self.folder / CHECKPOINT, model)
        return scores


def times_row(times: NDArray[np.float64], parked: NDArray[np.bool_]) -> Row:
    mean, low, high = mean_interval(times)
    return {
        "episodes": len(times),
        "parked_fraction": float(parked.mean()),
        "total_s": mean,
        "total_s_ci95": [low, high],
    }


def episode_times(model: Any, places: Scenario | Sequence[Scenario], seeds: Sequence[int]) -> Times:
    """Run episodes; return their total times, (n,) s, and whether the car parked, (n,) bool.

    An episode that has not ended after `MAX_STEPS` decisions is charged `give_up_s`, as in `parkenv compare`. The model
    observes `local`; of several places, each seed draws one.
    """
    n = len(seeds)
    k = slots_observed(model.observation_space)
    batch = ParkSearchVectorEnv(n, places, "local", k, MAX_STEPS)
    seen, _ = batch.reset(seed=list(seeds))
    give_up_s = np.array([scenario.give_up_s for scenario in batch.scenarios])[batch.scenario_index]
    times, parked = np.full(n, np.nan), np.zeros(n, dtype=np.bool_)
    state, start = None, np.ones(n, dtype=np.bool_)
    masked = "action_masks" in model.predict.__code__.co_varnames
    while np.isnan(times).any():
        masks = {"action_masks": seen["action_mask"]} if masked else {}
        actions, state = model.predict(seen, state=state, episode_start=start, deterministic=True, **masks)
        seen, _, terminated, truncated, info = batch.step(actions)
        start = terminated | truncated
        first = start & np.isnan(times)
        if first.any():
            charge_truncation(info, give_up_s, truncated & ~terminated)
            times[first] = info["total_s"][first]
            parked[first] = info["parked"][first]
    return times, parked


@contextmanager
def own_thread_and_seeds() -> Iterator[None]:
    """Train on a single thread, so that one training per core can run in parallel; put global settings back.

    stable-baselines3 seeds the generators of Python, NumPy and PyTorch.
    """
    from numba import get_num_threads

    threads = torch.get_num_threads()
    states = random.getstate(), np.random.get_state()  # noqa: NPY002 - what others use
    # Starting numba's threads sets the number of OpenMP's, which PyTorch has, too.
    get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng(devices=[]):
            yield
    finally:
        torch.set_num_threads(threads)
        random.setstate(states[0])
        np.random.set_state(states[1])  # noqa: NPY002


def save_checkpoint(path: Path, model: Any) -> None:
    """Write the parameters of a model and its optimizer, and the number of its decisions; the file runs no code."""
    state = {"format": _FORMAT, "n_envs": model.n_envs, "steps": model.num_timesteps}
    with atomic_write(path) as beside, beside.open("wb", buffering=0) as file:
        try:
            torch.save(state | {"parameters": model.get_parameters()}, file)
        except RuntimeError as error:
            # PyTorch raises its own error after that of a full disk.
            raise error.__context__ or error from None


def read_checkpoint(path: Path) -> dict[str, Any]:
    try:
        with zipfile.ZipFile(path) as archive:
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
                raise ValueError("it has compressed parts")
            if damaged := archive.testzip():
                raise ValueError(f"{damaged} is not as it was written")
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        if state["format"] != _FORMAT or not all(
            isinstance(state[name], int) for name in ("n_envs", "steps")
        ):
            raise ValueError(f"want {_FORMAT}")
    except Exception as error:  # torch raises many types for damaged files
        raise InputError(
            f"{path}: no checkpoint of this version, or a damaged one ({error}); train again with --overwrite"
        ) from error
    return state


def restore(state: dict[str, Any], model: Any, path: Path) -> None:
    try:
        model.set_parameters(state["parameters"], device="cpu")
    except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: does not fit this training ({error}); train again with --overwrite"
        ) from error
    model.num_timesteps = state["steps"]
    if hasattr(model, "learning_starts"):
        model.learning_starts += model.num_timesteps


def across_seeds(curves: Sequence[Sequence[Row]]) -> list[dict[str, float]]:
    """Return mean, 95 % interval and median of `total_s` over seeds, at evaluations that all seeds have."""
    rows = []
    for evaluations in zip(*curves, strict=False):
        values = [row["total_s"] for row in evaluations]
        mean, low, high = mean_interval(values)
        rows.append({
            "steps": float(np.mean([row["steps"] for row in evaluations])), "total_s": mean, "low_s": low,
            "high_s": high, "median_s": float(np.median(values)),
        })  # fmt: skip
    return rows


def require_apart(learned: Sequence[Scenario], held_out: Sequence[Scenario]) -> None:
    if not held_out:
        return
    require_different_names([*learned, *held_out])
    shares = {lot_share(scenario.lot): scenario.name for scenario in learned}
    for scenario in held_out:
        require(
            (same := shares.get(lot_share(scenario.lot))) is None,
            f"evaluate_on has {scenario.name!r}, whose lot is that of {same!r}, which is trained on",
        )


def _places(scenarios: Sequence[Scenario]) -> str:
    return plural(len(scenarios), "scenario")
