"""What a town should do: the best price of two streets, the same answer however it is run, and rules of zones."""

import json
import math
import subprocess
import sys
import time

import numpy as np
import pytest
from command_line import parkenv

from parkenv import InputError, make_scenario
from parkenv.lots.formats.geojson import write_lot
from parkenv.studies.policy.answer import sentences
from parkenv.studies.policy.study import PolicyStudy
from parkenv.studies.policy.town import Policy, share_in_band
from parkenv.studies.runner import Interrupted, run
from parkenv.world.facility import Facility
from parkenv.world.lot import Lane, ParkingLot
from parkenv.world.occupancy.log import weekday_of
from parkenv.world.occupancy.process import Arrival
from parkenv.world.tariff import Price, Tariff, Zone

GATE_S, PER_HOUR, STAY_S, VALUE = 20.0, 200.0, 3600.0, 12.0


@pytest.fixture(scope="module")
def two_streets(tmp_path_factory):
    """Return a scenario in which all pass a near street, whose barrier takes its time, and then a far one."""
    folder = tmp_path_factory.mktemp("two_streets")
    lot = ParkingLot(
        "two",
        slot_ids=(),
        slot_xy=np.zeros((0, 2)),
        slot_yaw=np.zeros(0),
        slot_length=np.zeros(0),
        slot_width=np.zeros(0),
        slot_mouth=np.zeros(0, np.int8),
        lanes=(Lane(np.array([[0.0, 0.0], [50.0, 0.0], [170.0, 0.0], [200.0, 0.0]])),),
        entries=np.zeros((1, 2)),
        goals=np.array([[50.0, 0.0]]),
        facilities=(
            Facility("A", "lot", "near", capacity=500, xy=(50.0, 0.0), gate_s=GATE_S),
            Facility("B", "lot", "far", capacity=500, xy=(170.0, 0.0)),
        ),
        zone_rules={"near": Zone("near", Price(0.5)), "far": Zone("far")},
    )
    write_lot(lot, folder / "two.geojson")
    tables = f"""
        lot = "two.geojson"
        forecast = {{ flat = 0.0 }}
        [arrivals]
        hours = "08:00-18:00"
        [demand.all]
        arrivals_per_hour = {PER_HOUR}
        stay_s = {STAY_S}
        value_of_time = {VALUE}
        """
    (folder / "two.toml").write_text(tables)
    lines = [
        f"2024-01-0{day}T{hour:02d}:00:00,{name},{(hour + day) % 2}"
        for day in (1, 2)
        for name in "AB"
        for hour in range(8, 19)
    ]
    (folder / "days.csv").write_text("\n".join(["datetime,slot_id,occupied", *lines]))
    return folder / "two.toml"


def best_price(scenario) -> float:
    """Return the price of an hour in the near street at which the mean time of a car is least.

    Cars come as a Poisson process of rate l, and stay for exponential times of mean m. The barrier of the near street
    takes g for each, so that x cars an hour there take W(x) = g + x g^2 / (2 (1 - x g)) (M/D/1, Pollaczek and
    Khinchine), and the far street takes D longer than the near one without its barrier. A further car there
    takes W itself, and x W' of those behind it. The sum x W + (l - x) D is least where W + x W' = D, at
    x g = 1 - sqrt(g / (2 D - g)). Drivers see the barrier, not the queue before it: one parks in the near street if
    price x stay < v (D - g), where v is the value of time, so x = l (1 - exp(-v (D - g) / (p m))). The price that
    brings them to the best x is what Pigou (1920) asks for, and Edelson and Hildebrand (1975) for queues that are not
    seen: those who stay long go to the far street.
    """
    lot = scenario.lot
    walk_s = lot.walk_m(0) / scenario.v_walk
    drive_s = (lot.vertex_xy[:2, 0] - lot.entries[0, 0]) / scenario.v_drive
    far_s = float(np.diff(walk_s + drive_s)[0])
    flow = (1.0 - math.sqrt(GATE_S / (2.0 * far_s - GATE_S))) / GATE_S * 3600.0
    return VALUE * (far_s - GATE_S) / STAY_S / -math.log(1.0 - flow / PER_HOUR)


def asked(scenario, **changes):
    aims = {"hours": "10:00-17:00", "in_band": 0.0, "cruised": None, "time": 0.0}
    levers = {
        "zones": ["near"],
        "by": "zone",
        "hours": ["00:00-24:00"],
        "step": 0.005,
        "most": 2.0,
        "spread": 0.1,
    }
    tables = {"scenario": str(scenario), "aims": aims, "levers": levers, "jobs": 1, "figures": False}
    return PolicyStudy.parse(tables | changes, "test")


