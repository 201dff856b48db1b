"""Bad input for towns: one line that names file, field, value and what was wanted; exit code 2, nothing written."""

import bz2
import gzip
import random
import struct
import zlib

import pytest
from car_park_counts import write_counts
from command_line import refused
from lot_checks import refusal
from made_maps import STREET, grid

from parkenv import make_scenario
from parkenv.lots.osm import elements
from parkenv.lots.town.draft import import_town
from parkenv.scenarios.spec import ScenarioSpec

# ---- scenarios ----

DEMAND = {
    "negative arrivals": ({"arrivals_per_hour": -3}, "arrivals_per_hour.0 is -3"),
    "no number": ({"arrivals_per_hour": [1.0] * 23 + [float("nan")]}, "arrivals_per_hour.23 is nan"),
    "too few hours": ({"arrivals_per_hour": [1.0] * 23}, "demand.x.arrivals_per_hour"),
    "an unknown key": ({"arrivals": 3}, "unknown key 'arrivals'"),
    "a class that no zone names": ({"classes": {"vip": 0.5}}, "demand.x.classes has 'vip'"),
    "a class of everybody": ({"classes": {"public": 0.5}}, "demand.x.classes has 'public'"),
    "more than all of a class": ({"classes": {"permit-a": 1.5}}, "demand.x.classes.permit-a"),
    "an unknown law": ({"stay_law": "weibull"}, "demand.x.stay_law"),
    "more parked than spaces": ({"parked": 11}, "demand.x.parked is 11"),
    "fewer parked than none": ({"parked": -3}, "demand.x.parked"),
    "goals that the lot has not": ({"goals": [1.0, 2.0]}, "demand.x.goals has 2 numbers, the lot has 1"),
    "a goal without number": ({"goals": [float("nan")]}, "demand.x.goals.0 is nan"),
    "an endless stay": ({"stay_s": float("inf")}, "stay_s is inf"),
}
COSTS = [
    *(
        ({"prices": {"a*": price}}, "costs.prices.a*")
        for price in ("+x", "+nan", "+inf", "1 @ late", "+-1", "-1/h", True, -1.0)
    ),
    ({"prices": {"othr": 1.0}}, "no zone 'othr'; did you mean 'other'"),
    ({"prices": {"other": -1.0}}, "costs.prices.other is -1.0, want a number from 0"),
    ({"value_of_time": 0.0}, "costs.value_of_time is 0.0, want a number above 0"),
]


@pytest.mark.parametrize(
    ("table", "named"),
    [
        *(({"demand": {"x": {"arrivals_per_hour": 3.0} | its}}, named) for its, named in DEMAND.values()),
        *(({"costs": costs}, named) for costs, named in COSTS),
    ],
    ids=[*DEMAND, *(f"costs {k}" for k in range(len(COSTS)))],
)
def test_a_bad_table_of_a_scenario_is_one_line(table, named):
    line = refusal(
        lambda: make_scenario(ScenarioSpec.parse({"lot": "mini"} | table, "bad.toml").of_file("bad.toml"))
    )
    assert "bad.toml" in line
    assert named in line


def test_a_bad_demand_of_counts_leaves_nothing(tmp_path):
    """The lot of the scenario has none of the car parks that were counted."""
    counts, words = write_counts(tmp_path / "counts.csv"), ("--scenario", "mini", "--from", "2024-01-01")
    assert "counts.csv" in refused("occupancy", "demand", counts, *words, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


# ---- maps ----


def number(n):
    """A varint of Protocol Buffers."""
    return (n & 127 | 128 if n > 127 else n).to_bytes(1) + (number(n >> 7) if n > 127 else b"")


def field(k, value):
    if isinstance(value, int):
        return number(k << 3) + number(value)
    return number(k << 3 | 2) + number(len(value)) + value


def blob(kind, content, size=None):
    data = field(2, len(content) if size is None else size) + field(3, zlib.compress(content))
    head = field(1, kind) + field(3, len(data))
    return struct.pack(">I", len(head)) + head + data


def nodes(count, first=1):
    """`count` untagged nodes in one place, in 40 bytes of a file: 1,250 such blobs of 8,000 are ten million nodes."""
    ids, zeros = number(2 * first) + b"\2" * (count - 1), b"\0" * count
    group = field(2, field(2, field(1, ids) + field(8, zeros) + field(9, zeros)))
    return blob(b"OSMData", field(1, field(1, b"")) + group)


HEAD = blob(b"OSMHeader", field(4, b"OsmSchema-V0.6") + field(4, b"DenseNodes"))
XML = grid().way([(0, 0), (50, 50)], STREET).xml().encode()
GZ = gzip.compress(XML)


def flipped(data, n):
    rng, changed = random.Random(n), bytearray(data)
    for _ in range(n):
        changed[rng.randrange(len(data) // 4, len(data))] ^= 1 << rng.randrange(8)
    return bytes(changed)


MAPS = {
    "truncated.osm.pbf": (HEAD + nodes(8_000))[:-9],
    "flipped.osm.pbf": HEAD + flipped(nodes(8_000), 8),
    "empty.osm.pbf": b"",
    "bomb.osm.pbf": HEAD + blob(b"OSMData", bytes(1 << 26)),
    "lie.osm.pbf": HEAD + blob(b"OSMData", bytes(99), size=1 << 30),
    "long.osm.pbf": struct.pack(">I", 1 << 31) + b"x",
    "many.osm.pbf": HEAD + b"".join(nodes(8_000, 1 + 8_000 * k) for k in range(2)),
    "truncated.osm.bz2": bz2.compress(XML)[:-40],
    "truncated.osm.gz": GZ[: len(GZ) // 2],
    "flipped.osm.gz": flipped(GZ, 8),
    "bomb.osm.gz": gzip.compress(b"<osm>" + b" " * 4_000_000),
    "truncated.osm": XML[: len(XML) // 2],
    "entities.osm": b'<!DOCTYPE x [<!ENTITY a "b">]><osm>&a;</osm>',
    "nowhere.osm": b'<osm version="0.6"><node id="1" lat="nan" lon="1"/></osm>',
}


@pytest.mark.parametrize(("name", "content"), MAPS.items(), ids=MAPS)
def test_a_damaged_map_is_one_line(tmp_path, monkeypatch, name, content):
    if name.endswith("pbf"):
        pytest.importorskip("osmium", reason="the extra osm is not installed")
    monkeypatch.setattr(elements, "MOST_ELEMENTS", 10_000)
    path = tmp_path / name
    path.write_bytes(content)
    line = refusal(import_town, path)
    assert name in line
    assert name != "many.osm.pbf" or "more than 10,000 nodes" in line
