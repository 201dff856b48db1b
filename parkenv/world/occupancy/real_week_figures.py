"""Figures of the week of real car parks.

`OCCUPIED` and `LEVELS` are derived from hourly counts of free places of 54 German car parks (38 to 1,059 places), 2023
and 2024, collected from the public pages of the cities. The terms of these sources are not settled, so the counts
themselves are not part of this package; the figures are medians over car parks and years:
`parkenv occupancy fit COUNTS.csv.gz` writes them into its summary (`typical_week`).

`PULL` and `UNEVENNESS` have the spread between the slots of CNRPark-EXT at equal hours, a standard deviation of 1.18
logits as `parkenv occupancy fit` estimates it (164 slots in Pisa; Amato et al., ODbL 1.0). That log has no positions:
how much of the spread is due to the walk is assumed.
"""

import numpy as np

# Percent taken at the end of each hour in the car park of median level, Monday to Sunday.
OCCUPIED = np.array(
    [
        *(19, 20, 21, 19, 19, 21, 24, 35, 44, 51, 59, 60, 59, 57, 55, 53, 49, 44, 40, 34, 31, 27, 25, 25),
        *(23, 24, 24, 19, 22, 21, 27, 37, 47, 57, 63, 64, 62, 61, 59, 56, 52, 47, 43, 38, 33, 29, 26, 25),
        *(25, 27, 25, 18, 25, 24, 27, 38, 48, 56, 63, 64, 64, 61, 58, 54, 51, 48, 45, 40, 36, 32, 27, 27),
        *(24, 26, 26, 21, 25, 26, 28, 37, 47, 55, 61, 63, 62, 60, 59, 57, 53, 50, 45, 40, 35, 32, 28, 26),
        *(25, 25, 25, 21, 25, 23, 26, 35, 44, 53, 58, 61, 60, 56, 54, 53, 52, 51, 51, 49, 44, 43, 33, 27),
        *(26, 25, 26, 21, 26, 27, 24, 26, 29, 35, 50, 60, 65, 65, 68, 66, 62, 60, 57, 55, 48, 47, 38, 28),
        *(25, 25, 24, 20, 20, 25, 23, 25, 23, 25, 27, 27, 28, 29, 31, 31, 30, 30, 29, 28, 24, 22, 21, 19),
    ]
)
# Logits above that week of the car park that is fuller than each of `LEVEL_SHARES` of all.
LEVELS = (-1.65, -0.98, -0.40, 0.00, 0.38, 1.01, 1.87)
# Share of car parks that a lot is fuller than, by default: drivers search for a space where few are left.
FULLER_THAN = 0.9
# Logits by which demand rises from the middle to the goal, and standard deviation between equally near slots.
PULL, UNEVENNESS = 1.75, 0.6
# Standard deviation of a weekday's level around the week of its own car park, logits, in the fuller half of them.
DAY_ERROR = 0.7
