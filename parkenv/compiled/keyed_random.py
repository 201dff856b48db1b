"""Random numbers that are a pure function of (key, stream, slot, index).

Draws are stateless, so a world does not depend on which slots are observed, or in which order.
The mixing function is the finaliser of SplitMix64 (Steele, Lea, Flood, "Fast splittable pseudorandom number
generators", OOPSLA 2014), applied once for each of stream, slot and index.
"""

import math
import zlib

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.jit import compiled
from parkenv.errors import require_whole

# One stream for each purpose, so that their numbers are independent.
ARRIVAL_STREAM = 0
OCCUPANCY_STREAM = 1
ENTRY_STREAM = 2
OBSERVATION_STREAM = 3
VIEW_STREAM = 4
DAY_STREAM = 5
SCENARIO_STREAM = 6
# Streams of the cars of a fleet, numbered by the car instead of the slot.
HEADWAY_STREAM = 7
STAY_STREAM = 8
PATIENCE_STREAM = 9
GOAL_STREAM = 10
KIND_STREAM = 11
POLICY_STREAM = 12
CLASS_STREAM = 13
SLOT_STREAM = 14
LEAD_STREAM = 15
CUE_STREAM = 16
LEAVING_STREAM = 17

_WORD_BITS = 64
_WORD = (1 << _WORD_BITS) - 1
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_SHIFT_30 = np.uint64(30)
_SHIFT_27 = np.uint64(27)
_SHIFT_31 = np.uint64(31)
_SHIFT_12 = np.uint64(12)


@compiled
def _mix64(word: np.uint64) -> np.uint64:
    z = np.uint64(word)
    z = (z ^ (z >> _SHIFT_30)) * _MIX_1
    z = (z ^ (z >> _SHIFT_27)) * _MIX_2
    return z ^ (z >> _SHIFT_31)


@compiled(inline="always")
def keyed_uniform(key: np.uint64, stream: int, slot: int, index: int) -> float:
    """Uniform float64 in the open interval (0, 1), callable from Python and from compiled code.

    `key` comes from `world_key`; `stream`, `slot` and `index` are 64-bit integers; negative ones are further streams.
    """
    # Cast here, so that the function below is compiled once and not for each constant argument; and all to uint64,
    # because uint64 with int64 would be promoted to float64.
    u: float = _uniform(np.uint64(key), np.uint64(stream), np.uint64(slot), np.uint64(index))
    return u


@compiled
def _uniform(key: np.uint64, stream: np.uint64, slot: np.uint64, index: np.uint64) -> float:
    h = _mix64(key + _GOLDEN * stream)
    h = _mix64(h + _GOLDEN * slot)
    h = _mix64(h + _GOLDEN * index)
    # 52 bits plus a half: the result is never 0 or 1.
    return (float(h >> _SHIFT_12) + 0.5) * 2.0**-52


@compiled
def keyed_exponential(key: np.uint64, stream: int, slot: int, index: int) -> float:
    """Exponential float64 with mean 1, always positive and finite; arguments as in `keyed_uniform`."""
    return -math.log(keyed_uniform(key, stream, slot, index))


@compiled
def _absorbed(state: np.uint64, word: np.uint64) -> np.uint64:
    mixed: np.uint64 = _mix64(np.uint64(state) + _GOLDEN + np.uint64(word))
    return mixed


@compiled
def episode_key(seed_state: np.uint64, episode: int) -> np.uint64:
    """Return the key of a world, from `seed_state` and an episode number below 2**64."""
    # Absorb the number of words first, so that no two (seed, episode) pairs give the same sequence of words.
    key: np.uint64 = _absorbed(_absorbed(seed_state, np.uint64(1)), np.uint64(episode))
    return key


@compiled
def car_key(world: np.uint64, car: int) -> np.uint64:
    """Return the key of a car's own random numbers, such as its sensor's errors; the first car's is the world's."""
    if car == 0:
        return world
    key: np.uint64 = _absorbed(world, np.uint64(car))
    return key


@compiled
def car_uniforms(world: np.uint64, stream: int, values: NDArray[np.float64]) -> None:
    """Fill an array with the uniform numbers of the cars, index 0 of the stream each."""
    for i in range(len(values)):
        values[i] = keyed_uniform(world, stream, i, 0)


def named_key(key: np.uint64, name: str) -> np.uint64:
    """Return the key of what has a name within a world, such as a purpose: another one for each name."""
    return np.uint64(_absorbed(np.uint64(key), np.uint64(zlib.crc32(name.encode()) + (1 << 32))))


def seed_state(seed: int) -> np.uint64:
    """Return the state after mixing a seed, a non-negative integer of any size, before the episode number."""
    return _with_words(np.uint64(0), "seed", seed)


def world_key(seed: int, episode: int) -> np.uint64:
    """Mix a seed and an episode number, non-negative integers of any size, into the key of one world.

    >>> len({world_key(0, 1), world_key(0, 1), world_key(1, 0)})
    2
    """
    return _with_words(seed_state(seed), "episode", episode)


def _with_words(state: np.uint64, name: str, given: int) -> np.uint64:
    require_whole(name, given)
    number = int(given)
    n_words = max(1, -(-number.bit_length() // _WORD_BITS))
    for word in (n_words, *((number >> (_WORD_BITS * i)) & _WORD for i in range(n_words))):
        state = np.uint64(_absorbed(state, np.uint64(word)))
    return state
