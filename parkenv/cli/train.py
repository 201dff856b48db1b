"""`parkenv train`: train agents by reinforcement learning, and evaluate them against planners."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from parkenv import __version__
from parkenv.cli import arguments as args
from parkenv.cli.report import make_report
from parkenv.cli.single_writer import writing_into
from parkenv.cli.tables import command_line, make_console, make_table, save_summary
from parkenv.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.studies.training.curve_file import Row
    from parkenv.studies.training.spec import TrainingSpec
    from parkenv.studies.training.training import Training
    from parkenv.studies.workers import Workers


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
    from parkenv.studies.training.training import training_of

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
        "tensorboard": tensorboard or None, **machines.given,
    }  # fmt: skip
    spec = TrainingSpec.parse({name: value for name, value in given.items() if value is not None}, "")
    out = out or Path("results") / training_of(spec).folder
    with writing_into(out, "the same command with --resume"):
        run_training(spec, out, folder, args.words("--beside", beside) if beside else ())


def _seconds(minutes: float | None) -> float | None:
    return None if minutes is None else 60.0 * minutes


def _agents(text: str | None) -> list[str] | None:
    from parkenv.studies.agent_spec import split_agents

    return None if text is None else [] if text == "none" else split_agents(text)


def run_training(spec: TrainingSpec, out: Path, folder: args.ReportedRun, beside: Sequence[str] = ()) -> None:
    """Train, test and draw; see `train`.

    Raises:
        InputError: the training is impossible, or the folder cannot be used.
    """
    from parkenv.studies.results import SPEC_FILE
    from parkenv.studies.training.training import FIGURE, MODEL, Trained, curves_beside, training_of

    training = training_of(spec, tuple(command_line()))
    training.check()
    settings = {"version": __version__, **training.settings()}
    others = curves_beside(beside, out, training)
    _require_free(out, settings, folder)
    console = make_console()
    if training.announcement:
        console.print(training.announcement)
    with args.workers_of(spec) as workers:
        training.begin(console.status)
        _claim(out, settings, folder.overwrite)
        spec.write(out / SPEC_FILE)
        numbers = range(spec.seed, spec.seed + spec.trainings)
        curves = _train_all(console, training, numbers, out, workers)
        models = {n: out / f"seed_{n}" / MODEL for n in numbers}
        outcome, table = training.report(
            console.status, workers, Trained(curves, models, others), out / FIGURE
        )
    console.print(make_table(*table))
    save_summary(out, spec.seed, outcome.pop("rows"), settings=settings, **outcome)
    console.print(f"Models, curves, summary and figure are in {out}")
    if folder.report:
        make_report(out, spec)


def _require_free(out: Path, settings: Row, folder: args.ReportedRun) -> None:
    """Check that the folder holds no training, or one to resume or replace."""
    from parkenv.studies.results import read_settings, require_same_settings

    if folder.resume and folder.overwrite:
        raise InputError("--resume and --overwrite exclude each other")
    if folder.resume:
        require_same_settings(out, settings, "training")
    elif not folder.overwrite and read_settings(out) is not None:
        raise InputError(
            f"--out {out}: holds a training; add --resume to go on with it, --overwrite to replace it, or name "
            "another folder"
        )


def _claim(out: Path, settings: Row, overwrite: bool) -> None:
    """Write the settings of the new training, and remove the results of the previous one."""
    import shutil

    from parkenv.studies.results import PAGE, SUMMARY, write_settings
    from parkenv.studies.training.training import FIGURE

    # Delete the summary: a folder without one holds an unfinished training.
    for outcome in (SUMMARY, PAGE, FIGURE):
        (out / outcome).unlink(missing_ok=True)
    if overwrite:
        for folder in out.glob("seed_*"):
            shutil.rmtree(folder)
    write_settings(out, settings)


def _train_all(
    console: Console, training: Training, seeds: range, out: Path, workers: Workers
) -> list[list[Row]]:
    """Train all seeds, with one progress bar each, updated from the curves that the trainings write."""
    from functools import partial

    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from parkenv.studies.training.curve_file import CURVE, read_curve
    from parkenv.studies.training.training import train_one

    progress = Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[score]}"), TimeElapsedColumn(),
        TimeRemainingColumn(), console=console, disable=not console.is_terminal,
    )  # fmt: skip
    bars = {k: progress.add_task(f"seed {k}", total=training.steps, score="") for k in seeds}
    over = threading.Event()

    def update_bars() -> None:
        while not over.is_set():
            for k, bar in bars.items():
                # The training itself reports a damaged curve.
                with suppress(InputError):
                    if curve := read_curve(out / f"seed_{k}" / CURVE, training.columns):
                        last = curve[-1]
                        progress.update(bar, completed=last["steps"], score=training.score_text(last))
            over.wait(2.0)

    watcher = threading.Thread(target=update_bars, daemon=True)
    with progress:
        watcher.start()
        try:
            tasks = [partial(train_one, training, k, out / f"seed_{k}") for k in seeds]
            curves: dict[int, list[Row]] = {}
            for i, trained in workers.results(tasks):
                trained.save(out / f"seed_{seeds[i]}")
                curves[i] = trained.curve
        finally:
            over.set()
            watcher.join()
    return [curves[i] for i in range(len(seeds))]
