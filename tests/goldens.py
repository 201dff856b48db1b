"""Goldens: small runs whose results must stay as they are, to the last digit.

    python tests/goldens.py check             run all, compare with goldens.json, list what differs
    python tests/goldens.py check fleet osm   only those
    python tests/goldens.py record fleet      run, and write what came out into goldens.json

Each golden is kept with the command that made it: `summary.json` without its timings, and a SHA-256 of each table,
picture and lot. A change of results on purpose is recorded in a commit of its own that says why.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import hashlib
import io
import json
import os
import re
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

from car_park_counts import write_counts

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared" / "data"
GOLDENS = Path(__file__).with_name("goldens.json")

AGENTS = "mdp,belief,mdp-tuned,network,greedy-goal,greedy-drive,first-free,oracle,bound"
CASES: dict[str, tuple[str, ...]] = {
    "compare": (
        f"compare --scenario mini,street --agents {AGENTS} --failure-cost 10,90 -n 4 --seed 7 --out out",
    ),
    "compare-sensors": (
        "compare --scenario mini --agents mdp,belief --rig laser --detector hog -n 1 --seed 3 --out out",
    ),
    "plan": ("plan --scenario jam --failure-cost 10,90 --out out",),
    "fleet": (
        "fleet --scenario mini --agents belief,greedy-drive --knows own,shared --share 1 --arrivals-per-hour 15 "
        "--hours 08:00-09:00 -n 1 --seed 3 --out out",
    ),
    "town": (
        "fleet --scenario town --agents greedy-drive --price centre=+1/h --hours 08:00-08:20 -n 1 --seed 3 --out out",
    ),
    "commute": ("commute --scenario mini --map empty,wrong --days 2 --drivers 2 --out out",),
    "curve": ("curve mini --agents greedy-drive --arrivals-per-hour 10,30 --bootstraps 2 -n 2 --out out",),
    "demand": (
        "occupancy demand counts.csv --scenario town --from 2024-01-01 --weeks 1 --held-out 1 --roll-outs 2 --rounds 1 "
        "-n 1 --out out",
    ),
    "survey": (
        "survey --scenario mini --sessions 1 --weather sunny --every 3 --rig laser --record drive.mcap --out out",
        "map-drive drive.mcap --scenario mini --out mapped",
    ),
    "survey-net": ("survey --scenario mini --sessions 2 --every 8 --rig stereo --detector net --out out",),
    "sensor-model": ("fit-sensor-model --scenario mini -n 2 --out out/model.json",),
    "trip": ("calibrate --scenario mini -n 1 --seed 0 --out out",),
    "park": (
        "park --scenario mini -n 1 --out out",
        "park --levels parallel-extreme,oblique-normal -n 1 --out levels",
    ),
    "park-cases": (
        "park --cases {data}/manoeuvres/tpcap --vehicle tpcap --out tpcap",
        "park --cases {data}/manoeuvres/parkbench/1712307156373336040.json --out parkbench",
    ),
    "train": ("train ppo --scenario mini --steps 512 --trainings 1 --evaluation-episodes 4 --out out",),
    "suite": ("benchmark run v3 --agents first-free --out out",),
    "demo": ("demo --scenario mini --quick --more 2 --every 8 --out out",),
    "occupancy": (
        "occupancy evaluate {data}/cnr_ext/occupancy_15_days.csv.gz --from 2015-11-25 --out slots",
        "occupancy fit {data}/cnr_ext/occupancy_15_days.csv.gz --out fit",
        "occupancy evaluate counts.csv --from 2024-02-01 --out counts",
    ),
    "detector": ("evaluate-detector --crops crops --model front --out out",),
    "lots": (
        "lot import {data}/osm_nl/zuid-holland_0110_53.geojson --entry auto --goal auto --out a.geojson "
        "--picture a.png",
        "lot import {data}/osm_nl/zuid-holland_0101_285.geojson --entry auto --goal auto --out b.geojson",
        "lot convert {data}/dlp/parking_map.yml --out c.geojson",
        "lot show campus --out campus.png",
    ),
    "towns": (
        "lot import {data}/towns/osm/helsinki_centre_20190421.osm.pbf --town --out helsinki.geojson",
        "lot import {data}/towns/osm/neukoelln_patch_20240328.osm.gz --town --out neukoelln.geojson",
        "lot import {data}/towns/osm/lauf_20200115.osm.pbf --town --out lauf.geojson --picture lauf.png",
        "lot import {data}/towns/osm/dortmund_centre.osm.gz --town --out dortmund.geojson",
    ),
}  # fmt: skip
"""Commands of each golden, in a folder of their own with `counts.csv` and `crops`; `{data}` is that of real data."""

VOLATILE = re.compile(
    r"^(decision_ms.*|seconds.*|.*_seconds|compile.*|.*planning_m?s.*|wall_s|steps_per_s|command|version|date|"
    r"commit|findings|most_balked|settings)$"
)
"""Members of summaries and columns that differ from run to run, are texts, or repeat the specification."""
COMPARED = {".csv", ".gz", ".geojson", ".png", ".gif", ".jsonl", ".json"}
LONG = 20_000
"""Characters of a summary from which on hashes of its tables are kept."""
LEFT_OUT = {"timings.csv", "settings.json", "experiment.json", "counts.csv", "report.json", "result.json"}


def run(name: str, folder: Path) -> dict[str, Any]:
    """Run the commands of a golden in an empty folder; return the summaries and hashes of what they wrote."""
    _write_inputs(folder)
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "COLUMNS": "100"}
    for words in CASES[name]:
        command = [sys.executable, "-m", "parkenv", *words.format(data=DATA).split()]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"{words}\n{done.stderr[-2000:]}")
    results: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        key = path.relative_to(folder).as_posix()
        if path.suffix not in COMPARED or path.name in LEFT_OUT or key.startswith("crops/"):
            continue
        if path.name == "summary.json":
            summary = _lasting(json.loads(path.read_text()))
            if len(json.dumps(summary)) > LONG:
                summary = {part: _hash(json.dumps(its).encode()) for part, its in summary.items()}
            results[key] = summary
        else:
            content = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
            content = content.replace(str(ROOT).encode(), b"")
            columns = content.split(b"\n")[0].decode(errors="replace").strip().split(",")
            if path.suffix == ".csv" and any(map(VOLATILE.match, columns)):
                rows = [_lasting(row) for row in csv.DictReader(io.StringIO(content.decode()))]
                content = json.dumps(rows).encode()
            results[key] = _hash(content)
    return results


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _lasting(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _lasting(part) for key, part in value.items() if not VOLATILE.match(key)}
    return [_lasting(part) for part in value] if isinstance(value, list) else value


def _write_inputs(folder: Path) -> None:
    counts = write_counts(folder / "counts.csv")
    garages = {"P0": "Market garage", "P1": "Theatre garage", "empty": "Station car park"}
    text = counts.read_text()
    for park, garage in garages.items():
        text = re.sub(rf"^{park},", f"{garage},", text, flags=re.M)
    counts.write_text(text)
    for archive in DATA.glob("kitti_crops/*.zip"):
        with zipfile.ZipFile(archive) as crops:
            crops.extractall(folder / "crops")


def main() -> int:
    """Check or record; return the number of goldens that differ."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("action", choices=("check", "record"))
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(CASES))
    arguments = parser.parse_args()
    goldens = json.loads(GOLDENS.read_text()) if GOLDENS.exists() else {}
    different = 0
    for name in arguments.names or CASES:
        with tempfile.TemporaryDirectory() as folder:
            results = run(name, Path(folder))
        if arguments.action == "record":
            goldens[name] = {"commands": CASES[name], "results": results}
            kept = {case: goldens[case] for case in CASES if case in goldens}
            cases = ",\n".join(f"{json.dumps(case)}: {json.dumps(its)}" for case, its in kept.items())
            GOLDENS.write_text(f"{{\n{cases}\n}}\n")
            print(f"{name}: recorded", flush=True)
            continue
        wanted = goldens[name]["results"]
        changed = sorted(key for key in wanted | results if wanted.get(key) != results.get(key))
        different += bool(changed)
        print(f"{name}: {'equal' if not changed else 'DIFFERENT: ' + ', '.join(changed)}", flush=True)
    return different


if __name__ == "__main__":
    sys.exit(main())
