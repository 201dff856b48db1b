"""Training for `parkenv/Search-v2`: the score is the mean total time."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from parkenv.envs.sb3 import SearchVecEnv
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.errors import InputError
from parkenv.scenarios.build import build
from parkenv.scenarios.selection import (
    by_size,
    lot_share,
    open_scenarios,
    require_different_names,
    scenario_of_episode,
    split_by_lot,
)
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.show.plurals import plural
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.cases import Case, rows_of
from parkenv.studies.compare.search_replay import SearchReplay
from parkenv.studies.report import Replay
from parkenv.studies.simulate import charge_truncation
from parkenv.studies.statistics import mean_interval
from parkenv.studies.study import Progress
from parkenv.studies.training.cloning import Demonstrations, clone, require_cloneable
from parkenv.studies.training.configs import (
    MAX_STEPS,
    REWARD_SCALE,
    SEARCH_CONFIGS,
    TrainingConfig,
)
from parkenv.studies.training.curve_file import Row
from parkenv.studies.training.learning import RLTraining
from parkenv.studies.training.spec import SearchTrainingSpec
from parkenv.studies.training.training import MODEL, TEST_SEED, Tested, name_of
from parkenv.studies.workers import Workers
from parkenv.world.scenario import Scenario
from planners.agent import make_agent
from planners.learned import LearnedAgent
from planners.model_file import observation_of

Times = tuple[NDArray[np.float64], NDArray[np.bool_]]
"""Total time of each episode, s, and whether its car parked."""
METRICS = ("total_s", "low_s", "high_s", "parked_fraction")
HELD_OUT = ("held_out_s", "held_out_low_s", "held_out_high_s", "held_out_parked_fraction")
BESIDE_MODELS = 3
"""Number of planners replayed beside a trained model."""
DEMONSTRATION_SEED = 5_000_000
"""First world seed of the demonstrations."""
PLANNERS = tuple(
    AgentSpec(name=name)
    for name in ("belief", "mdp-tuned", "mdp", "first-free", "greedy-drive", "greedy-goal")
)
"""Agents to compare with, if none are named."""
PLANNERS_OF_PLACES = tuple(spec for spec in PLANNERS if spec.name not in ("mdp-tuned", "greedy-goal"))
"""The same with held-out places: those that need no time on each lot."""


class SearchTraining(RLTraining):
    """Training of a search agent in one scenario or several; the score is the mean total time."""

    spec: SearchTrainingSpec
    most_between = 100_000
    evaluated_by = ("scenario", "held_out", "evaluation_episodes")
    configs: ClassVar[Mapping[str, TrainingConfig]] = SEARCH_CONFIGS
    shared: Demonstrations | None = None
    """Demonstrations to clone before training."""

    @property
    def given_scenarios(self) -> tuple[ScenarioSpec, ...]:
        """See `Training`."""
        return (*self.scenarios, *(self.spec.evaluate_on or ()))

    @property
    def holds_out(self) -> bool:
        """Whether evaluations are also in places that are not trained in."""
        return self.spec.held_out is not None or self.spec.evaluate_on is not None

    @property
    def compared(self) -> tuple[AgentSpec, ...]:
        """See `Training`."""
        usual = PLANNERS_OF_PLACES if self.holds_out else PLANNERS
        return usual if self.spec.agents is None else self.spec.agents

    @cached_property
    def sides(self) -> tuple[Sequence[Scenario], Sequence[Scenario]]:
        """Scenarios to train in, and places to evaluate in and not to train in."""
        given = [build(scenario) for scenario in self.scenarios]
        if self.spec.held_out is not None:
            sides = split_by_lot(given, self.spec.held_out)
        else:
            sides = given, [build(scenario) for scenario in self.spec.evaluate_on or ()]
        require_apart(*sides)
        return sides

    @cached_property
    def tests(self) -> dict[str, Sequence[Scenario]]:
        """See `Training`: each is in one scenario, or in many of which every search draws one."""
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
    def measures(self) -> tuple[str, ...]:
        """See `Training`."""
        return ("total_s", "held_out_s") if self.holds_out else ("total_s",)

    @property
    def announcement(self) -> str | None:
        """See `Training`."""
        if not self.holds_out:
            return None
        learned, held_out = self.sides
        names = ", ".join(scenario.name for scenario in held_out)
        return f"Trained on {_places(learned)}, and evaluated on {_places(held_out)} held out: {names}"

    def check(self) -> None:
        """See `Training`."""
        super().check()
        learned = self.sides[0]
        if self.spec.clone is not None:
            require_cloneable(self.algorithm, self.spec.clone, learned[0])
        for world in (learned[0], *(places[0] for places in self.tests.values())):
            for agent in self.compared:
                make_agent(agent.name, world, **agent.options)

    def settings(self) -> Row:
        """See `Training`."""
        learned, held_out = self.sides
        names = {
            "scenario": [world.name for world in learned],
            "held_out": [world.name for world in held_out],
        }
        return super().settings() | names

    def begin(self, progress: Progress) -> None:
        """Record the searches of the planner to clone."""
        planner = self.spec.clone
        if planner is not None:
            count = self.spec.demonstrations or 2000
            seeds = range(DEMONSTRATION_SEED, DEMONSTRATION_SEED + count)
            progress(f"Recording searches of {planner}", 0, count)
            self.shared = Demonstrations.collect(planner, self.sides[0], seeds, self.spec.k)
            progress(f"Recording searches of {planner}", count, count)

    def make_env(self) -> SearchVecEnv:
        """Make a batch of search environments over all scenarios."""
        places = self.sides[0] if self.spec.curriculum is None else by_size(self.sides[0])
        env = SearchVecEnv(self.config.n_envs, places, REWARD_SCALE, self.spec.k, "local", MAX_STEPS)
        self._open_places(env, 0.0)
        return env

    def before_rollout(self, model: Any) -> None:
        """Add the places that the curriculum has come to."""
        self._open_places(model.env, model.num_timesteps / self.steps)

    def _open_places(self, env: SearchVecEnv, progress: float) -> None:
        if self.spec.curriculum is not None:
            env.batch.n_places = open_scenarios(len(self.sides[0]), progress)

    def prepare(self, model: Any, seed: int) -> None:
        """Clone the demonstrations, if any."""
        if self.shared is not None:
            clone(model, self.shared, seed)

    def evaluate(self, policy: Any, env: VecEnv) -> Row:
        """Run one episode in each held-out world, in the places trained on and in those held out."""
        del env
        found = (episode_times(policy, places, self.evaluation_seeds) for places in filter(None, self.sides))
        return self.metrics_of(found)

    def metrics_of(self, found: Iterable[Times]) -> Row:
        """Return the `metrics` of the times in the places trained on, and in those held out."""
        values = ((*mean_interval(times), float(parked.mean())) for times, parked in found)
        return dict(zip(self.metrics, itertools.chain.from_iterable(values), strict=True))

    def description(self) -> dict[str, Any]:
        """Return scenarios and settings for the model file."""
        learned, held_out = self.sides
        return {
            "scenarios": [place.name for place in learned],
            "held_out": [place.name for place in held_out],
            "settings": self.settings_of_model(clone=self.spec.clone, curriculum=self.spec.curriculum),
        }

    def evaluate_planners(self, workers: Workers) -> dict[str, float]:
        """See `Training`; also the clairvoyant bound."""
        learned, held_out = self.sides
        rows = rows_of(self.compared, held_out or learned, self.evaluation_seeds, workers)
        return {row["agent"]: row["total_s"] for row in rows} | {"clairvoyant bound": rows[0]["bound_s"]}

    def test_planners(self, name: str, workers: Workers) -> list[Row]:
        """See `Training`."""
        return rows_of(self.compared, self.tests[name], self.test_seeds, workers, name)

    def test(self, model: Path, workers: Workers) -> Tested:
        """See `Training`."""
        del workers
        transfer, by_place = list[Row](), list[Row]()
        for name, places in self.tests.items():
            times, parked = self.times_of(model, places)
            transfer.append({"test_scenario": name, **times_row(times, parked)})
            if len(places) > 1:
                rows = self._rows_by_place(places, times, parked)
                by_place += [{"test_scenario": name} | row for row in rows]
        # The first test; of those on either side of a split, the one on held-out places.
        main = transfer[-1 if self.holds_out and self.spec.test_on is None else 0]
        own = {c: main[c] for c in ("total_s", "total_s_ci95")}
        return Tested(main["test_scenario"], own, transfer, by_place)

    def times_of(self, model: Path, places: Sequence[Scenario]) -> Times:
        """Test a model: return the times of the test's episodes, s, and whether the car parked."""
        agent = LearnedAgent(self.sides[0][0], self.algorithm, model)
        return episode_times(agent.model, places, self.test_seeds)

    def replays(self, summary: Row, folder: Path) -> Sequence[Replay]:
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
            cases.append((Case(scenario, f"{self.algorithm}:{model}"), seeds))
            compared = (Case(scenario, agent.name, options=agent.options) for agent in self.compared)
            made = {case.label: case for case in compared}
            cases += [(made[row["agent"]], seeds) for row in beside if row["agent"] in made]
        return [SearchReplay(cases, folder)]

    @property
    def title(self) -> str:
        """See `Training`."""
        learned, held_out = self.sides
        where = learned[0].name if len(learned) == 1 else _places(learned)
        where = f"{_places(held_out)} held out" if self.holds_out else where
        return f"{where}: {self.evaluation_episodes} searches in held-out worlds"

    def drawn(self, curves: list[list[Row]]) -> dict[str, list[list[Row]]]:
        """See `Training`."""
        name = name_of(self.settings())
        if not self.holds_out:
            return {name: curves}
        apart = [[row | {"total_s": row["held_out_s"]} for row in curve] for curve in curves]
        return {f"{name}, {_places(self.sides[0])} trained on": curves, f"{name}, held out": apart}

    def _rows_by_place(
        self, places: Sequence[Scenario], times: NDArray[np.float64], parked: NDArray[np.bool_]
    ) -> list[Row]:
        """Return a row of the test for each place that a search was in."""
        place_of = np.array([scenario_of_episode(seed, 0, len(places)) for seed in self.test_seeds])
        return [
            {"place": place.name, "slots": place.lot.n_slots, **times_row(times[its], parked[its])}
            for i, place in enumerate(places)
            if (its := place_of == i).any()
        ]


def require_apart(learned: Sequence[Scenario], held_out: Sequence[Scenario]) -> None:
    """Check that no place is on both sides.

    Raises:
        InputError: two places have one name, or a held-out lot is also one to train on.
    """
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
    _, _, k = observation_of(model.observation_space)
    batch = ParkSearchVectorEnv(n, places, "local", k, MAX_STEPS)
    seen, _ = batch.reset(seed=list(seeds))
    give_up_s = np.array([scenario.give_up_s for scenario in batch.scenarios])[batch.place_of]
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
