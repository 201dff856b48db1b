"""How bold should the planner be? Sweep what it believes a failed try to cost."""

import numpy as np

from parkenv import make_scenario
from parkenv.studies.episodes import EpisodeRunner
from planners import make_agent

scenario = make_scenario("jam")
print("failure cost s   total s   driven m   walked m   re-plans")
for failure_s in (1.0, 5.0, 10.0, 30.0, 90.0):
    runner = EpisodeRunner(scenario, "mdp", make_agent("mdp", scenario, failure_s=failure_s))
    rows = [runner.run(seed).row for seed in range(20)]
    means = [np.mean([row[name] for row in rows]) for name in ("total_s", "driven_m", "walked_m", "replans")]
    print(f"{failure_s:14.0f} " + " ".join(f"{m:10.1f}" for m in means))
