"""Data sets of recorded searches: what Minari reads is what the environment does, also after an interruption."""

import json
import shutil

import numpy as np
import pytest
from command_line import parkenv

from parkenv.engine.policy_batch import explore
from parkenv.scenarios.build import make_scenario
from parkenv.scenarios.spec import scenario_spec
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.cases import Case
from parkenv.studies.dataset.recording import SearchRecorder
from parkenv.studies.dataset.study import DatasetStudy
from parkenv.studies.runner import run

minari = pytest.importorskip("minari", reason="the extra offline is not installed")
pytest.importorskip("h5py", reason="the extra offline is not installed")

STUDY = DatasetStudy(
    scenario=scenario_spec("mini"),
    policies=tuple(AgentSpec(name=name) for name in ("random", "greedy-total", "mixed")),
    steps=600,
    epsilon=0.25,
    jobs=1,
)


DATA = "parkenv/mini/greedy-goal-v0/data/main_data.hdf5"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A finished run."""
    return run(STUDY, tmp_path_factory.mktemp("recorded"))


def episodes(folder, name, monkeypatch):
    """All episodes of a data set as Minari loads them, with their metadata."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    dataset = minari.load_dataset(f"parkenv/{name}-v0")
    about = dataset.storage.get_episode_metadata(range(dataset.total_episodes))
    return dataset, list(zip(dataset.iterate_episodes(), about, strict=True))


@pytest.mark.parametrize("name", ["random", "greedy-total", "mixed"])
def test_the_environment_of_a_data_set_repeats_its_episodes(recorded, name, monkeypatch):
    dataset, found = episodes(recorded.folder, f"mini/{name}", monkeypatch)
    rows = [row for row in recorded.results.rows(STUDY.table).values() if row["policy"] == name]
    (summary,) = (row for row in recorded.rows if row["policy"] == name)
    assert dataset.total_steps == summary["steps"] == sum(len(episode) for episode, _ in found) >= 600
    assert dataset.total_steps - len(found[-1][0]) < 600, "no more searches than are needed"
    env = dataset.recover_environment()
    assert dataset.observation_space == env.observation_space
    for (episode, about), row in zip(found, rows, strict=False):
        assert (about["seed"], about["agent"]) == (row["seed"], row["agent"])
        if about["id"] % 7:
            continue
        observation, _ = env.reset(seed=about["seed"])
        for t, action in enumerate(episode.actions):
            for key, value in observation.items():
                np.testing.assert_array_equal(value, episode.observations[key][t])
            probabilities = episode.infos["action_probabilities"][t]
            assert probabilities.sum() == pytest.approx(1.0)
            assert probabilities[action] > 0.0
            if row["agent"] == "random":
                np.testing.assert_allclose(
                    probabilities, observation["action_mask"] / observation["action_mask"].sum()
                )
            else:
                assert probabilities.max() >= 0.75
            observation, *outcome, info = env.step(action)
            assert outcome == [episode.rewards[t], episode.terminations[t], episode.truncations[t]]
        assert row["parked"] == info["parked"]
        assert row["total_s"] == pytest.approx(-episode.rewards.sum())
    assert {a["agent"] for _, a in found} == ({"random", "greedy-total"} if name == "mixed" else {name})


def test_compiled_cars_search_as_the_agents_in_python():
    scenario = make_scenario("mini")
    for name in ("greedy-drive", "first-free", "usual", "random"):
        recorder = SearchRecorder(scenario, AgentSpec(name=name), "local", 0.4)
        fast, slow = (list(recorder.searches(range(12), compiled=compiled)) for compiled in (True, False))
        for one, other in zip(fast, slow, strict=True):
            assert (one.seed, one.parked, one.arrays.keys()) == (
                other.seed,
                other.parked,
                other.arrays.keys(),
            )
            for name, values in one.arrays.items():
                np.testing.assert_array_equal(values, other.arrays[name], strict=True)


def test_without_random_actions_agents_search_as_in_a_comparison():
    scenario = make_scenario("mini")
    for name in ("greedy-goal", "mdp"):
        recorder = SearchRecorder(scenario, AgentSpec(name=name), "full", 0.0)
        compared = [row["total_s"] for row in Case(scenario, name).run(range(5))]
        assert [-one.arrays["rewards"].sum() for one in recorder.searches(range(5))] == pytest.approx(
            compared
        )


