"""How a sighting fades: exp(-x), in arithmetic that is the same wherever it is compiled into."""

import math

import numpy as np
from numba import njit

_LOG2_E = 1.4426950408889634
# ln 2 in two parts, the first with trailing zeros, so that its products with small whole numbers are exact.
_LN2_HIGH = 6.93147180369123816490e-01
_LN2_LOW = 1.90821492927058770002e-10
_LARGEST = 700.0
_BIAS, _MANTISSA_BITS = 1023, 52
_1, _2, _3, _4, _5, _6, _7, _8, _9, _10, _11, _12 = (1.0 / math.factorial(n) for n in range(1, 13))


@njit(cache=True, inline="always")
def fading(x: float) -> float:
    """exp(-x) for x >= 0, to the last place or two.

    A library's exponential may be another one in a loop than alone; this one is plain arithmetic, so a batch and a
    single search agree to the bit, and loops over slots become vector instructions.
    """
    x = min(x, _LARGEST)
    k = math.floor(0.5 - x * _LOG2_E)
    r = (-x - k * _LN2_HIGH) - k * _LN2_LOW
    p = _8 + r * (_9 + r * (_10 + r * (_11 + r * _12)))
    p = _4 + r * (_5 + r * (_6 + r * (_7 + r * p)))
    p = 1.0 + r * (_1 + r * (_2 + r * (_3 + r * p)))
    # 2**k, written down as the bits of a float64.
    power: float = np.int64((np.int64(k) + _BIAS) << _MANTISSA_BITS).view(np.float64)
    return p * power
