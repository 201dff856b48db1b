"""Train other people's learners, unmodified, each in a clean environment of its own, and print a table.

`python examples/other_learners/run.py` trains all of them on campus; `run.py rl-zoo3 torchrl --scenario mini
--decisions 20480` some of them elsewhere. Then each searches in the same worlds, which had no say, as `first-free`.
Environments are kept in `--folder`, and made anew with `--fresh`. PPO of CleanRL is one file: it is fetched from its
repository, or `--cleanrl` names it. The exit code is the number of learners that failed.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from urllib.request import urlretrieve

import numpy as np
from held_out import WORLDS, make

import parkenv
from parkenv.show.tables import interval_text
from parkenv.studies.statistics import mean_interval

HERE = Path(__file__).resolve().parent
PROJECT = HERE.parents[1]
CLEANRL = "https://raw.githubusercontent.com/vwxyzjn/cleanrl/master/cleanrl/ppo.py"
PACKAGES = {
    "rl-zoo3": ["rl_zoo3"],
    "cleanrl": ["tyro", "tensorboard"],
    "torchrl": ["torchrl"],
    "rllib": ["ray[rllib]"],
    "tianshou": ["tianshou"],
}
"""What each learner needs beside parkenv and PyTorch."""


def make_environment(name, folder, fresh):
    """Make a virtual environment with this project and a learner, and return its Python."""
    python = folder / name / "bin" / "python"
    if fresh or not python.exists():
        subprocess.run([sys.executable, "-m", "venv", "--clear", str(folder / name)], check=True)
        for packages in (["torch<=2.13.0"], [f"{PROJECT}[rl]"], PACKAGES[name]):
            subprocess.run([str(python), "-m", "pip", "install", "-q", *packages], check=True)
    return python


def train(name, python, folder, scenario, decisions, *files):
    """Train a learner with one thread, and return what `held_out.tell` says of it, and the seconds that it took."""
    begun = time.perf_counter()
    script = HERE / f"with_{name.replace('-', '_')}.py"
    done = subprocess.run(
        [str(part) for part in (python, script, scenario, decisions, *files)],
        cwd=folder,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        text=True,
        capture_output=True,
        check=False,
    )
    (folder / f"{name}.log").write_text(done.stdout + done.stderr)
    if done.returncode:
        raise RuntimeError((done.stderr.strip().splitlines() or ["no message"])[-1])
    told = [line for line in done.stdout.splitlines() if line.startswith('{"library"')]
    return json.loads(told[-1]) | {"seconds": time.perf_counter() - begun}


def first_free(scenario):
    """Return the total times, s, of `first-free` in the same worlds."""
    env, agent = (
        make(scenario, observation="full", flat=False),
        parkenv.make_agent("first-free", parkenv.make_scenario(scenario)),
    )
    return np.array([parkenv.simulate(env, agent, seed=seed).info["total_s"] for seed in WORLDS])


def table(rows, beside):
    """Return the lines of a table of what the learners have learned."""
    yield f"{len(WORLDS)} searches; first-free: {interval_text(*parted(beside), '.1f')} s"
    yield "| learner | version | decisions | s | processor s | mean total, s | minus first-free, s |"
    yield "|---|---|---:|---:|---:|---|---|"
    for row in rows:
        totals = np.array(row["totals"])
        yield (
            f"| {row['library']} | {row['version']} | {row['decisions']:,} | {row['seconds']:.0f} | "
            f"{row['cpu_s']:.0f} | {interval_text(*parted(totals), '.1f')} | "
            f"{interval_text(*parted(totals - beside), '+.1f')} |"
        )


def parted(sample):
    """Return the mean of a sample and the ends of its interval."""
    mean, *ends = mean_interval(sample)
    return mean, ends


def main():
    """Read the command line, train, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "names", nargs="*", choices=[*PACKAGES, []], help="learners; all of them if none is named"
    )
    parser.add_argument("--scenario", default="campus", help="a packaged car park")
    parser.add_argument("--decisions", type=int, default=150_000)
    parser.add_argument(
        "--folder", type=Path, default=Path("learners"), help="of the environments and outputs"
    )
    parser.add_argument("--fresh", action="store_true", help="make the environments anew")
    parser.add_argument("--cleanrl", type=Path, help="CleanRL's ppo.py; fetched if not given")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    folder, rows, failed = given.folder.resolve(), [], 0
    for name in given.names or PACKAGES:
        files = []
        try:
            python = make_environment(name, folder, given.fresh)
            if name == "cleanrl":
                files = [given.cleanrl.resolve() if given.cleanrl else folder / "ppo.py"]
                if not files[0].exists():
                    urlretrieve(CLEANRL, files[0])
            rows.append(train(name, python, folder, given.scenario, given.decisions, *files))
            print(f"{name}: {rows[-1]['seconds']:.0f} s", flush=True)
        except (OSError, RuntimeError, subprocess.CalledProcessError) as error:
            failed += 1
            print(f"{name} failed: {error}", flush=True)
    print("\n".join(table(rows, first_free(given.scenario))))
    sys.exit(failed)


if __name__ == "__main__":
    main()
