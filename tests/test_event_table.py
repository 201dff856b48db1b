"""Tables of single bays: their layouts, their faults, and what fills their gaps."""

import contextlib
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from parkenv import InputError, make_scenario
from parkenv.forecast.counts import Counts
from parkenv.forecast.event_table import is_counts, read_events
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.counted import log_of_counts
from parkenv.world.occupancy.gaps import StateLaw, day_states
from parkenv.world.occupancy.log import OccupancyLog
from parkenv.world.occupancy.process import Arrival
from parkenv.world.week import DAY_S, HOUR_S

DAY = "2024-05-06"
COLUMNS = "bay time state arrival departure since updated state_1 since_1 cars kerb spaces".split()
CELLS = "| a|1|0|-3|occupied|2024-05-06 08:00|2024-05-06 09:00|0001-01-01 00:00|9999-12-31 23:59|nan"
VALUES = CELLS.split("|")


def table(tmp_path, text, name="log.csv"):
    path = tmp_path / name
    path.write_text(text)
    return path


def spans(path, **options):
    """Bay, begin, end (h of the first day) and state of what is known."""
    events = read_events([path], **options)
    hours = ((time / HOUR_S).round(3) for time in (events.start, events.end))
    rows = zip(events.bay, *hours, events.taken, strict=True)
    return [(events.bays[bay], float(a), float(b), int(taken)) for bay, a, b, taken in rows], events.faults


TABLES = json.loads(Path(__file__).with_name("event_tables.json").read_text(encoding="utf-8"))
"""Tables in each layout, with what is known of their bays; and rows with each fault."""


@pytest.mark.parametrize("layout", TABLES["layouts"])
def test_each_layout_is_read(tmp_path, layout):
    text, wanted = TABLES["layouts"][layout]
    path = table(tmp_path, text)
    assert not is_counts(path)
    assert spans(path, timezone="Europe/Berlin")[0] == list(map(tuple, wanted))


@pytest.mark.parametrize("rule", TABLES["faults"])
def test_each_fault_is_cleaned_and_counted(tmp_path, rule):
    stays = f"bay,arrival,departure\na,{DAY} 08:00,{DAY} 09:00\na,{DAY} 09:00,{DAY} 09:20\n"
    found, faults = spans(table(tmp_path, stays + TABLES["faults"][rule] + "\n"))
    assert faults == {rule: 8 if rule == "full_hours" else 1}
    assert found[0] == ("a", 8, 8.5 if rule == "overlapping" else 9, 1)
    assert {bay for bay, *_ in found} == {"a"}


def test_columns_are_named_and_times_in_utc_want_a_zone(tmp_path):
    path = table(tmp_path, f"Marker,In,Out\na,{DAY} 06:00,{DAY} 07:00\n")
    with pytest.raises(InputError, match=r"has the columns 'Marker, In, Out', want bay .*; see --columns"):
        spans(path)
    assert is_counts(path)
    columns = "bay=Marker,arrival=In,departure=Out"
    assert not is_counts(path, columns)
    assert spans(path, columns=columns)[0] == [("a", 6, 7, 1)]
    with pytest.raises(InputError, match="has no column 'Bay', but 'Marker, In, Out'"):
        spans(path, columns="bay=Bay")
    in_utc = columns.replace("arrival", "arrival_utc").replace("departure", "departure_utc")
    with pytest.raises(InputError, match="has times in UTC or with an offset, want --timezone"):
        spans(path, columns=in_utc)
    assert spans(path, columns=in_utc, timezone="Europe/Berlin")[0] == [("a", 8, 9, 1)]


def test_a_stay_over_midnight_is_known_on_both_days(tmp_path):
    log = OccupancyLog.read(table(tmp_path, f"bay,arrival,departure\na,{DAY} 22:00,2024-05-07 03:00\n"))
    assert log.days == (DAY, "2024-05-07")
    assert log.slot_days(np.arange(2)).seen.sum(axis=2).tolist() == [[4.0, 6.0]]
    night = [*np.arange(22 * HOUR_S, DAY_S, 900.0), *np.arange(0.0, 3 * HOUR_S, 900.0)]
    assert log.looks.second.tolist() == night


def test_gaps_follow_the_law_given_what_is_known_on_both_sides():
    """A bridge of a chain with P(taken) 0.3 that forgets 1/e an hour, an hour before and after a taken state."""
    n = 3_000
    slot, day = np.repeat(np.arange(n), 2), np.zeros(2 * n, int)
    log = OccupancyLog(
        tuple(map(str, range(n))), (DAY,), slot, day, np.tile([7 * HOUR_S, 10 * HOUR_S], n), np.ones(2 * n),
        known_until=np.tile([8 * HOUR_S, 11 * HOUR_S], n),
    )  # fmt: skip
    p, kept = 0.3, np.exp(-1.0)
    law = StateLaw(np.full((n, 48), np.log(p / (1 - p))), np.full(24, 1 / HOUR_S))
    states = day_states(log, np.arange(n), law, np.random.default_rng(0))

    def share(hour):
        at = [
            np.searchsorted(states.from_s[a:b], hour * HOUR_S, side="right") - 1
            for a, b in zip(states.first[:-1], states.first[1:], strict=True)
        ]
        return states.occupied[states.first[:-1] + at].mean()

    # States are drawn every five minutes; the last known one before the gap is that of 7:55.
    since, stays, comes = p + (1 - p) * kept ** (65 / 60), p + (1 - p) * kept, p - p * kept
    assert share(7.5) == share(10.5) == 1.0
    assert share(9) == pytest.approx(since * stays / (since * stays + (1 - since) * comes), abs=0.035)
    assert share(23) == pytest.approx(p, abs=0.035)
    again = day_states(log, np.arange(n), law, np.random.default_rng(0))
    assert np.array_equal(again.from_s, states.from_s)