@pytest.mark.slow
def test_best_price_of_two_streets(two_streets):
    study = asked(two_streets, budget=480, days_each=4, rounds=1, held_out=["given"], episodes=5)
    result = run(study)
    (price,) = result.summary["policies"]["ours"]["zones"].values()
    found = float(price["price"].split(" @")[0])
    assert found == pytest.approx(best_price(study.town.scenario), rel=0.05)
    _, _, ours = result.summary["answer"]
    assert ours["time_s_of_today_ci95"][1] < 1.0


def small(scenario):
    """Return a study with all stages and levers, in a fraction of a second."""
    aims = {"hours": "09:00-10:00", "cruised": None, "band": [0.001, 0.5]}
    levers = {
        "zones": ["near"],
        "hours": ["08:00-10:00"],
        "guided": [0.0, 0.5],
        "max_stay_s": {"near": [0, 1800]},
    }
    days = {"budget": 22, "days_each": 1, "rounds": 2, "held_out": ["0.5x"], "episodes": 2}
    study = asked(scenario, aims=aims, levers=levers, **days)
    log = {"log": str(scenario.parent / "days.csv"), "mapping": "same"}
    tables = {"arrivals": {"hours": "08:00-10:00"}, "occupancy": log, "forecast": {}}
    return study.changed(scenario=study.scenario.changed(**tables))


def files_of(folder):
    """Return what a run says, but for its command."""
    summary = json.loads((folder / "summary.json").read_text()) | {"command": None}
    files = (*folder.glob("*.csv"), *folder.glob("*.jsonl"))
    return {path.name: path.read_bytes() for path in files} | {"summary": json.dumps(summary)}


def test_search_ends_with_an_answer(two_streets, tmp_path):
    summary = run(small(two_streets).changed(figures=True), tmp_path).summary
    assert make_scenario(tmp_path / "ours.json").lot.areas == ("far", "near")
    assert (tmp_path / "policy.png").exists()
    page = PolicyStudy.page(json.loads((tmp_path / "summary.json").read_text()), tmp_path)
    assert [table["name"] for table in page.tables] == ["answer", "losers", "policy_blocks", "assumed"]
    assert any("block-hours" in said for said in page.findings)
    assert {row["method"] for row in summary["tried"]} >= {"SFpark", "balance", "evolution"}
    assert all(np.min(its["expects"]) >= 0.0 for its in summary["policies"].values())
    assert [row["policy"] for row in summary["answer"]] == ["today", "SFpark", "ours"]
    for most_s, missed in ((60.0, True), (120.0, False)):
        aims = summary["aims"] | {"in_band": 0.0, "time": None, "loss_s": most_s}
        losers = [row | {"change_s": 90.0} for row in summary["losers"]]
        assert ("90 s" in sentences(summary | {"aims": aims, "losers": losers})[-1]) == missed


def test_an_interrupted_run_tells_of_the_demands_that_all_policies_have_driven(two_streets, tmp_path):
    study = small(two_streets).changed(held_out=["0.5x", "1x"])
    for first, (days, rates) in enumerate({1: [], 8: ["0.5x"] * 3}.items()):

        def stop(doing, done, total, days=days):
            if doing == "Driving held-out days" and done == days:
                raise KeyboardInterrupt

        with pytest.raises(Interrupted):
            run(study, tmp_path, resume=first > 0, progress=stop)
        summary = json.loads((tmp_path / "summary.partial.json").read_text())
        assert [row["arrivals_per_hour"] for row in summary["answer"]] == rates
        page = PolicyStudy.page(summary, tmp_path)
        assert bool(page.findings) == bool(page.headlines) == bool(rates)


@pytest.mark.slow
def test_workers_and_a_signal_leave_the_answer_as_it_is(two_streets, tmp_path):
    study, out, file = small(two_streets), tmp_path / "killed", tmp_path / "policy.json"
    run(study, tmp_path / "whole")
    study.changed(jobs=2).write(file)
    process = subprocess.Popen([sys.executable, "-m", "parkenv", "policy", file, "--out", out])
    deadline = time.monotonic() + 60.0
    while not (out / "trials.jsonl").exists() or len((out / "trials.jsonl").read_text().splitlines()) < 4:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.terminate()
    assert process.wait() == 143
    assert len((out / "trials.jsonl").read_text().splitlines()) < 22
    done = parkenv("policy", file, "--out", out, "--resume")
    assert done.returncode == 0, done.stderr
    assert files_of(out) == files_of(tmp_path / "whole")


