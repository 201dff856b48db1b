"""Agents: the interface, what the strategies do, the oracle's bound, and the thesis's findings."""

import sys

import gymnasium as gym
import numpy as np
import pytest
from small_lots import CAR_PARKS, cut_in_two, lasting

from parkenv import InputError, OccupancyProcess, Scenario, SearchProblem, SensorModel, make_scenario
from parkenv.lots import grid_lot
from parkenv.studies.compare.cases import Case, settings_of
from parkenv.studies.episodes import EpisodeRunner
from planners import AGENT_NAMES, make_agent

SEEDS, FULL = range(12), grid_lot(2, 5)


def episodes(scenario, agent, seeds=SEEDS):
    return Case(scenario, agent).run(seeds)


def mean(rows, column):
    return float(np.mean([row[column] for row in rows]))


def test_an_agent_of_your_own_is_named_by_module_and_class(tmp_path, monkeypatch):
    (tmp_path / "my_agents.py").write_text(
        "from planners.agent import SearchAgent\n"
        "class Parker(SearchAgent):\n"
        "    name = 'parker'\n"
        "    def __init__(self, problem, action=4):\n"
        "        super().__init__(problem)\n"
        "        self.action, self.given = action, problem\n"
        "    def begin(self, observation, belief):\n"
        "        return None\n"
        "    def decide(self, observation, belief, memory):\n"
        "        return self.action\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", list(sys.path))
    scenario = make_scenario("mini")
    agent = make_agent("my_agents:Parker", scenario)
    assert not hasattr(agent.given, "occupancy")  # it must not know the occupancy
    action, _ = agent.predict(gym.make("parkenv/Search-v2", scenario=scenario).reset(seed=0)[0])
    assert action == 4
    assert make_agent("my_agents:Parker", scenario, action=3).action == 3
    with pytest.raises(InputError, match="no option 'speed'; known: action"):
        make_agent("my_agents:Parker", scenario, speed=1)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (":X", "want MODULE:CLASS; nor is it"),
        ("..odd:X", "want MODULE:CLASS"),
        ("odd_agents:", "want MODULE:CLASS"),
        ("odd_agents:X", r"its module fails: SyntaxError: .*odd_agents.py, line 1"),
        ("failing_agents:X", r"its module fails: ZeroDivisionError: .*failing_agents.py, line 1\)"),
        ("needy_agents:X", "its module needs 'no_such_package', which is not installed"),
        ("my_agents:Driver", "no 'Driver'"),
        ("my_agents:nothing", "no method predict"),
        ("no_such_module:Agent", "no module 'no_such_module' in .*; nor is it an algorithm"),
    ],
)
def test_modules_of_agents_that_cannot_be_imported_are_named(tmp_path, monkeypatch, name, message):
    modules = {"odd": "def x(:", "failing": "1 / 0", "needy": "import no_such_package", "my": "nothing = 3"}
    for module, text in modules.items():
        (tmp_path / f"{module}_agents.py").write_text(f"{text}\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", list(sys.path))
    monkeypatch.delitem(sys.modules, "my_agents", raising=False)
    with pytest.raises(InputError, match=message) as caught:
        make_agent(name, make_scenario("mini"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", AGENT_NAMES)
def test_agents_get_the_public_part_of_a_scenario_only(name):
    agent = make_agent(name, make_scenario("campus"))
    assert type(agent.problem) is SearchProblem
    assert not hasattr(agent.problem, "occupancy")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name == "network"))
        for name in AGENT_NAMES
        if name != "oracle"
    ],
)
def test_a_batch_of_observations_gives_the_actions_of_the_single_ones(name):
    scenario = make_scenario("campus")
    agent = make_agent(name, scenario)
    envs = [gym.make("parkenv/Search-v2", scenario=scenario) for _ in range(3)]
    observations = [env.reset(seed=i)[0] for i, env in enumerate(envs)]
    singles, batch, start = [None] * 3, None, np.ones(3, dtype=bool)
    for _ in range(15):
        stacked = {key: np.stack([o[key] for o in observations]) for key in observations[0]}
        actions, batch = agent.predict(stacked, batch, start)
        start[:] = False
        for i, env in enumerate(envs):
            action, singles[i] = agent.predict(observations[i], singles[i])
            assert action == actions[i]
            observations[i] = env.step(action)[0] if not env.unwrapped.state.over else observations[i]


def test_random_agent_repeats_itself_under_a_seed():
    scenario = make_scenario("mini")
    runners = [EpisodeRunner(scenario, "random", make_agent("random", scenario, seed=n)) for n in (1, 1, 2)]
    one, again, other = ([runner.run(s).row for s in SEEDS] for runner in runners)
    assert one == again != other


@pytest.mark.parametrize("agent", ["mdp", "greedy-goal", "greedy-drive", "first-free", "random"])
def test_a_full_lot_is_given_up_once_it_is_proven_full(agent):
    scenario = lasting(FULL, np.ones(10, dtype=bool), give_up_s=500.0)
    row = EpisodeRunner(scenario, agent, make_agent(agent, scenario)).run(0).row
    assert not row["parked"]
    assert not row["truncated"]
    assert (row["gave_up_s"], row["bound_s"]) == (500.0, 500.0)