def test_counts_of_kerbs_are_followed_at_their_own_rate(tmp_path):
    """Readings a minute apart of one kerb and every ten minutes of another: each on its own slots."""
    rng = np.random.default_rng(1)
    lines = [f"{DAY} {m // 60:02d}:{m % 60:02d},A,{rng.integers(0, 9)}" for m in range(480, 600)]
    lines += [f"{DAY} {m // 60:02d}:{m % 60:02d},B,{rng.integers(0, 5)}" for m in range(480, 600, 10)]
    capacity = table(tmp_path, "kerb,spaces\nA,8\nB,4\n", "capacity.csv")
    path = table(tmp_path, "time,kerb,cars\n" + "\n".join(lines) + "\n", "counts.csv")
    counts = Counts.read(path, capacity=capacity)
    assert is_counts(path)
    assert not counts.total_faults()["duplicate"]
    slots = np.array([0] * 8 + [1] * 4 + [-1])
    log = log_of_counts(counts, slots, tuple(map(str, range(13))), np.zeros(13))
    assert log.recorded[:, 0].tolist() == [True] * 12 + [False]
    for line in lines[:118:7] + lines[120:-1]:
        time, kerb, cars = line.split(",")
        second = int(time[11:13]) * 3600 + int(time[14:]) * 60
        known = (log.second <= second) & (second < log.until) & (slots[log.slot] == "AB".index(kerb))
        assert log.occupied[known].sum() == int(cars)
        assert known.sum() == (8 if kerb == "A" else 4)
    readings = [int(line.split(",")[2]) for line in lines[:60]]
    assert counts.occupied[0, 0, 8] == pytest.approx(np.mean(readings) / 8)


def test_counts_in_several_columns_and_without_capacities(tmp_path):
    text = f"round,block,green,red\n{DAY} 08:00,a,2,1\n{DAY} 09:00,a,,4\n{DAY} 10:00,a,,\n"
    counts = Counts.read(table(tmp_path, text), capacity="largest", columns="taken=green+red")
    np.testing.assert_allclose(counts.occupied[0, 0, 8:11], [0.75, 1.0, np.nan])


@settings(max_examples=100, deadline=None)
@given(
    header=st.lists(st.sampled_from(COLUMNS), min_size=1, unique=True),
    rows=st.lists(st.lists(st.sampled_from(VALUES), min_size=12, max_size=12), max_size=8),
)
def test_strange_tables_give_a_log_counts_or_a_clear_error(tmp_path_factory, header, rows):
    path = tmp_path_factory.getbasetemp() / "strange.csv"
    path.write_text("\n".join(",".join(row[: len(header)]) for row in [header, *rows]) + "\n")
    with contextlib.suppress(InputError):
        assert OccupancyLog.read(path, timezone="UTC").looks.days
    with contextlib.suppress(InputError):
        assert Counts.read(path, "UTC", "largest").days


def test_kerbs_of_a_lot_follow_their_own_counts(tmp_path):
    """Of the slots of `mini`, two are on kerb A, one on B, which no count has; the others follow the forecast."""
    lines = [
        f"2024-05-{d:02d} {m // 60:02d}:{m % 60:02d},A,{m % 3}" for d in (6, 7, 8) for m in range(420, 900, 5)
    ]
    counts = table(tmp_path, "time,kerb,cars\n" + "\n".join(lines) + "\n", "counts.csv")
    ids = make_scenario("mini").lot.slot_ids
    mapping = table(tmp_path, f"slot_id,log_slot_id\n{ids[0]},A\n{ids[1]},A\n{ids[2]},B\n", "mapping.csv")
    occupancy = {"counts": {"file": str(counts), "capacity": "largest"}, "mapping": str(mapping)}
    with pytest.warns(UserWarning, match=f"{len(ids) - 2} of {len(ids)} slots of the lot have no record"):
        scenario = make_scenario({"lot": "mini", "occupancy": occupancy})
    arrival = Arrival(1 * DAY_S + 8 * HOUR_S, "2024-05-07")
    world, forecast = scenario.occupancy.world(0, arrival), scenario.forecast(arrival).p_occupied
    for minute in range(0, 300, 5):
        assert world.occupied([0, 1], arrival.time + 60.0 * minute).sum() == (480 + minute) % 3
    assert forecast[2:] == pytest.approx(forecast[:2].mean())
    occupancy["counts"]["columns"] = "time_utc=time"
    with pytest.raises(InputError, match=r"counts\.csv: has times in UTC or with an offset, want --timezone"):
        make_scenario({"lot": "mini", "occupancy": occupancy})
    late = {"counts": {"file": str(counts), "capacity": "largest"}, "replay_from": "2024-05-09"}
    with pytest.raises(InputError, match=r"no recorded day from 2024-05-09 on .* are from 2024-05-06 to"):
        make_scenario({"lot": "mini", "occupancy": late}).occupancy.days_in(ArrivalWindow())