def test_drivers_expect_what_they_have_learned(two_streets):
    town = small(two_streets).town
    days = [{"taken": [[0.25, 0.5], [0.75, 1.0]]}, {"taken": [[0.75, 0.5], [0.75, 1.0]]}]
    once = Policy().learned(days, 1.0)
    policy = once.learned([{"taken": [[0.0, 0.0], [0.0, 0.0]]}], 0.2)
    assert policy.expects.tolist() == pytest.approx(np.array([[0.4, 0.4], [0.6, 0.8]]))
    scenario = town.with_policy(policy)
    (day,) = {day.date for day in scenario.occupancy.arrival_days(scenario.arrival)[:1]}
    midnight = weekday_of(day) * 86_400.0
    for hour, expected in ((8, [0.4, 0.6]), (9, [0.4, 0.8])):
        # In the middle of a half-hour; between these, log-odds are linear.
        found = scenario.forecast(Arrival(midnight + hour * 3600.0 + 900.0, day)).p_occupied
        assert found[town.blocks.of_slot.argsort()].tolist() == pytest.approx(expected, abs=1e-4)


def test_a_policy_is_a_scenario(two_streets):
    levers = {
        "zones": ["near"], "hours": ["08:00-12:00", "12:00-18:00"], "step": 0.25, "most": 1.0,
        "max_stay_s": {"near": [0, 1800]}, "open": {"B": ["24/7", "off"]}, "guided": [0.0, 0.5],
    }  # fmt: skip
    town = asked(two_streets, levers=levers).town
    assert town.today.tolist() == [[0.5, 0.5]]
    policy = Policy(np.array([[0.6, 1.7]]), (1, 1, 1))
    changed = town.with_policy(policy)
    rules = {zone.name: zone for zone in changed.zone_rules}
    cut = rules["A, near"]
    assert cut.price.amount(np.array([10.0, 11.0, 18.0]) * 3600.0, 7200.0).tolist() == [1.0, 1.5, 0.0]
    assert (cut.max_stay_s, cut.part_of) == (1800.0, "near")
    assert rules["B, far"].admits(0.0, 60.0).tolist() is False
    assert (town.guided(policy), changed.lot.areas) == (0.5, ("far", "near"))
    assert share_in_band(np.zeros((2, 0, 3)), [0, 2], town.aims) == 0.0, (
        "of a town whose blocks are all closed"
    )
    assert changed.lot.neighbors is town.scenario.lot.neighbors


@pytest.mark.parametrize(
    ("levers", "wanted"),
    [
        (
            {"max_stay_s": {"near": [3600, 1800]}},
            "max_stay_s.near begins with 3600.0, want what is so today, 0.0",
        ),
        ({"users": {"near": [["permit-a"], ["public"]]}}, "users.near begins with"),
        ({"zones": ["near"], "step": 3.0, "most": 2.0}, "step is 3, want at most"),
    ],
)
def test_levers_begin_with_what_is_so_today(two_streets, levers, wanted):
    with pytest.raises(InputError, match=wanted):
        _ = asked(two_streets, levers=levers).town


def test_zones_of_a_scenario():
    table = {"of": "ring", "facilities": ["7th street*"], "price": "1 @ 08:00-12:00; 3 @ 12:00-20:00"}
    market = table | {"hours": "Mo,We-Su 00:00-24:00; Tu 14:00-24:00", "users": ["public", "permit-a"]}
    changed = make_scenario(
        {"base": "town", "zones": {"market street": market, "ring": {"max_stay_s": 7200}}}
    )
    plain = make_scenario("town")
    lot = changed.lot
    moved = np.flatnonzero(lot.slot_zone == "market street")
    assert set(plain.lot.slot_zone[moved]) == {"ring"}
    assert 0 < len(moved) < (plain.lot.slot_zone == "ring").sum()
    assert lot.areas == plain.lot.areas
    assert {lot.facilities[k].name[:10] for k in lot.facility_of_slot[moved]} == {"7th street"}
    assert [lot.zone_rules[name].max_stay_s for name in ("ring", "market street")] == [7200, None]
    for wrong, field in (
        ({"mall": {"price": 1}}, "mall"),
        ({"x": table | {"of": "rong"}}, "ring"),
        ({"x": table | {"facilities": ["Nowhere*"]}}, "Nowhere"),
        ({"ring": {"users": ["nobody"]}}, "nobody"),
        ({"ring": {"hours": "late"}}, "hours"),
        ({"ring": {"price": "1 @ late"}}, "price"),
    ):
        with pytest.raises(InputError, match=field):
            make_scenario({"base": "town", "zones": wrong})


def test_prices_by_hours_are_a_tariff():
    zone = Tariff({"near": "1 @ 08:00-12:00; 3 @ 12:00-15:00"}).priced(Zone("near", Price(9.0)))
    begin = np.array([7.0, 11.5, 16.0]) * 3600.0
    assert zone.price.amount(begin, 7200.0).tolist() == [1.0, 5.0, 0.0]
    assert zone.price.raised(1.0).amount(begin, 7200.0).tolist() == [2.0, 7.0, 0.0]
    with pytest.raises(InputError, match="hourly"):
        Price(1.0, hourly=zone.price.hourly)
    with pytest.raises(InputError, match="price"):
        Tariff({"near": "cheap"})
