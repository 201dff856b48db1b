"""The first search: drive a car by the thesis's planner, and watch what it costs.

It takes a few seconds.
"""

import gymnasium as gym

import parkenv

scenario = parkenv.make_scenario("campus")
env = gym.make("parkenv/Search-v2", scenario=scenario, render_mode="ansi")
agent = parkenv.make_agent("mdp", scenario)

observation, info = env.reset(seed=7)
print(env.render())
plan, over = None, False
while not over:
    action, plan = agent.predict(observation, plan)
    observation, reward, terminated, truncated, info = env.step(action)
    over = terminated or truncated
print(env.render())
print(f"drive {info['drive_s']:.0f} s + walk {info['walk_s']:.0f} s = {info['total_s']:.0f} s")
print(f"planned again {plan.replans} times")
