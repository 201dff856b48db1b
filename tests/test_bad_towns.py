"""Bad input for towns: one line that names file, field, value and what was wanted; exit code 2, nothing written."""

import bz2
import gzip
import random
import struct
import zlib

import pytest
from car_park_counts import write_counts
from command_line import refused
from made_maps import STREET
from test_import_town import grid

from parkenv import InputError, make_scenario
from parkenv.lots.osm import elements
from parkenv.lots.town.draft import import_town
from parkenv.scenarios.spec import ScenarioSpec


def one_line(error, *named):
    assert "\n" not in str(error.value)
    for word in named:
        assert word in str(error.value)


# ---- demand ----

DEMAND = {
    "negative arrivals": ({"arrivals_per_hour": -3}, "arrivals_per_hour.0 is -3"),
    "no number": ({"arrivals_per_hour": [1.0] * 23 + [float("nan")]}, "arrivals_per_hour.23 is nan"),
    "a class that no zone names": ({"classes": {"vip": 0.5}}, "demand.x.classes has 'vip'"),
    "a class of everybody": ({"classes": {"public": 0.5}}, "demand.x.classes has 'public'"),
    "more parked than spaces": ({"parked": 11}, "demand.x.parked is 11"),
    "goals that the lot has not": ({"goals": [1.0, 2.0]}, "demand.x.goals has 2"),
    "a goal without number": ({"goals": [float("nan")]}, "demand.x.goals.0 is nan"),
    "an endless stay": ({"stay_s": float("inf")}, "stay_s is inf"),
}


@pytest.mark.parametrize(("table", "named"), DEMAND.values(), ids=DEMAND)
def test_bad_demand_is_one_line(table, named):
    demand = {"x": {"arrivals_per_hour": 3.0} | table}
    with pytest.raises(InputError) as error:
        make_scenario(ScenarioSpec.parse({"lot": "mini", "demand": demand}, "bad.toml").of_file("bad.toml"))
    one_line(error, "bad.toml", named)


@pytest.mark.parametrize("price", ["+x", "+nan", "+inf", "1 @ late", "+-1", "-1/h", True, -1.0])
def test_a_bad_price_is_one_line(price):
    with pytest.raises(InputError) as error:
        ScenarioSpec.parse({"lot": "mini", "costs": {"prices": {"a*": price}}}, "bad.toml")
    one_line(error, "bad.toml", "costs.prices.a*")


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
    with pytest.raises(InputError) as error:
        import_town(path)
    one_line(error, name)
    if name == "many.osm.pbf":
        one_line(error, "more than 10,000 nodes")