def test_random_actions_have_the_probabilities_that_are_recorded():
    masks, drawn, n = np.array([1, 0, 1, 0, 1], np.int8), np.zeros(5), 20_000
    expected = np.empty(5)
    for step in range(n):
        drawn[explore(np.uint64(7), step, masks, 4, 0.3, expected)] += 1.0 / n
    np.testing.assert_allclose(expected, [0.1, 0.0, 0.1, 0.0, 0.8])
    assert (np.abs(drawn - expected) <= 4 * np.sqrt(expected * (1 - expected) / n)).all()


def test_a_run_that_goes_on_gives_the_data_set_of_an_unbroken_one(recorded, tmp_path, monkeypatch):
    short = STUDY.changed(steps=100, policies=(AgentSpec(name="greedy-total"),))
    folder = run(short, tmp_path / "grown").folder
    # A crash before the data set is written, and after: both go on.
    shutil.rmtree(folder / ".parts")
    (folder / ".minari-killed").mkdir()
    run(short.changed(steps=600), folder, resume=True)
    _, grown = episodes(folder, "mini/greedy-total", monkeypatch)
    _, once = episodes(recorded.folder, "mini/greedy-total", monkeypatch)
    assert len(grown) == len(once)
    for (one, about), (other, its) in zip(grown, once, strict=True):
        assert about == its
        for part in ("actions", "rewards", "terminations", "truncations"):
            np.testing.assert_array_equal(getattr(one, part), getattr(other, part))
        np.testing.assert_array_equal(one.observations["local"], other.observations["local"])
    assert not list(folder.rglob(".minari-*"))


def test_what_was_recorded_and_lost_is_recorded_again(tmp_path, monkeypatch):
    study = STUDY.changed(policies=(AgentSpec(name="greedy-goal"),))
    folder = run(study, tmp_path / "lost").folder
    _, before = episodes(folder, "mini/greedy-goal", monkeypatch)
    content = (folder / DATA).read_bytes()
    shutil.rmtree(folder / ".parts")
    shutil.rmtree(folder / "parkenv")
    run(study, folder, resume=True)
    _, after = episodes(folder, "mini/greedy-goal", monkeypatch)
    assert (folder / DATA).read_bytes() == content
    assert [a["seed"] for _, a in after] == [a["seed"] for _, a in before]
    np.testing.assert_array_equal(after[-1][0].rewards, before[-1][0].rewards)


def test_the_command_records_a_scenario_file(tmp_path, monkeypatch):
    out = tmp_path / "out"
    (tmp_path / "dear.toml").write_text('lot = "mini"\n[costs]\nfailure_s = 77.0\n')
    given = ("--policy", "greedy,mdp(failure_s=5)", "--steps", 30, "--jobs", 1, "--out", "out")
    done = parkenv("dataset", "dear.toml", *given, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "MINARI_DATASETS_PATH=out minari show parkenv/dear/greedy-total-v0" in done.stdout
    (tmp_path / "dear.toml").unlink()
    dataset, found = episodes(out, "dear/mdp-failure_s-5", monkeypatch)
    assert dataset.recover_environment().unwrapped.scenario.failure_s == 77.0
    about = dataset.storage.metadata["parkenv"]
    assert about["command"].startswith("parkenv dataset")
    assert (about["policy"], about["seed"], found[0][1]["seed"]) == ("mdp(failure_s=5)", 0, 0)
    assert set(minari.list_local_datasets()) == {
        row["dataset"] for row in json.loads((out / "summary.json").read_text())["rows"]
    }


@pytest.mark.parametrize(
    ("given", "names"),
    [
        (("nowhere",), ("SCENARIO", "nowhere")),
        (("mini", "--scenario", "jam"), ("SCENARIO", "--scenario")),
        (("mini", "--policy", "greedy-toal"), ("greedy-toal", "greedy-total")),
        (("mini", "--policy", "mixed(share=2)"), ("mixed",)),
        (("mini", "--policy", "mdp,mdp"), ("mdp",)),
        (("mini", "--epsilon", "1.5"), ("--epsilon", "1.5")),
        (("mini", "--steps", "0"), ("--steps",)),
        (("mini", "--observation", "scan"), ("--observation", "scan")),
    ],
)
def test_bad_input_is_refused_in_a_line(given, names, tmp_path):
    done = parkenv("dataset", *given, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert all(name in done.stderr for name in names), done.stderr
    assert not (tmp_path / "out").exists()
