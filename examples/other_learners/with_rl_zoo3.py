"""PPO of rl-zoo3 by its own command and the settings in `ppo.yml`: `python with_rl_zoo3.py SCENARIO DECISIONS`.

Its best model goes to `rl_zoo3.safetensors`, the agent `ppo:rl_zoo3.safetensors`.
"""

import runpy
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from held_out import tell
from stable_baselines3 import PPO

from parkenv.envs.flat_ids import LOTS
from parkenv.envs.sb3 import SearchVecEnv
from planners.model_file import save_model

SCENARIO, DECISIONS = sys.argv[1], int(sys.argv[2])
TRAINED_ON = LOTS if SCENARIO == "all" else [SCENARIO]
SETTINGS = Path(__file__).with_name("ppo.yml")

with TemporaryDirectory() as folder:
    options = (f"scenario:{TRAINED_ON}", "observation:'local'", "reward_scale:0.01", "max_episode_steps:500")
    sys.argv = [
        "rl_zoo3.train", "--algo", "ppo", "--env", "parkenv/Search-v2", "--gym-packages", "parkenv", "--conf-file",
        str(SETTINGS), "--env-kwargs", *options, "-n", str(DECISIONS), "--eval-freq", str(max(DECISIONS // 10, 1)),
        "--eval-episodes", "100", "--n-eval-envs", "10", "--seed", "0", "--num-threads", "1", "--device", "cpu",
        "-f", folder,
    ]  # fmt: skip
    runpy.run_module("rl_zoo3.train", run_name="__main__")
    (best,) = Path(folder).glob("ppo/*/best_model.zip")
    model = PPO.load(best, SearchVecEnv(1, TRAINED_ON), device="cpu")
command = ("with_rl_zoo3.py", SCENARIO, str(DECISIONS))
save_model(model, "rl_zoo3.safetensors", scenarios=TRAINED_ON, command=command)

tell(
    "rl_zoo3",
    DECISIONS,
    lambda observation: int(model.predict(observation, deterministic=True)[0]),
    SCENARIO,
    flat=False,
)
