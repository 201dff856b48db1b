"""`parkenv publish`: a folder for the Hugging Face Hub, whose numbers its own command repeats."""

import json

import numpy as np
import pytest
import yaml
from command_line import parkenv
from PIL import Image
from sb3_contrib import MaskablePPO

from parkenv.envs.sb3 import SearchVecEnv
from planners.model_file import ModelCard, save_model


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """An untrained model."""
    path = tmp_path_factory.mktemp("model") / "mine.safetensors"
    made = MaskablePPO("MultiInputPolicy", SearchVecEnv(4, "mini"), n_steps=8, seed=0)
    save_model(made, path, scenarios=["mini"])
    return path


@pytest.mark.slow
def test_a_published_model_repeats_its_results(model, tmp_path):
    out = tmp_path / "hub"
    done = parkenv("publish", model, "--out", out, "--episodes", 3, "--jobs", 1)
    assert done.returncode == 0, done.stderr
    _, head, text = (out / "README.md").read_text(encoding="utf-8").split("---\n", 2)
    metadata = yaml.safe_load(head)
    assert metadata["pipeline_tag"] == "reinforcement-learning"
    (entry,) = metadata["model-index"]
    (found,) = entry["results"]
    assert {"task", "dataset", "metrics"} == found.keys()
    results = json.loads((out / "results.json").read_text())
    rows = {row["agent"]: row["total_s"] for row in results["rows"]}
    mine = "maskable-ppo:model.safetensors"
    assert found["metrics"][0] == {
        "type": "mean_reward", "name": "mean return, s", "value": pytest.approx(-rows[mine], abs=0.01)
    }  # fmt: skip
    assert ModelCard.of_file(out / "model.safetensors") == ModelCard.of_file(model)
    with Image.open(out / "replay.gif") as film:
        assert film.n_frames > 3
    assert all(f"({name})" in text or f"`{name}`" in text for name in ("replay.gif", "model.safetensors"))
    command = results["command"]
    assert " ".join(command) in text
    done = parkenv(*command[1:], "--jobs", 1, "--no-figures", "--out", tmp_path / "again", cwd=out)
    assert done.returncode == 0, done.stderr
    again = json.loads((tmp_path / "again" / "summary.json").read_text())["rows"]
    assert {row["agent"]: row["total_s"] for row in again} == rows
    assert np.isfinite(list(rows.values())).all()


def test_what_cannot_be_published_is_refused(model, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    (tmp_path / "empty").mkdir()
    unknown = tmp_path / "unknown.safetensors"
    save_model(MaskablePPO("MultiInputPolicy", SearchVecEnv(2, "mini"), n_steps=8), unknown, scenarios=["x"])
    for arguments, wanted in (
        ((model, "--out", tmp_path / "full"), "full: exists; name a new folder"),
        ((tmp_path / "empty", "--out", tmp_path / "o"), "holds no summary.json"),
        ((unknown, "--out", tmp_path / "o"), "was trained on x, which is not packaged; add --scenario"),
    ):
        done = parkenv("publish", *arguments)
        assert (done.returncode, wanted in " ".join(done.stderr.split())) == (2, True), done.stderr
    assert not (tmp_path / "o").exists()
