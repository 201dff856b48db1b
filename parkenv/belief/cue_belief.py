"""The belief about cars that are about to leave.

A taken slot whose car leaves at the rate μ is a chain of two states: not announced, and, from the rate μ on, announced,
from which the car leaves at ν = μ + 1/lead. Of all taken slots a part μ/ν is announced. A cue tells how far the
probability x of "taken and announced" is above that, x - p·μ/ν, the *excess*. It decays at ν, and with the rate of
decay κ = λ + μ of the slot itself (`slot_belief`), P(free) is above what it would be without the cue by

    ν·excess·(exp(-κt) - exp(-νt)) / (ν - κ).
"""

import math

from parkenv.compiled.jit import compiled

MOST_EVIDENCE = 20.0  # of an observation, logarithm of a ratio of likelihoods


@compiled(inline="always")
def freed(excess: float, rate: float, decay_rate: float, elapsed: float) -> float:
    """Return how much P(free) is above that without cues, `elapsed` s after an observation that left an excess.

    Args:
        excess: as above.
        rate: ν, 1/s.
        decay_rate: κ, 1/s.
        elapsed: s.

    Examples:
        >>> [round(freed(0.99, 1 / 30, 1 / 600, t), 3) for t in (0.0, 30.0, 100.0, 1e4)]
        [0.0, 0.608, 0.845, 0.0]
    """
    gap = rate - decay_rate
    if abs(gap) < 1e-6 * rate:
        return float(excess * rate * elapsed * math.exp(-rate * elapsed))
    return float(excess * rate * (math.exp(-decay_rate * elapsed) - math.exp(-rate * elapsed)) / gap)
