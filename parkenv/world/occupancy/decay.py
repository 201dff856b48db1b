"""The decay of an observation: exp(-x), with the same result wherever it is compiled."""

import math

import numpy as np

from parkenv.compiled.jit import compiled

_LOG2_E = 1.4426950408889634
# ln 2 in two parts, the first with trailing zeros, so that its products with small whole numbers are exact.
_LN2_HIGH = 6.93147180369123816490e-01
_LN2_LOW = 1.90821492927058770002e-10
_LARGEST = 700.0
_BIAS, _MANTISSA_BITS = 1023, 52
# A float64 near this has no room for a fraction: adding it rounds, and leaves the whole number in the last bits.
_ROUNDING = 1.5 * 2.0**_MANTISSA_BITS
_2, _3, _4, _5, _6, _7, _8, _9, _10, _11, _12 = (1.0 / math.factorial(n) for n in range(2, 13))


@compiled(inline="always")
def decay_factor(x: float) -> float:
    """exp(-x) for x >= 0, to the last place or two.

    A library may use a different exponential inside a loop than outside. This one is plain arithmetic, so a batch and
    a single search agree to the bit, and loops over slots become vector instructions.
    """
    x = min(x, _LARGEST)
    rounded = _ROUNDING - x * _LOG2_E
    k = rounded - _ROUNDING
    r = (-x - k * _LN2_HIGH) - k * _LN2_LOW
    # Estrin's scheme for the series of exp(r): pairs of terms are independent, unlike in Horner's scheme.
    r2 = r * r
    r4 = r2 * r2
    low = (_2 + r * _3) + r2 * (_4 + r * _5)
    high = (_6 + r * _7) + r2 * (_8 + r * _9) + r4 * ((_10 + r * _11) + r2 * _12)
    p = 1.0 + (r + r2 * (low + r4 * high))
    # 2**k from the bits of a float64.
    power: float = np.int64((np.float64(rounded).view(np.int64) + _BIAS) << _MANTISSA_BITS).view(np.float64)
    return p * power
