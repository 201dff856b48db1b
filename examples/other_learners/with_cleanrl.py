"""PPO of CleanRL, its file as it is: `python with_cleanrl.py SCENARIO DECISIONS PPO.PY`.

It trains on an id alone, without options, and keeps no model: what its file has learned is in its names at the end. The
policy goes to `cleanrl.safetensors`, which `examples/peers/cleanrl.py` plays.
"""

import hashlib
import runpy
import sys
from pathlib import Path

import torch
from held_out import tell
from safetensors.torch import save_file

SCENARIO, DECISIONS, FILE = sys.argv[1], int(sys.argv[2]), sys.argv[3]

torch.set_num_threads(1)
sys.argv = [
    FILE, "--env-id", f"parkenv.envs.flat_ids:parkenv-flat/{SCENARIO}-v2", "--total-timesteps", str(DECISIONS),
    "--num-envs", "32", "--num-steps", "64", "--gamma", "0.999", "--learning-rate", "1e-3", "--no-cuda",
]  # fmt: skip
agent = runpy.run_path(FILE, run_name="__main__")["agent"]
save_file(agent.actor.state_dict(), "cleanrl.safetensors")

tell(
    "cleanrl",
    DECISIONS,
    lambda observation: int(agent.get_action_and_value(torch.as_tensor(observation))[0]),
    SCENARIO,
    release=f"ppo.py {hashlib.sha256(Path(FILE).read_bytes()).hexdigest()[:8]}",
)
