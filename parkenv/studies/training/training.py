"""Training of search agents with stable-baselines3: learn, evaluate in held-out worlds, test, compare with planners."""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import LinearSchedule

from parkenv.envs.sb3 import SearchVecEnv
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.errors import InputError
from parkenv.files.csv_tables import write_csv
from parkenv.files.spec_file import Several, Spec
from parkenv.scenarios.build import build
from parkenv.scenarios.selection import (
    by_size,
    lot_share,
    open_scenarios,
    require_different_names,
    scenario_of_episode,
    split_by_lot,
)
from parkenv.show.figures.times import TRAINING_COLORS, save_learning_curves
from parkenv.show.plurals import plural
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.cases import Case, rows_of
from parkenv.studies.compare.search_replay import search_replay
from parkenv.studies.fingerprints import fingerprints, flat_tables
from parkenv.studies.report import ReplayJob
from parkenv.studies.report_options import ReportOptions
from parkenv.studies.results import SETTINGS, Results, read_settings
from parkenv.studies.simulate import charge_truncation
from parkenv.studies.statistics import mean_interval
from parkenv.studies.study import Progress
from parkenv.studies.training.checkpoint import read_checkpoint, restore, save_checkpoint
from parkenv.studies.training.cloning import Demonstrations, clone, require_cloneable
from parkenv.studies.training.configs import MAX_STEPS, REWARD_SCALE, SEARCH_CONFIGS, TrainingConfig
from parkenv.studies.training.curve_file import CURVE, Row, across_seeds, read_curve, require_columns
from parkenv.studies.workers import Workers
from parkenv.world.scenario import Scenario
from planners.agent import make_agent
from planners.model_file import LearnedAgent, algorithm_class, save_model, slots_observed

if TYPE_CHECKING:
    from parkenv.studies.training.spec import TrainingSpec

EVALUATION_SEED, TEST_SEED, DEMONSTRATION_SEED = 2_000_000, 3_000_000, 5_000_000
"""First world seeds of the evaluations during training, of the final test, and of the demonstrations."""
TRAINING_SEEDS = 10_000_000
"""World seeds of training seed s start at (s + 1) times this, far from those of evaluations and benchmark suites."""
EVALUATIONS, MOST_BETWEEN = 10, 100_000
"""Number of evaluations, and decisions between two at most, if the specification does not say."""
MODEL, FIGURE, CHECKPOINT = "model.safetensors", "learning_curve.png", "checkpoint.pt"
METRICS = ("total_s", "low_s", "high_s", "parked_fraction")
HELD_OUT = ("held_out_s", "held_out_low_s", "held_out_high_s", "held_out_parked_fraction")
BESIDE_MODELS = 3
"""Number of planners replayed beside a trained model."""
EVALUATED_BY = ("scenario", "held_out", "evaluation_episodes")
"""Settings that evaluations depend on: curves are comparable if these are equal."""
PLANNERS = tuple(
    AgentSpec(name=name)
    for name in ("belief", "mdp-tuned", "mdp", "first-free", "greedy-drive", "greedy-goal")
)
"""Agents to compare with, if none are named."""
PLANNERS_OF_PLACES = tuple(spec for spec in PLANNERS if spec.name not in ("mdp-tuned", "greedy-goal"))
"""The same with held-out places: those that need no time on each lot."""
_OUTSIDE = {
    "kind", "jobs", "backend", "address", "trainings", "seed", "steps", "agents", "tensorboard", "scenarios",
    "held_out", "evaluate_on", "test_on", "beside",
}  # fmt: skip
"""Fields of a specification that do not change its trainings, that `settings` gives in other words, or that a resumed
training may change."""
Times = tuple[NDArray[np.float64], NDArray[np.bool_]]
"""Total time of each episode, s, and whether its car parked."""


