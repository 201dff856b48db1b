"""Train other people's learners, unmodified, each in a clean environment of its own, and print a line for each.

`python examples/other_learners/run.py` trains all of them on campus; `run.py rl-zoo3 torchrl --scenario mini
--decisions 20480` some of them elsewhere. Environments are kept in `--folder`, and made anew with `--fresh`. PPO of
CleanRL is one file: it is fetched from its repository, or `--cleanrl` names it.
"""

import argparse
import os
import re
import statistics
import subprocess
import sys
import time
from pathlib import Path
from urllib.request import urlretrieve

HERE = Path(__file__).resolve().parent
PROJECT = HERE.parents[1]
CLEANRL = "https://raw.githubusercontent.com/vwxyzjn/cleanrl/master/cleanrl/ppo.py"
PACKAGES = {
    "rl-zoo3": ["rl_zoo3"],
    "cleanrl": ["tyro", "tensorboard"],
    "torchrl": ["torchrl"],
}
"""What each learner needs beside parkenv and PyTorch."""


def make_environment(name, folder, fresh):
    """Make a virtual environment with this project and a learner, and return its folder of commands."""
    commands = folder / name / "bin"
    if fresh or not (commands / "parkenv").exists():
        subprocess.run([sys.executable, "-m", "venv", "--clear", str(folder / name)], check=True)
        for packages in (["torch<=2.13.0"], [f"{PROJECT}[rl]"], PACKAGES[name]):
            subprocess.run([str(commands / "pip"), "install", "-q", *packages], check=True)
    return commands


def run(*command, folder, **variables):
    """Run a command with one thread in a folder and return what it prints."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"} | variables
    done = subprocess.run(
        [str(part) for part in command],
        cwd=folder,
        env=environment,
        text=True,
        capture_output=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(done.stderr.strip().splitlines()[-1] if done.stderr.strip() else "no message")
    return done.stdout


def train_with_zoo(commands, folder, scenario, decisions):
    """Train with rl-zoo3 and compare its best model in worlds that had no say."""
    options = [f"scenario:'{scenario}'", "observation:'local'", "reward_scale:0.01", "max_episode_steps:500"]
    run(
        commands / "python", "-m", "rl_zoo3.train", "--algo", "ppo", "--env", "parkenv/Search-v2",
        "--gym-packages", "parkenv", "--conf-file", HERE / "ppo.yml", "--env-kwargs", *options, "-n", decisions,
        "--eval-freq", max(decisions // 10, 1), "--eval-episodes", "100", "--n-eval-envs", "10", "--seed", "0",
        "--num-threads", "1", "--device", "cpu", "-f", "zoo", folder=folder,
    )  # fmt: skip
    newest = max(folder.glob("zoo/ppo/*/best_model.zip"), key=lambda path: path.stat().st_mtime)
    newest.with_suffix(".safetensors").unlink(missing_ok=True)
    said = run(
        commands / "parkenv", "compare", "--scenario", scenario, "--agents", f"first-free,ppo:{newest}",
        "--trust-model", "--episodes", "500", "--seed", "1000000", "--out", "compared", "--overwrite",
        folder=folder, COLUMNS="200",
    )  # fmt: skip
    return next(line.strip() for line in said.splitlines() if "ppo" in line and "[" in line)


def train_with_cleanrl(commands, folder, scenario, decisions, file):
    """Train with CleanRL's file, and return the mean of the last episodes."""
    log = folder / "episodes.txt"
    log.unlink(missing_ok=True)
    run(
        commands / "python", file, "--env-id", f"logged_ids:logged/{scenario}-v2", "--total-timesteps", decisions,
        "--num-envs", "32", "--num-steps", "64", "--gamma", "0.999", "--learning-rate", "1e-3", "--no-cuda",
        folder=folder, EPISODES=str(log), PYTHONPATH=str(HERE),
    )  # fmt: skip
    totals = [float(line) for line in log.read_text().split()]
    first, last = statistics.mean(totals[:200]), statistics.mean(totals[-200:])
    return f"{last:.1f} s (mean of the last 200 training episodes; the first 200: {first:.1f} s)"


def main():
    """Read the command line, train, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "names", nargs="*", choices=[*PACKAGES, []], help="learners; all of them if none is named"
    )
    parser.add_argument("--scenario", default="campus", help="a packaged car park")
    parser.add_argument("--decisions", type=int, default=300_000)
    parser.add_argument(
        "--folder", type=Path, default=Path("learners"), help="of the environments and results"
    )
    parser.add_argument("--fresh", action="store_true", help="make the environments anew")
    parser.add_argument("--cleanrl", type=Path, help="CleanRL's ppo.py; fetched if not given")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    folder, wrong = given.folder.resolve(), 0
    for name in given.names or PACKAGES:
        try:
            commands = make_environment(name, folder, given.fresh)
            begun = time.perf_counter()
            settings = commands, folder, given.scenario, given.decisions
            if name == "rl-zoo3":
                result = train_with_zoo(*settings)
            elif name == "cleanrl":
                file = given.cleanrl.resolve() if given.cleanrl else folder / "ppo.py"
                if not file.exists():
                    urlretrieve(CLEANRL, file)
                result = train_with_cleanrl(*settings, file)
            else:
                said = run(
                    commands / "python",
                    HERE / f"with_{name}.py",
                    given.scenario,
                    given.decisions,
                    folder=folder,
                )
                result = re.findall(r".* decisions .* s", said)[-1].strip()
            print(f"{name:9} {time.perf_counter() - begun:5.0f} s  {result}", flush=True)
        except (OSError, RuntimeError, subprocess.CalledProcessError) as error:
            wrong += 1
            print(f"{name:9}          failed: {error}", flush=True)
    sys.exit(wrong)


if __name__ == "__main__":
    main()
