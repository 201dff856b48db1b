"""A training that is killed and resumed ends with the same evaluations and the same model, to the byte."""

import pytest
from small_trainings import make_small, search_training, stop_training

from parkenv import InputError, make_scenario
from parkenv.lots import grid_lot
from parkenv.studies.runner import run
from parkenv.studies.training.configs import SEARCH_CONFIGS
from parkenv.studies.training.spec import TrainingSpec
from parkenv.studies.training.training import episode_times
from planners.model_file import LearnedAgent

PLACES = [make_scenario("mini"), make_scenario("campus")]
LOTS = [make_scenario(grid_lot(2, 6 + i), name=f"lot{i}") for i in range(6)]
TRAININGS = {
    **{name: lambda name=name: search_training(name, 1_500, 400, PLACES) for name in sorted(SEARCH_CONFIGS)},
    "curriculum": lambda: search_training("ppo", 1_536, 512, LOTS, episodes=8, curriculum="size"),
}


@pytest.fixture(autouse=True)
def small(monkeypatch):
    make_small(monkeypatch)


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind != "maskable-ppo")) for kind in TRAININGS]
)
def test_a_resumed_training_equals_an_unbroken_one(kind, tmp_path, monkeypatch):
    """Killed right before its third checkpoint: the evaluation before it is repeated."""
    training = TRAININGS[kind]()
    stop_training(training, tmp_path / "resumed", monkeypatch)
    assert (tmp_path / "resumed" / "checkpoint.pt").exists()
    resumed, whole = (training.train(0, tmp_path / name) for name in ("resumed", "whole"))
    assert len(whole) >= 4
    assert repr([row | {"wall_s": 0.0} for row in resumed]) == repr([row | {"wall_s": 0.0} for row in whole])
    files = [tmp_path / name / "model.safetensors" for name in ("resumed", "whole")]
    assert files[0].read_bytes() == files[1].read_bytes()
    names = {"checkpoint.pt", "curve.csv", "model.safetensors"}
    assert {path.name for path in (tmp_path / "resumed").iterdir()} == names
    again = training.train(0, tmp_path / "resumed")
    assert repr(again) == repr(resumed), "a finished training is not repeated"
    if kind in SEARCH_CONFIGS:
        assert [row["steps"] for row in whole][:3] == [0, 512, 1024] if kind != "dqn" else len(whole) == 5
        seeds = training.evaluation_seeds
        times, _ = episode_times(LearnedAgent(PLACES[0], kind, files[0]).model, PLACES, seeds)
        assert times.mean() == min(row["total_s"] for row in whole)


def test_a_finished_training_goes_on_with_more_steps(tmp_path):
    its = {"algorithm": "ppo", "scenarios": ["mini"], "trainings": 1, "agents": [], "evaluation_episodes": 4}
    short, long = (TrainingSpec.parse({**its, "steps": steps, "jobs": 1}, "") for steps in (600, 1_300))
    before = run(short, tmp_path).summary["curve"]
    after = run(long, tmp_path, resume=True).summary["curve"]
    assert after[: len(before)] == before, "it goes on where it was"
    assert after[-1]["steps"] >= 1_300 > before[-1]["steps"]
    (tmp_path / "seed_0" / "checkpoint.pt").unlink()
    assert run(short, tmp_path, resume=True).summary["curve"] == after, "no more than asked is nothing to do"
    with pytest.raises(InputError, match="cannot go on"):
        run(long.changed(steps=2_000), tmp_path, resume=True)