class Training:
    """Trainings of a search agent in one scenario or several; the score is the mean total time in held-out worlds.

    Args:
        spec: specification of the training.
    """

    def __init__(self, spec: TrainingSpec) -> None:
        self.spec = spec
        self.evaluation_seeds = range(EVALUATION_SEED, EVALUATION_SEED + spec.evaluation_episodes)
        self.test_seeds = range(TEST_SEED, TEST_SEED + 2 * spec.evaluation_episodes)

    @property
    def holds_out(self) -> bool:
        """Whether evaluations are also in places that are not trained in."""
        return self.spec.held_out is not None or self.spec.evaluate_on is not None

    @property
    def compared(self) -> tuple[AgentSpec, ...]:
        """Agents to compare with."""
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
        """All columns of `curve.csv`."""
        return ("steps", *self.metrics, "wall_s")

    @property
    def announcement(self) -> str | None:
        """Which places are held out, if any."""
        if not self.holds_out:
            return None
        learned, held_out = self.sides
        names = ", ".join(scenario.name for scenario in held_out)
        return f"Trained on {_places(learned)}, and evaluated on {_places(held_out)} held out: {names}"

    def check(self) -> None:
        """Check, before training, that everything can be trained, tested and drawn."""
        algorithm_class(self.spec.algorithm)
        learned = self.sides[0]
        if self.spec.clone is not None:
            require_cloneable(self.spec.algorithm, self.spec.clone, learned[0])
        for world in (learned[0], *(places[0] for places in self.tests.values())):
            for agent in self.compared:
                make_agent(agent.name, world, **agent.options)

    def settings(self) -> Row:
        """Return the settings that a resumed training must share with this one."""
        given = (*self.spec.scenarios, *(self.spec.evaluate_on or ()))
        learned, held_out = self.sides
        return {
            **self.spec.model_dump(mode="json", exclude=_OUTSIDE),
            "scenarios": {s.title: flat_tables(s.model_dump(mode="json")) for s in given},
            "files": fingerprints([file for s in given for file in s.files()]),
            "scenario": [world.name for world in learned],
            "held_out": [world.name for world in held_out],
        }

    def demonstrations(self, progress: Progress) -> Demonstrations | None:
        """Record the searches of the planner to clone, if any, which the trainings with all seeds share."""
        planner = self.spec.clone
        if planner is None:
            return None
        count = self.spec.demonstrations or 2000
        seeds = range(DEMONSTRATION_SEED, DEMONSTRATION_SEED + count)
        progress(f"Recording searches of {planner}", 0, count)
        shown = Demonstrations.collect(planner, self.sides[0], seeds, self.spec.k)
        progress(f"Recording searches of {planner}", count, count)
        return shown

    @contextmanager
    def watched(self, out: Path, seeds: Sequence[int], progress: Progress) -> Iterator[None]:
        """Follow the curves that trainings write into a folder, with a bar for each, during a block."""
        over = threading.Event()

        def follow() -> None:
            while not over.wait(2.0):
                for seed in seeds:
                    # The training itself reports a damaged curve.
                    with suppress(InputError):
                        if curve := read_curve(out / f"seed_{seed}" / CURVE, self.columns):
                            last = curve[-1]
                            progress(f"seed {seed}", last["steps"], self.spec.steps)

        watcher = threading.Thread(target=follow, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            over.set()
            watcher.join()

    # Learning

    def config(self, n_envs: int | None = None) -> TrainingConfig:
        """Return the training config of the algorithm.

        Args:
            n_envs: environments of the training that goes on; None for a new one.
        """
        return SEARCH_CONFIGS[self.spec.algorithm].for_steps(self.spec.steps, n_envs)

    @property
    def evaluate_every(self) -> int:
        """Decisions between evaluations."""
        return self.spec.evaluate_every or min(max(1, self.spec.steps // EVALUATIONS), MOST_BETWEEN)

    def make_env(self, n_envs: int) -> SearchVecEnv:
        """Make a batch of search environments over all scenarios."""
        places = self.sides[0] if self.spec.curriculum is None else by_size(self.sides[0])
        env = SearchVecEnv(n_envs, places, REWARD_SCALE, self.spec.k, "local", MAX_STEPS)
        self.open_scenarios(env, 0)
        return env

    def open_scenarios(self, env: SearchVecEnv, steps: int) -> None:
        """Let the environments draw from the places that the curriculum has come to."""
        if self.spec.curriculum is not None:
            env.batch.n_scenarios = open_scenarios(len(self.sides[0]), steps / self.spec.steps)

    def train(
        self, seed: int, folder: Path, shown: Demonstrations | None = None, command: Sequence[str] = ()
    ) -> list[Row]:
        """Train with one seed; resume from the folder's checkpoint if there is one, as if there had been no stop.

        `model.safetensors` is the model with the best evaluation, `curve.csv` lists all evaluations. The checkpoint
        stays, so that a training can be made longer: what depends on how much of it is over, such as the learning
        rate, goes on as at that point of the longer one.

        Args:
            seed: seed of the network and of the worlds.
            folder: output folder, created if missing.
            shown: demonstrations to clone first.
            command: command line, for the model's card.

        Returns:
            The rows of `curve.csv`.
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
        config = self.config(begun and begun[0]["n_envs"])
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
        # stable-baselines3 has seeded the environment with the network's seed.
        env.seed(TRAINING_SEEDS * (seed + 1))
        if begun is not None:
            state, curve = begun
            require_columns(curve, self.columns, checkpoint)
            restore(state, model)
        else:
            curve = []
            if shown is not None:
                clone(model, shown, seed)
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
        """Return scenarios and settings for the model file."""
        learned, held_out = self.sides
        return {
            "scenarios": [place.name for place in learned],
            "held_out": [place.name for place in held_out],
            "settings": {
                "n_envs": config.n_envs, "policy": config.policy, **config.settings,
                "clone": self.spec.clone, "curriculum": self.spec.curriculum,
            },
        }  # fmt: skip

    # Testing

    def report(self, results: Results) -> Row:
        """Test the models, and draw the figure; return the entries of the summary."""
        progress, beside = results.progress, self.curves_beside(results.path)
        seeds = range(self.spec.seed, self.spec.seed + self.spec.trainings)
        folders = {seed: results.path / f"seed_{seed}" for seed in seeds}
        curves = [read_curve(folder / CURVE, self.columns) for folder in folders.values()]
        lines, planners = self._test_planners(progress, results.workers)
        rows, transfer, places = list[Row](), list[Row](), list[Row]()
        # Of tests on either side of a split, the one on held-out places stands for the model.
        main = -1 if self.holds_out and self.spec.test_on is None else 0
        for number, (seed, folder) in enumerate(folders.items()):
            progress("Testing", number, len(folders))
            model = folder / MODEL
            of_model, last = {"agent": self.spec.algorithm, "seed": seed}, curves[number][-1]
            tested, by_place = self.test(model)
            transfer += [of_model | row for row in tested]
            places += [of_model | row for row in by_place]
            rows.append({
                "agent": self.spec.algorithm, "scenario": tested[main]["test_scenario"], "seed": seed,
                "steps": last["steps"], "total_s": tested[main]["total_s"],
                "total_s_ci95": tested[main]["total_s_ci95"],
                "steps_per_s": last["steps"] / max(last["wall_s"], 1e-9), "model": str(model),
            })  # fmt: skip
        drawn = self._drawn(curves) | beside
        means = {label: across_seeds(runs) for label, runs in drawn.items()}
        save_learning_curves(drawn, means, lines, self._title, results.path / FIGURE)
        progress("Testing", len(rows), len(rows))
        return {
            "rows": rows, "transfer": transfer, "planners": planners, "evaluated": lines,
            **({"places": places} if places else {}),
            "curve": across_seeds(curves),
            "beside": {name: across_seeds(runs) for name, runs in beside.items()},
        }  # fmt: skip

    def _test_planners(self, progress: Progress, workers: Workers) -> tuple[dict[str, float], list[Row]]:
        """Return the scores of the agents to compare with and of the clairvoyant bound, and the rows of their tests."""
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

    def test(self, model: Path) -> tuple[list[Row], list[Row]]:
        """Test a model; return a row for each test, and a row for each place of tests that are in many."""
        policy = LearnedAgent(self.sides[0][0], self.spec.algorithm, model).model
        rows, by_place = list[Row](), list[Row]()
        for name, places in self.tests.items():
            times, parked = episode_times(policy, places, self.test_seeds)
            rows.append({"test_scenario": name, **times_row(times, parked)})
            if len(places) > 1:
                by_place += [{"test_scenario": name, **row} for row in self._by_place(places, times, parked)]
        return rows, by_place

    def _by_place(
        self, places: Sequence[Scenario], times: NDArray[np.float64], parked: NDArray[np.bool_]
    ) -> list[Row]:
        """Return a row of the test for each place that a search was in."""
        scenario_index = np.array([scenario_of_episode(seed, 0, len(places)) for seed in self.test_seeds])
        return [
            {"place": place.name, "slots": place.lot.n_slots, **times_row(times[of_place], parked[of_place])}
            for i, place in enumerate(places)
            if (of_place := scenario_index == i).any()
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
        """Title of the figure of learning curves."""
        learned, held_out = self.sides
        where = learned[0].name if len(learned) == 1 else _places(learned)
        where = f"{_places(held_out)} held out" if self.holds_out else where
        return f"{where}: {self.spec.evaluation_episodes} searches in held-out worlds"

    def _drawn(self, curves: list[list[Row]]) -> dict[str, list[list[Row]]]:
        """Return the curves to draw, by name."""
        name = name_of(self.settings())
        if not self.holds_out:
            return {name: curves}
        apart = [[row | {"total_s": row["held_out_s"]} for row in curve] for curve in curves]
        return {f"{name}, {_places(self.sides[0])} trained on": curves, f"{name}, held out": apart}

    def curves_beside(self, out: Path) -> dict[str, list[list[Row]]]:
        """Read the curves of the trainings to draw beside: the rows of `curve.csv` of each seed, by name.

        Args:
            out: folder of this training.
        """
        if len(self.spec.beside) >= len(TRAINING_COLORS):
            raise InputError(
                f"--beside names {len(self.spec.beside)} folders, want at most {len(TRAINING_COLORS) - 1}"
            )
        own, known = self.settings(), {os.path.realpath(out)}
        columns = ("steps", "total_s", "held_out_s") if self.holds_out else ("steps", "total_s")
        beside: dict[str, list[list[Row]]] = {}
        for folder in map(Path, self.spec.beside):
            if os.path.realpath(folder) in known:
                raise InputError(f"--beside: {folder} is already drawn")
            known.add(os.path.realpath(folder))
            settings = read_settings(folder)
            curves = [read_curve(file, columns) for file in sorted(folder.glob(f"seed_*/{CURVE}"))]
            curves = [curve for curve in curves if curve]
            if settings is None or not curves or "algorithm" not in settings:
                raise InputError(f"--beside: {folder} holds no training")
            label = name_of(settings, str(folder / SETTINGS))
            for name in EVALUATED_BY:
                if settings.get(name) != own.get(name):
                    raise InputError(
                        f"--beside: {name} is {settings.get(name)!r} in {folder} and {own.get(name)!r} here; their "
                        "evaluations cannot be compared"
                    )
            if label == name_of(own) or label in beside:
                label = f"{label} ({folder})"
            beside[label] = curves
        return beside


class _Evaluator(BaseCallback):  # type: ignore[misc]
    """Callback that evaluates and saves the model during training."""

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
        """Return the step of the next evaluation; it depends on `steps` alone, so an interruption changes nothing."""
        return self.subject.evaluate_every * (1 + steps // self.subject.evaluate_every)

    def _on_rollout_start(self) -> None:
        self.subject.open_scenarios(self.model.env, self.model.num_timesteps)
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
        save_checkpoint(self.folder / CHECKPOINT, model, self.curve)
        return scores


def times_row(times: NDArray[np.float64], parked: NDArray[np.bool_]) -> Row:
    """Return the total times of episodes as columns of `parkenv compare`."""
    mean, low, high = mean_interval(times)
    return {
        "episodes": len(times),
        "parked_fraction": float(parked.mean()),
        "total_s": mean,
        "total_s_ci95": [low, high],
    }


def episode_times(model: Any, places: Scenario | Sequence[Scenario], seeds: Sequence[int]) -> Times:
    """Run episodes; return their total times, (n,) s, and whether the car parked, (n,) bool.

    An episode that has not ended after `MAX_STEPS` decisions is charged `give_up_s`, as in `parkenv compare`.

    Args:
        model: a stable-baselines3 or sb3-contrib model of the `local` observation.
        places: scenario to search in; or several, of which each seed draws one.
        seeds: one episode each.
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


def use_one_thread() -> None:
    """Let this process train on a single thread, so that one training per core can run in parallel."""
    import torch
    from numba import get_num_threads

    # Starting numba's threads sets the number of OpenMP's, which PyTorch has, too.
    get_num_threads()
    torch.set_num_threads(1)


class _Naming(Spec, extra="ignore"):
    """The settings that a training is named after."""

    algorithm: str
    scenario: Several[str] | None = None
    clone: str | None = None


def name_of(settings: Row, source: str = "settings") -> str:
    """Return the name of a training in a figure with others."""
    naming = _Naming.parse(settings, source)
    scenarios = naming.scenario or ()
    name = naming.algorithm + (f" on {', '.join(scenarios)}" if len(scenarios) > 1 else "")
    return f"{name} after cloning {naming.clone}" if naming.clone else name


def require_apart(learned: Sequence[Scenario], held_out: Sequence[Scenario]) -> None:
    """Check that no place is on both sides."""
    if not held_out:
        return
    require_different_names([*learned, *held_out])
    shares = {lot_share(scenario.lot): scenario.name for scenario in learned}
    for scenario in held_out:
        if (same := shares.get(lot_share(scenario.lot))) is not None:
            raise InputError(
                f"evaluate_on has {scenario.name!r}, whose lot is that of {same!r}, which is trained on"
            )


def _places(scenarios: Sequence[Scenario]) -> str:
    return plural(len(scenarios), "scenario")
