"""Measure parts of parkenv, beside other software for the same task where it is installed.

    python benchmarks/run.py sensors
    python benchmarks/run.py --seconds 2 --out results/bench
    python benchmarks/run.py pomdp --episodes 20 --budget-ms 10 100 1000

A ratio above 1 means that parkenv is faster. Timings are noisy: compare ratios, on an idle machine. After an
installation each part first compiles what it measures, about 20 s. `pip install -e ".[bench]"` installs most peers;
SUMO (eclipse-sumo) and OpenCV 4 (see perception.py) are extra. --out holds summary.json, whose rows have the keys part,
case, value, unit, peer, peer_value and ratio.

The part pomdp compares planners of parkenv and pomdp-py at several times for a decision in the same worlds, takes
hours, and goes on where it was stopped. Its rows have the keys scenario, planner, budget_ms, episodes, total_s,
total_s_ci95 and decision_ms; OUT/pomdp is the comparison that they are from.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from importlib import import_module
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # a script has its own folder there only

from parkenv.studies.results import write_summary
from parkenv.version import __version__

PARTS = ("sensors", "perception", "planning", "env", "drive", "fleet", "town")
IN_TIME = "pomdp"


def main(words: list[str] | None = None) -> None:
    """Measure the parts that the command line names."""
    options = arguments().parse_args(words)
    chosen = options.parts or list(PARTS)
    if options.out is None and IN_TIME in chosen:
        options.out = Path("results/bench")
    rows = []
    for part in chosen:
        print(f"Measuring {part}", file=sys.stderr, flush=True)
        module = import_module(f"benchmarks.{part}")
        if part == IN_TIME:
            measured = module.pomdp_rows(
                options.out / IN_TIME, options.seed, options.episodes, options.budget_ms
            )
        else:
            further = {"lots": options.lot} if part == "town" else {}
            measured = getattr(module, f"{part}_rows")(options.seed, options.seconds, **further)
        for row in measured:
            print("  ".join(f"{key} {shown(value)}" for key, value in row.items() if value is not None))
        rows += measured
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        command = shlex.join(["python", *sys.argv])
        write_summary(
            options.out,
            {"command": command, "version": __version__, "seed": options.seed, "rows": rows},
        )


def arguments() -> argparse.ArgumentParser:
    """Return the options of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "parts", nargs="*", metavar="PART", choices=[*PARTS, IN_TIME],
        help=f"{', '.join(PARTS)} (these are the default) or {IN_TIME}",
    )  # fmt: skip
    parser.add_argument("--seconds", type=float, default=0.6, help="how long each figure is measured")
    parser.add_argument("--seed", type=int, default=0, help="seed of lots, worlds and noise")
    parser.add_argument(
        "--lot", action="append", default=[], metavar="FILE",
        help="a lot whose day the part town compares with SUMO's, besides a made one; may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "-n", "--episodes", type=int, default=20, help="pomdp: searches of each planner in each scenario"
    )
    parser.add_argument(
        "--budget-ms", type=float, nargs="+", default=[10.0, 100.0, 1000.0], metavar="MS",
        help="pomdp: times for a decision",
    )  # fmt: skip
    parser.add_argument("-o", "--out", type=Path, help="folder for summary.json")
    return parser


def shown(value: object) -> str:
    """Format a number with three significant digits and thousands separators."""
    if not isinstance(value, float):
        return str(value)
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


if __name__ == "__main__":
    main()
