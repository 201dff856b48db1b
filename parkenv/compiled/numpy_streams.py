"""NumPy's default random numbers in compiled code: `default_rng(words)` and some of its draws, bit for bit.

Making one generator takes NumPy 20 µs; here it takes a tenth of one. The algorithms are O'Neill's seed sequence and
PCG64 (XSL-RR), Lemire's bounded integers, and Marsaglia and Tsang's ziggurat with NumPy's tables.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba.np.random import _constants
from numpy.typing import NDArray

from parkenv.compiled.jit import compiled

POOL = 4  # words of a seed sequence's pool

_KI = np.array(_constants.ki_double, dtype=np.uint64)
_WI = np.array(_constants.wi_double, dtype=np.float64)
_FI = np.array(_constants.fi_double, dtype=np.float64)
_TAIL = float(_constants.ziggurat_nor_r)
_INVERSE_TAIL = float(_constants.ziggurat_nor_inv_r)

_U32 = np.uint32
_U64 = np.uint64
_INIT_A, _MULT_A = _U32(0x43B0D7E5), _U32(0x931E8875)
_INIT_B, _MULT_B = _U32(0x8B51F9DD), _U32(0x58F38DED)
_MIX_LEFT, _MIX_RIGHT = _U32(0xCA01F9DD), _U32(0x4973F715)
_HALF_WORD = _U32(16)
_FACTOR_HIGH, _FACTOR_LOW = _U64(2549297995355413924), _U64(4865540595714422341)
_LOW_WORD = _U64(0xFFFFFFFF)
_ONE, _BYTE, _MANTISSA = _U64(1), _U64(0xFF), _U64(0x000FFFFFFFFFFFFF)

plain = compiled(error_model="numpy", _nrt=False)


@plain
def append_words(words: NDArray[np.uint32], n: int, value: np.uint64) -> int:
    """Append an integer to a seed as NumPy does, in as many words as it needs; return the new number of words."""
    words[n] = _U32(value & _LOW_WORD)
    if value > _LOW_WORD:
        words[n + 1] = _U32(value >> _U64(32))
        return n + 2
    return n + 1


@plain
def _hashed(value: np.uint32, constant: np.uint32, factor: np.uint32) -> tuple[np.uint32, np.uint32]:
    value = _U32(value ^ constant)
    constant = _U32(constant * factor)
    value = _U32(value * constant)
    return _U32(value ^ _U32(value >> _HALF_WORD)), constant


@plain
def _mixed(x: np.uint32, y: np.uint32) -> np.uint32:
    result = _U32(_U32(_MIX_LEFT * x) - _U32(_MIX_RIGHT * y))
    return _U32(result ^ _U32(result >> _HALF_WORD))


@plain
def fill_pool(words: NDArray[np.uint32], n: int, pool: NDArray[np.uint32]) -> None:
    """Mix the first n words of a seed into a pool of four, as `numpy.random.SeedSequence` does."""
    constant = _INIT_A
    for i in range(POOL):
        pool[i], constant = _hashed(words[i] if i < n else _U32(0), constant, _MULT_A)
    for source in range(POOL):
        for target in range(POOL):
            if source != target:
                value, constant = _hashed(pool[source], constant, _MULT_A)
                pool[target] = _mixed(pool[target], value)
    for i in range(POOL, n):
        for target in range(POOL):
            value, constant = _hashed(words[i], constant, _MULT_A)
            pool[target] = _mixed(pool[target], value)


@plain
def first_word(pool: NDArray[np.uint32]) -> np.uint32:
    """Return `generate_state(1)[0]` of the pool's seed sequence."""
    value: np.uint32 = _hashed(pool[0], _INIT_B, _MULT_B)[0]
    return value


