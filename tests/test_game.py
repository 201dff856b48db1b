"""`parkenv play`: the page searches as Python does, is played by keys and fingers, and its scores are checked."""

import itertools
import json
import shutil
import subprocess
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from chromium import SOCKETS, screen
from command_line import ran, refused, summary_of
from test_report import data_of
from test_search_reference import SENSORS, random_scenario
from timetable_world import Timetable

from parkenv import InputError, make_scenario
from parkenv.show.report import page as pages
from parkenv.studies.fields import AgentSpec
from parkenv.studies.play import game_data
from parkenv.world.occupancy.process import World
from planners import make_agent

pytestmark = SOCKETS
SCRIPTS = Path(pages.__file__).parent
NODE = shutil.which("node")


@pytest.fixture(scope="module")
def game(tmp_path_factory):
    """The page of three worlds of the lot with ten slots, beside two agents."""
    out = tmp_path_factory.mktemp("game") / "play.html"
    ran("play", "--html", "--scenario", "mini", "--worlds", "3", "--seed", "4", "--out", out)
    return out


@pytest.fixture(scope="module")
def scores(game, tmp_path_factory):
    """What the page would save if a person did what the agent `belief` does."""
    data, worlds = data_of(game, "game-data"), []
    for world in data["worlds"]:
        env = gym.make("parkenv/Search-v2", scenario="mini")
        env.reset(seed=world["seed"])
        for action in world["actions"][0]:
            _, _, over, _, info = env.step(int(action))
        assert over
        kept = {name: world[name] for name in ("seed", "arrival_s", "entry")}
        worlds.append(kept | {"actions": world["actions"][0], "total_s": info["total_s"]})
    return {"format": "parkenv-scores", "version": 1, "scenario": "mini", "worlds": worlds}


def saved(scores, folder, **change):
    """An agent that repeats the scores, with another first world if wanted."""
    first, *others = scores["worlds"]
    (folder / "scores.json").write_text(json.dumps(scores | {"worlds": [first | change, *others]}))
    return f"human:{folder / 'scores.json'}"


def random_search(scenario, seed, rng, avoids_free, limit):
    """A search by random actions, some of them waits: the actions, and what Python says of its end."""
    env = gym.make("parkenv/Search-v2", scenario=scenario, max_episode_steps=limit, disable_env_checker=True)
    observation, _ = env.reset(seed=seed)
    state, actions, over = env.unwrapped.state, "", False
    while not over:
        allowed = np.flatnonzero(observation["action_mask"])
        action = int(rng.choice(allowed)) if rng.random() < 0.8 else int(rng.integers(4))
        slot = state.vertex
        if action == 4 and avoids_free and not state.world.occupied([slot], state.time)[0]:
            action = int(rng.integers(4))
        observation, _, terminated, truncated, info = env.step(action)
        actions, over = actions + str(action), terminated or truncated
    total_s = info["total_s"] + (0.0 if terminated else scenario.give_up_s)
    return actions, total_s, state.vertex, observation["p_occupied"]


def random_searches(scenario, seeds, limit=2_000):
    rng, each = np.random.default_rng(7), itertools.product(enumerate(seeds), (False, True))
    return [(w, random_search(scenario, seed, rng, many, limit)) for (w, seed), many in each]


def require_equal(searches, states):
    for (_, (actions, total_s, vertex, p_occupied)), state in zip(searches, states, strict=True):
        assert state["total_s"] == pytest.approx(total_s, abs=1e-9)
        assert (state["vertex"], state["steps"], state["over"]) == (vertex, len(actions), True)
        assert state["belief"] == pytest.approx(p_occupied, abs=1e-6)


