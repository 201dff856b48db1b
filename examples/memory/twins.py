"""What memory is worth, and what a map: train the twins with five seeds each, and draw curves and a table.

`python examples/memory/twins.py` trains all of them on `mini`; `--decisions`, `--seeds`, `--scenario`
and `--out` are those of the single files, `--jobs` how many train at once, `--draw` draws what is there.
"""

import argparse
import csv
import subprocess
import sys
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from parkenv.show.tables import interval_text

HERE = Path(__file__).resolve().parent
TWINS = {
    ("reactive", "belief"): "belief",
    ("reactive", "no-map"): "belief, no map",
    ("reactive", "step"): "last step alone",
    ("frame-stacking", "step"): "last step, frame stacking",
    ("gru", "step"): "last step, GRU",
    ("transformer", "step"): "last step, transformer",
    ("lru", "step"): "last step, LRU",
}
"""Titles of what is trained, by memory and observation."""
BESIDE = ("reactive", "belief")
SMOOTHED = 15
"""Updates over which curves are means."""


def train(memory, observation, options):
    """Run the file of a memory."""
    file = "belief" if memory == "reactive" else memory.replace("-", "_")
    command = [sys.executable, str(HERE / f"{file}.py"), "--observation", observation, *options]
    subprocess.run(command, check=True)


def read(folder, kind):
    """Return the rows of all files of a kind by memory and observation."""
    rows = defaultdict(list)
    for path in sorted(folder.glob(f"*.{kind}.csv")):
        with path.open(newline="") as file:
            for row in csv.DictReader(file):
                rows[row["memory"], row["observation"]].append(row)
    return rows


def table(tests):
    """Return lines of a table: means of each seed, mean of all, and the difference to the belief in the same worlds."""
    times = {}
    for key, rows in tests.items():
        seeds = sorted({row["seed"] for row in rows})
        times[key] = np.array([[float(r["total_s"]) for r in rows if r["seed"] == seed] for seed in seeds])
    lines = [
        "| observed, and remembered by | each seed, s | mean, s | minus belief, s |",
        "|---|---|---:|---:|",
    ]
    for key, title in TWINS.items():
        if key in times:
            mine = times[key]
            each = ", ".join(f"{mean:.1f}" for mean in mine.mean(axis=1))
            difference = "" if key == BESIDE else interval_text(*difference_of(mine, times[BESIDE]), "+.1f")
            lines.append(f"| {title} | {each} | {mine.mean():.1f} | {difference} |")
    return lines


def difference_of(mine, theirs):
    """Return the mean difference of times, (seeds, worlds) s in the same worlds, and the ends of its 95 % interval.

    The bootstrap draws seeds, of either side, and worlds: other trainings would differ as much as other days.
    """
    rng, means = np.random.default_rng(0), []
    for _ in range(2000):
        rows = [rng.integers(0, len(times), len(times)) for times in (mine, theirs)]
        worlds = rng.integers(0, mine.shape[1], mine.shape[1])
        means.append(mine[rows[0]][:, worlds].mean() - theirs[rows[1]][:, worlds].mean())
    return mine.mean() - theirs.mean(), np.percentile(means, [2.5, 97.5])


def write(curves, path):
    """Write the means of each seed's curve over `SMOOTHED` updates."""
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["memory", "observation", "seed", "decisions", "total_s"])
        for key in TWINS:
            for seed in sorted({row["seed"] for row in curves[key]}):
                mine = [row for row in curves[key] if row["seed"] == seed]
                for first in range(0, len(mine), SMOOTHED):
                    part = mine[first : first + SMOOTHED]
                    mean = np.average(
                        [float(r["total_s"]) for r in part], weights=[int(r["searches"]) for r in part]
                    )
                    rows.writerow([*key, seed, part[-1]["decisions"], f"{mean:.1f}"])


def draw(curves, path):
    """Draw the mean of the seeds' curves, smoothed over some updates, with their range."""
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    for ax, keys in zip(
        figure.subplots(1, 2, sharey=True),
        ([k for k in TWINS if k[0] == "reactive"], [k for k in TWINS if k == BESIDE or k[1] == "step"]),
        strict=True,
    ):
        for key in keys:
            if key not in curves:
                continue
            grid = np.unique([int(row["decisions"]) for row in curves[key]])
            seeds = sorted({row["seed"] for row in curves[key]})
            lines = []
            for seed in seeds:
                mine = [row for row in curves[key] if row["seed"] == seed]
                raw = np.interp(
                    grid, [int(r["decisions"]) for r in mine], [float(r["total_s"]) for r in mine]
                )
                padded = np.pad(raw, SMOOTHED // 2, mode="edge")
                lines.append(np.convolve(padded, np.ones(SMOOTHED) / SMOOTHED, mode="valid"))
            color = f"C{list(TWINS).index(key)}"
            grid = grid / 1e3
            ax.plot(grid, np.mean(lines, axis=0), color=color, label=TWINS[key])
            ax.fill_between(grid, np.min(lines, axis=0), np.max(lines, axis=0), color=color, alpha=0.12, lw=0)
        ax.set_xlabel("decisions, thousands")
        ax.set_ylim(30, 100)
        ax.grid(alpha=0.3)
        ax.legend(frameon=False, fontsize=9)
    figure.axes[0].set_ylabel("total time of training searches, s")
    figure.axes[0].set_title("What is observed")
    figure.axes[1].set_title("What is remembered of the last steps")
    figure.savefig(path, dpi=110)


def main():
    """Train what is wanted; write `curves.csv` and `twins.png`, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenario", default="mini")
    parser.add_argument("--decisions", default="204800")
    parser.add_argument("--seeds", default="5")
    parser.add_argument("--out", type=Path, default=Path("results/memory"))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--draw", action="store_true", help="train nothing")
    given = parser.parse_args()
    options = [f"--{name}={getattr(given, name)}" for name in ("scenario", "decisions", "seeds", "out")]
    if not given.draw:
        with ThreadPoolExecutor(given.jobs) as pool:
            list(pool.map(lambda key: train(*key, options), TWINS))
    curves = read(given.out, "curve")
    write(curves, given.out / "curves.csv")
    draw(curves, given.out / "twins.png")
    print("\n".join(table(read(given.out, "test"))))


if __name__ == "__main__":
    main()