@plain
def start(pool: NDArray[np.uint32], state: NDArray[np.uint64]) -> None:
    """Start the generator of a pool: `state`, (5,) uint64, holds its state, its increment and a half."""
    constant = _INIT_B
    for i in range(POOL):
        low, constant = _hashed(pool[2 * i % POOL], constant, _MULT_B)
        high, constant = _hashed(pool[(2 * i + 1) % POOL], constant, _MULT_B)
        state[i] = (_U64(high) << _U64(32)) | _U64(low)
    seed_high, seed_low = state[0], state[1]
    state[2] = (state[2] << _ONE) | (state[3] >> _U64(63))
    state[3] = (state[3] << _ONE) | _ONE
    # From state 0 a step leads to the increment.
    state[1] = state[3] + seed_low
    state[0] = state[2] + seed_high + (_ONE if state[1] < seed_low else _U64(0))
    _step(state)
    state[4] = _U64(0)


@plain
def _step(state: NDArray[np.uint64]) -> None:
    """Multiply the 128-bit state and add the increment."""
    high, low = state[0], state[1]
    a0, a1 = low & _LOW_WORD, low >> _U64(32)
    b0, b1 = _FACTOR_LOW & _LOW_WORD, _FACTOR_LOW >> _U64(32)
    middle = a1 * b0 + ((a0 * b0) >> _U64(32))
    other = a0 * b1 + (middle & _LOW_WORD)
    carried = a1 * b1 + (middle >> _U64(32)) + (other >> _U64(32))
    product = low * _FACTOR_LOW
    carried += high * _FACTOR_LOW + low * _FACTOR_HIGH
    state[1] = product + state[3]
    state[0] = carried + state[2] + (_ONE if state[1] < product else _U64(0))


@plain
def next_64(state: NDArray[np.uint64]) -> np.uint64:
    """Return the next 64 random bits."""
    _step(state)
    mixed, turn = state[0] ^ state[1], state[0] >> _U64(58)
    value: np.uint64 = (mixed >> turn) | (mixed << ((_U64(64) - turn) & _U64(63)))
    return value


@plain
def next_32(state: NDArray[np.uint64]) -> np.uint64:
    """Return the next 32 random bits: the low half of 64, then the high one."""
    if state[4] != _U64(0):
        kept: np.uint64 = state[4] & _LOW_WORD
        state[4] = _U64(0)
        return kept
    both = next_64(state)
    state[4] = (both >> _U64(32)) | (_ONE << _U64(32))
    low: np.uint64 = both & _LOW_WORD
    return low


@plain
def integer_below(state: NDArray[np.uint64], n: int) -> np.int64:
    """Return `Generator.integers(n)`, n from 1 to 2^32 - 1."""
    if n == 1:
        return np.int64(0)
    span = _U64(n)
    product = next_32(state) * span
    if (product & _LOW_WORD) < span:
        least = (_U64(0x100000000) - span) % span
        while (product & _LOW_WORD) < least:
            product = next_32(state) * span
    return np.int64(product >> _U64(32))


@plain
def unit(state: NDArray[np.uint64]) -> float:
    """Return `Generator.random()`."""
    return float(next_64(state) >> _U64(11)) * (1.0 / 9007199254740992.0)


@plain
def normal(state: NDArray[np.uint64]) -> float:
    """Return `Generator.standard_normal()`."""
    while True:
        bits = next_64(state)
        layer = bits & _BYTE
        bits >>= _U64(8)
        negative = bits & _ONE
        place = (bits >> _ONE) & _MANTISSA
        x: float = float(place) * _WI[layer]
        x = -x if negative else x
        if place < _KI[layer]:
            return x
        if layer == _U64(0):
            while True:
                beyond = -_INVERSE_TAIL * math.log1p(-unit(state))
                other = -math.log1p(-unit(state))
                if other + other > beyond * beyond:
                    far: float = _TAIL + beyond
                    return -far if (place >> _U64(8)) & _ONE else far
        elif (_FI[layer - _ONE] - _FI[layer]) * unit(state) + _FI[layer] < math.exp(-0.5 * x * x):
            return x


def generator_state(*words: int) -> Any:
    """Return the state of `numpy.random.default_rng(words)` for the functions above, (5,) uint64."""
    seed, n, pool = np.zeros(2 * len(words), np.uint32), 0, np.zeros(POOL, np.uint32)
    for word in words:
        n = append_words(seed, n, np.uint64(word))
    state = np.zeros(5, np.uint64)
    fill_pool(seed, n, pool)
    start(pool, state)
    return state
