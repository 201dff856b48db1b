"""Learning from raw sensors: a policy that observes its last laser scans and poses, and no map, forecast or belief.

`python examples/12_scans_alone.py` shows in seconds that it runs. Scenario, decisions and seed can be given:
`python examples/12_scans_alone.py mini 200000 0`.
"""

import sys
import tempfile

from sb3_contrib import MaskablePPO

import parkenv
from parkenv.envs.sb3 import SearchVecEnv
from parkenv.studies.simulate import make_search, simulate
from parkenv.studies.statistics import mean_interval
from planners.model_file import save_model

SCENARIO, DECISIONS, SEED = [*sys.argv[1:], *("mini", "2048", "0")[len(sys.argv) - 1 :]]
WORLDS = 200 if int(DECISIONS) > 10_000 else 4

# A compiled batch: the agent observes the shortest range in each of 72 sectors of its last four scans.
envs = SearchVecEnv(128, SCENARIO, reward_scale=0.01, observation="scan", max_episode_steps=500)
model = MaskablePPO(
    "MultiInputPolicy", envs, 1e-3, n_steps=64 if WORLDS > 4 else 8, batch_size=1024, n_epochs=4, gamma=0.999,
    ent_coef=0.01, seed=int(SEED), device="cpu",
)  # fmt: skip
model.learn(int(DECISIONS))

with tempfile.NamedTemporaryFile(suffix=".safetensors") as file:
    save_model(model, file.name, scenarios=[SCENARIO])  # for parkenv compare and publish
    agents = {f"scans, {int(DECISIONS):,} decisions": f"maskable-ppo:{file.name}"}
    agents |= {name: name for name in ("mdp", "first-free", "random")}
    for title, name in agents.items():
        scenario = parkenv.make_scenario(SCENARIO)
        agent = parkenv.make_agent(name, scenario)
        # Equal seeds give equal worlds; the policy gets scans there, planners beliefs. Who does not park is charged.
        env = make_search(scenario, agent, max_episode_steps=500)
        totals = [simulate(env, agent, 1_000_000 + world).info["total_s"] for world in range(WORLDS)]
        mean, low, high = mean_interval(totals)
        print(f"{title:26} {mean:7.1f} s [{low:.1f}, {high:.1f}]")
