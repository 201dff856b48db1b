"""How bold should the planner be? Vary what it believes a failed attempt to cost, in the same worlds.

The world charges 10 s all along. `parkenv compare --failure-cost sweep` varies both: what the world charges, and with
it what planners believe. Rows come at the end, after some seconds.
"""

import parkenv
from parkenv.studies.compare.cases import rows_of
from parkenv.studies.fields import AgentSpec
from parkenv.studies.workers import SERIAL

print("100 searches ...", flush=True)
agents = [AgentSpec(name="mdp", failure_s=failure_s) for failure_s in (10.0, 1.0, 5.0, 30.0, 90.0)]
print("total s   minus the first [95 %]   driven m   walked m   agent")
for row in rows_of(agents, parkenv.make_scenario("jam"), range(20), SERIAL):
    low, high = row["difference_s_ci95"]
    print(
        f"{row['total_s']:7.1f} {row['difference_s']:+11.1f} [{low:+5.1f}, {high:+5.1f}] "
        f"{row['driven_m']:10.1f} {row['walked_m']:10.1f}   {row['agent']}"
    )
