"""From the slot graph to the steering wheel: a planner parks a car of real size among others, in pymunk.

It takes a few seconds, with a line for each drive.
"""

import gymnasium as gym

import parkenv  # noqa: F401  registers the environments
from planners.driving.parking import ParkingAgent

driver = ParkingAgent()
for kind in ("perpendicular", "oblique", "parallel"):
    lot = "street" if kind == "parallel" else "campus"
    env = gym.make("parkenv/Drive-v1", lot=lot, kinds=(kind,), obstacle_map=True)
    for seed in range(2):
        observation, info = env.reset(seed=seed)
        memory, over = None, False
        while not over:
            action, memory = driver.predict(observation, memory)
            observation, reward, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        outcome = (
            "parked" if info["is_success"] else f"failed ({env.unwrapped.state.contact or 'out of time'})"
        )
        print(
            f"{kind:13s} {outcome} after {info['time_s']:4.1f} s and {info['direction_changes']} changes of direction, "
            f"{100 * info['position_error_m']:.0f} cm off"
        )
