"""`parkenv train`: train agents by reinforcement learning, and evaluate them against planners."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from parkenv.cli import arguments as args
from parkenv.cli.study_run import run_study
from parkenv.cli.tables import make_table
from parkenv.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.studies.runner import Result


def train(
    algorithm: str | None = None,
    /,
    env: Literal["search", "fleet", "drive"] = "search",
    scenario: str | None = None,
    steps: int | None = None,
    trainings: int = 5,
    seed: int = 0,
    out: Path | None = None,
    *,
    clone: str | None = None,
    demonstrations: int | None = None,
    k: int | None = None,
    observation: Literal["local", "scan"] | None = None,
    evaluate_every: int | None = None,
    evaluation_episodes: int | None = None,
    held_out: float | None = None,
    evaluate_on: str | None = None,
    curriculum: Literal["size"] | None = None,
    without: str | None = None,
    arrivals_per_hour: float | None = None,
    stay_min: float | None = None,
    patience_min: float | None = None,
    knows: Literal["own", "shared", "reserve", "full"] | None = None,
    among: str | None = None,
    learners: float | None = None,
    test_among: str | None = None,
    test_on: str | None = None,
    agents: str | None = None,
    beside: str | None = None,
    lot: str | None = None,
    day_error: str | None = None,
    tensorboard: bool = False,
    folder: args.ReportedRun,
    machines: args.Machines,
) -> None:
    """Train agents by reinforcement learning with several seeds, and draw their learning curves beside the planners.

    The reward of search agents is minus the time in seconds. They observe the surroundings of the car, so they run on
    any lot; or raw laser scans, on one lot. In a fleet, one network drives all cars, or a share of them. Driving agents
    park the car in a slot, with hindsight experience replay (sac, tqc) or the dense reward (ppo); their curriculum
    starts just outside the slot. All are evaluated in held-out worlds; each seed's best model is kept, and tested at
    the end. Hyperparameters are in parkenv/studies/training/configs.py.

    Examples:
        parkenv train maskable-ppo --scenario campus
        parkenv train ppo --scenario my_lot.toml --steps 200000 --trainings 1
        parkenv train maskable-ppo --scenario lots --held-out 0.2 --curriculum size
        parkenv train ppo --clone mdp-tuned --test-on street,jam --out cloned
        parkenv train network --scenario my-lots --evaluate-on other-lots
        parkenv train ppo --beside results/maskable-ppo,results/dqn
        parkenv train maskable-ppo --scenario mini --observation scan --trainings 3
        parkenv train --env fleet --arrivals-per-hour 120 --trainings 3
        parkenv train sac --env drive --scenario campus,street --trainings 3
        parkenv compare --agents mdp,ppo:results/ppo/seed_0/model.safetensors

    Options:
        algorithm (ALGORITHM): To search: dqn, ppo, maskable-ppo (default), recurrent-ppo, network. In a fleet: ppo,
            maskable-ppo (default). To drive: sac, tqc,
            ppo (default).
        env (search|fleet|drive): Learn to search (parkenv/Search-v2), to search as all cars of a fleet, or to drive
            into slots (parkenv/Drive-v1).
        scenario (NAME|FILE|DIR[,...]): {scenarios}; scenario files (.toml), lots (.geojson), or folders.  [default:
            campus; to drive, campus,street; for network, made lots alone]
        steps (N >= 1): Decisions of a training; for network, those that belief labels.  [default: 2000000; in a
            fleet, 500000; for network, 10000; to drive, the training config's]
        trainings (N >= 1): How many, with one seed each from --seed on.
        seed (N >= 0): First seed of the trainings.
        out, -o (DIR): Folder for models, curves and figures.  [default: results/ALGORITHM, results/scan-ALGORITHM,
            results/drive-ALGORITHM, results/fleet-ALGORITHM]

    Learning:
        clone (AGENT): Start with behaviour cloning of this planner (search; ppo, maskable-ppo).
        demonstrations (N >= 1): Episodes of the planner to clone.  [default: 2000]
        k (N >= 1): Slots in an observation (search, fleet).  [default: 5; with --observation scan, 4 scans]
        observation (local|scan): What is observed (search; ppo, maskable-ppo). local: what is near the car, from belief
            and forecast; scan: the last laser scans and poses alone, in one scenario.  [default: local]
        curriculum (size): Begin with the smallest tenth of the places, and add larger ones evenly until half of --steps
            (search).  [default: all places from the start]
        without (PART[,...]): Parts of network to leave out: lookahead, tokens, day, memory.  [default: none]

    Many cars:
        arrivals_per_hour (X > 0): Cars that arrive in the hours of the scenario (fleet).  [default: 120]
        stay_min (0.1 <= X <= 100000): Mean of the exponentially distributed stays, minutes (fleet).  [default: 60]
        patience_min (0.1 <= X <= 100000): Minutes after which a searching car goes elsewhere (fleet).  [default: 10]
        knows (own|shared|reserve|full): What the learning cars know, as in parkenv fleet.  [default: own]
        among (AGENT): Driver of the other cars: greedy-drive, first-free, random or a model.  [default: none, every car
            learns]
        learners (0 < X < 1): Share of the cars that learn, with --among.  [default: 0.1]
        test_among (NAME[,...]|none): Test also with the model as each tenth car among these.  [default: greedy-drive]

    Evaluation:
        evaluate_every (N >= 1): Decisions between evaluations.  [default: 100000; in a fleet, a tenth of
            --steps; to drive, a twentieth]
        evaluation_episodes (N >= 2): Episodes of an evaluation, in held-out worlds; to drive, on each lot for each kind
            of slot; in a fleet, days.  [default: 256; to drive, 64; in a fleet, 8]
        held_out (0 < X < 1): Train on other places than evaluations are in: hold out this share of --scenario, by a
            hash of each lot (search).  [default: none]
        evaluate_on (NAME|FILE|DIR[,...]): Hold out these places instead (search).  [default: none]
        test_on (NAME|FILE|DIR[,...]): Scenarios to test in at the end.  [default: those of the training; with held-out
            places, all of either side together]
        agents (NAME[,...]|none): Agents that are drawn for comparison.  [default: belief, mdp-tuned, mdp, first-free,
            greedy-drive, greedy-goal; with held-out places, belief, mdp, first-free, greedy-drive; in a fleet,
            greedy-drive, first-free; to drive, planner]
        day_error (X[,Y]): How far whole days differ from the forecast, in all of these scenarios: standard deviations,
            logits, of their level and of their slope to the goal; 0 for days as forecast.  [default: the scenario's]
        beside (DIR[,...]): Folders of other trainings with the same evaluations, to draw in the same figure.

    Results:
        resume: Continue from the checkpoints in --out; the models equal those of an unbroken training.
        tensorboard: Keep logs for TensorBoard in --out.
    """
    from parkenv.studies.training.spec import TrainingSpec

    if day_error and not (scenario or lot):
        raise InputError("--day-error goes with --scenario or --lot")
    world, days = args.World(lot=lot, day_error=day_error), args.World(day_error=day_error)
    given = {
        "env": env, "algorithm": algorithm, "steps": steps, "trainings": trainings, "seed": seed,
        "scenarios": tuple(world.specs(scenario)) if scenario or lot else None,
        "evaluate_on": tuple(days.specs(evaluate_on)) if evaluate_on else None,
        "test_on": tuple(days.specs(test_on)) if test_on else None,
        "clone": clone, "demonstrations": demonstrations, "k": k, "observation": observation,
        "held_out": held_out, "curriculum": curriculum, "evaluate_every": evaluate_every,
        "evaluation_episodes": evaluation_episodes, "arrivals_per_hour": arrivals_per_hour,
        "stay_s": _seconds(stay_min), "patience_s": _seconds(patience_min), "knows": knows,
        "learners": learners, "without": args.words("--without", without) if without else None,
        "agents": _agents(agents), "test_among": _agents(test_among), "among": among,
        "beside": args.words("--beside", beside) if beside else None,
        "tensorboard": tensorboard or None, **machines.given,
    }  # fmt: skip
    spec = TrainingSpec.parse({name: value for name, value in given.items() if value is not None}, "")
    run_study(spec, out or Path("results") / spec.training.folder, folder, show)


def _seconds(minutes: float | None) -> float | None:
    return None if minutes is None else 60.0 * minutes


def _agents(text: str | None) -> list[str] | None:
    from parkenv.studies.agent_spec import split_agents

    return None if text is None else [] if text == "none" else split_agents(text)


def show(console: Console, result: Result) -> None:
    """Print the tests of the models and of the planners."""
    study: Any = result.study
    if study.training.announcement:
        console.print(study.training.announcement)
    if result.complete:
        console.print(
            make_table(*study.training.table_of(result.summary["transfer"], result.summary["planners"]))
        )
