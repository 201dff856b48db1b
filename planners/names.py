"""Names of the agents that come with the package and of learning algorithms, without the modules behind them."""

EXPECTS_RIVALS = "belief-rivals"  # the agent with the option `arrivals_per_hour`: rivals an hour
# Module and class of each agent; modules are imported when an agent is made.
AGENTS: dict[str, tuple[str, str]] = {
    "mdp": ("planners.thesis.replanning", "ReplanningAgent"),
    "mdp-static": ("planners.thesis.replanning", "StaticAgent"),
    "greedy-goal": ("planners.heuristics.agents", "GreedyGoalAgent"),
    "greedy-drive": ("planners.heuristics.agents", "GreedyDriveAgent"),
    "greedy-total": ("planners.heuristics.agents", "GreedyTotalAgent"),
    "first-free": ("planners.heuristics.agents", "FirstFreeAgent"),
    "usual": ("planners.heuristics.agents", "UsualAgent"),
    "random": ("planners.heuristics.agents", "RandomAgent"),
    "oracle": ("planners.bounds.oracle", "OracleAgent"),
    "belief": ("planners.belief.agent", "BeliefAgent"),
    EXPECTS_RIVALS: ("planners.belief.rivals", "BeliefRivalsAgent"),
    "network": ("planners.network.agent", "NetworkAgent"),
    "mdp-tuned": ("planners.thesis.tuning", "TunedAgent"),
    "bound": ("planners.bounds.relaxation", "SearchBound"),
}
# Module and class of each learning algorithm; `ALGORITHM:FILE` names a trained model.
ALGORITHMS = {
    "dqn": ("stable_baselines3", "DQN"),
    "ppo": ("stable_baselines3", "PPO"),
    "maskable-ppo": ("sb3_contrib", "MaskablePPO"),
    "recurrent-ppo": ("sb3_contrib", "RecurrentPPO"),
}
NETWORK = "network"  # the agent whose weights can be another file: `network:FILE`
HUMAN = "human"  # the agent that repeats what a person did in a game of `parkenv play`: `human:FILE`
FILE_AGENTS = (*ALGORITHMS, NETWORK, HUMAN)  # names before the colon of `NAME:FILE`
# Agents that make no use of an occupancy forecast.
WITHOUT_FORECAST = ("greedy-goal", "greedy-drive", "greedy-total", "first-free", "random", "oracle")
BOUND = "bound"  # what no agent can beat in the mean; it drives no car
AGENT_NAMES = tuple(name for name in AGENTS if name != BOUND)