@pytest.mark.skipif(NODE is None, reason="node is not installed")
@pytest.mark.parametrize(
    "kind", ["process", "days", pytest.param("log", marks=pytest.mark.slow), "timetable"]
)
def test_the_search_of_the_page_is_that_of_python(kind, tmp_path, monkeypatch):
    """In random scenarios of all kinds of worlds and sensors: parked, given up in a full lot, and out of steps."""
    limit, seeds, games = 120, (11, 2**31), []
    monkeypatch.setattr("parkenv.studies.play.STEP_LIMIT", limit)
    rng = np.random.default_rng(len(kind))
    for sensor in SENSORS:
        scenario = random_scenario(rng, kind, sensor)
        if kind == "timetable":
            scenario = scenario.replace(occupancy=Timetable(scenario.lot), prior=None)
        data = game_data(scenario, [AgentSpec(name="oracle")], seeds)
        games.append((data, random_searches(scenario, seeds, limit)))
    program = "\n".join((SCRIPTS / script).read_text() for script in ("search_track.js", "game_search.js"))
    program += f"""
    const games = {json.dumps([(data, [(w, its[0]) for w, its in searches]) for data, searches in games])};
    console.log(JSON.stringify(games.flatMap(([data, searches]) => {{
      unpackGame(data);
      const search = (w) => new GameSearch(data.problem, data.worlds[w], data.terms);
      return searches.map(([w, actions]) => search(w).take(actions).state);
    }})));
    """
    (tmp_path / "game.js").write_text(program)
    done = subprocess.run([NODE, tmp_path / "game.js"], capture_output=True, text=True, check=True)
    require_equal([search for _, searches in games for search in searches], json.loads(done.stdout))


@pytest.mark.parametrize("kind", ["process", "days", pytest.param("log", marks=pytest.mark.slow)])
def test_the_next_changes_of_slots_are_found_to_the_last_bit(kind):
    """As by bisection, which finds them in a world of any kind."""
    scenario = random_scenario(np.random.default_rng(1), kind, "exact")
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    env.reset(seed=3)
    world, begin = env.unwrapped.state.world, env.unwrapped.state.time
    slots = np.arange(scenario.lot.n_slots)
    found = world.next_change(slots, begin, begin + 7_200.0)
    assert np.isfinite(found).any()
    assert np.array_equal(found, World.next_change(world, slots, begin, begin + 7_200.0))


def test_scores_are_a_row_of_a_comparison(scores, tmp_path):
    agents = f"belief,{saved(scores, tmp_path)},oracle"
    words = "compare --scenario mini --seed 4 -n 3 --jobs 1 --no-figures --agents"
    ran(words, agents, "--out", tmp_path / "out")
    summary = summary_of(tmp_path / "out")
    belief, human, _ = summary["rows"]
    assert human["agent"] == agents.split(",")[1]
    assert human["total_s"] == belief["total_s"]
    # Nobody has played in the worlds of other occupancies.
    assert {row["agent"] for row in summary["occupancy_rows"]} == {"belief", "oracle"}


@pytest.mark.parametrize(
    ("options", "change", "field"),
    [
        ("--scenario campus --seed 4 -n 3", {}, "scenario is 'mini'"),
        ("--scenario mini --seed 4 -n 4", {}, "--episodes"),
        ("--scenario mini --seed 3 -n 3", {}, "--seed"),
        ("--scenario mini --seed 4 -n 3 --v-drive-kmh 12", {}, "total_s"),
        ("--scenario mini --seed 4 -n 3", {"total_s": 1.0}, "total_s is 1.0"),
    ],
)
def test_scores_of_another_game_are_refused_in_a_line(scores, tmp_path, options, change, field):
    agents = f"mdp,{saved(scores, tmp_path, **change)}"
    assert field in refused("compare", *options.split(), "--agents", agents, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"actions": "0123456789"}, "actions"), ({"actions": ""}, "actions"), ({"total_s": -1.0}, "total_s"),
        ({"seed": "4"}, "seed"), ({"code": 1}, "code"), ({"seed": 5}, "worlds"),
    ],
)  # fmt: skip
def test_damaged_scores_are_refused(scores, tmp_path, change, field):
    with pytest.raises(InputError, match=field):
        make_agent(saved(scores, tmp_path, **change), make_scenario("mini"))


def test_the_page_searches_as_python_does(browser, game):
    screen(browser, 1280, 800)
    browser.get(game.as_uri())
    seeds = [world["seed"] for world in data_of(game, "game-data")["worlds"]]
    searches = random_searches(make_scenario("mini"), seeds)
    program = "return arguments[0].map(([w, actions]) => game.take(w, actions))"
    require_equal(searches, browser.execute_script(program, [[w, its[0]] for w, its in searches]))
    assert browser.get_log("browser") == []