def test_a_search_cut_off_is_charged_like_one_that_gave_up():
    scenario = lasting(FULL, np.ones(10, dtype=bool), failure_s=1.0, give_up_s=500.0)
    scenario = scenario.replace(sensor_model=SensorModel(view_range=0.0))
    row = EpisodeRunner(scenario, "mdp-static", make_agent("mdp-static", scenario)).run(0).row
    assert row["truncated"]
    assert row["total_s"] == pytest.approx(row["drive_s"] + row["failed_s"] + 500.0)
    assert row["steps"] == 2000
    assert row["failed_parks"] > 100, "it keeps trying"
    assert row["replans"] == 0


def test_the_planner_never_tries_a_slot_that_it_sees_taken():
    for name in CAR_PARKS:
        rows = episodes(make_scenario(name), "mdp")
        assert mean(rows, "failed_parks") == 0.0
        assert mean(rows, "replans") > 0.0


@pytest.mark.parametrize("name", CAR_PARKS)
def test_all_meet_the_same_worlds_nobody_beats_the_bound_and_the_oracle_reaches_it(name):
    sensor = SensorModel(view_range=6.0, hit_rate=0.95, false_alarm_rate=0.05)
    scenario, worlds = make_scenario(name, sensor_model=sensor), set()
    for agent in AGENT_NAMES:
        rows = episodes(scenario, agent, range(1 if agent in ("network", "belief-rivals") else 4))
        worlds |= {(row["seed"], row["arrival_s"], row["occupancy"], row["bound_s"]) for row in rows}
        for row in rows:
            assert row["total_s"] >= row["bound_s"] - 1e-6, (agent, row["seed"])
            if agent == "oracle" and row["gave_up_s"] == 0.0:
                assert row["total_s"] <= row["bound_s"] + scenario.wait_s
    assert len(worlds) == 4


def test_the_oracle_must_be_shown_the_future_and_waits_for_a_slot_that_is_about_to_come_free():
    scenario = make_scenario("mini")
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    with pytest.raises(RuntimeError, match="prepare"):
        make_agent("oracle", scenario).predict(env.reset(seed=0)[0])
    # Days that are as forecast: on a much fuller one, slots are free for less than the oracle's step of waiting.
    scenario = make_scenario("mini", entry=0, day_error=0.0)
    busy = scenario.replace(occupancy=scenario.occupancy.at_mean_occupancy(0.97, 10 * 3600.0))
    parked = [r for r in episodes(busy, "oracle", range(60)) if r["parked"]]
    waited = [r for r in parked if r["drive_s"] > r["driven_m"] / busy.v_drive + 0.5]
    assert waited, "in a nearly full lot it must wait in some episode"
    for row in parked:
        assert row["bound_s"] - 1e-6 <= row["total_s"] <= row["bound_s"] + 5 * busy.wait_s


def test_the_oracle_turns_to_a_slot_where_the_lot_cannot_be_proven_full():
    """Every slot is in view from everywhere, and an unreachable one is free."""
    lot = cut_in_two()
    half = lot.n_slots // 2
    demand = np.where(np.arange(lot.n_slots) < half, 3.0, -25.0)
    occupancy = OccupancyProcess.from_demand(demand, np.zeros(168), 600.0)
    sees_all = SensorModel(view_range=1000.0)
    scenario = Scenario(name="cut", lot=lot, occupancy=occupancy, sensor_model=sees_all, give_up_s=60.0)
    rows = episodes(scenario, "oracle", range(12))
    assert any(row["bound_s"] == scenario.give_up_s for row in rows), "giving up would have been quicker"
    assert all(row["parked"] and int(row["slot"]) < half for row in rows)


# --- the thesis's findings (T §4.3) -----------------------------------------------------------------


def setting(name, failure_s, v_walk_kmh, v_drive_kmh, **changes):
    """The thesis's findings are on days that are as forecast; they hold on days that differ from it, too."""
    return settings_of(make_scenario(name, **changes), [failure_s], [v_walk_kmh], [v_drive_kmh])[0]


def test_on_campus_it_drives_in_and_weighs_distance_against_occupancy():
    """Fig. 4.9: nearer to the goal than the first free slot, but not the best slot at any price."""
    scenario = setting("campus", 10.0, 4.0, 10.0)
    planner, nearest, best = (
        episodes(scenario, a, range(40)) for a in ("mdp", "greedy-drive", "greedy-goal")
    )
    assert mean(planner, "driven_m") > 1.5 * mean(nearest, "driven_m")
    assert mean(best, "walked_m") < mean(planner, "walked_m") < 0.8 * mean(nearest, "walked_m")
    assert mean(planner, "total_s") < min(mean(nearest, "total_s"), mean(best, "total_s"))
    # The rows on the way in are emptier than those at the goal: it passes free slots, and stops in time.
    forecast = scenario.forecast(scenario.occupancy.draw_arrival(scenario.arrival, np.uint64(0))).p_occupied
    near = scenario.lot.walk_m() < np.median(scenario.lot.walk_m())
    assert forecast[near].mean() > forecast[~near].mean() + 0.2


def test_on_jam_a_low_failure_cost_is_over_confident_and_a_high_one_is_not():
    """Fig. 4.12 against 4.10: long paths and many re-plans at 10 s; at 90 s short ones, parked farther off."""
    bold = episodes(setting("jam", 10.0, 4.0, 10.0), "mdp", range(30))
    careful = episodes(setting("jam", 90.0, 4.0, 10.0), "mdp", range(30))
    assert mean(careful, "driven_m") < 0.6 * mean(bold, "driven_m")
    assert mean(careful, "replans") < 0.6 * mean(bold, "replans")
    assert mean(careful, "walked_m") > mean(bold, "walked_m") + 5.0
    assert mean(bold, "replans") > 20.0
