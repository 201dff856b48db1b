"""Tariffs: what parking in each zone of a lot costs, by the length of the stay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, nearest, require_number

NO_ZONE = "other"
"""Zone of the slots for which a lot names none."""
VALUE_OF_TIME = 12.0
"""Default value of an hour of a driver's time, in the currency of the prices.

The US Department of Transportation values local personal travel at half of the household income: 13.60 dollars of 2015,
12.3 euros (Revised Departmental Guidance on Valuation of Travel Time in Economic Analysis, 2016).
"""
HOUR_S = 3600.0


@dataclass(frozen=True)
class Tariff:
    """A price per hour for each zone.

    Args:
        per_hour: price of an hour by zone, at least 0, in any currency; zones without a price are free.

    Raises:
        InputError: a price is no number of at least 0.

    Examples:
        >>> Tariff({"centre": 2.0}).amounts(["centre", "ring"], np.array([1800.0, 3600.0])).tolist()
        [[1.0, 0.0], [2.0, 0.0]]
    """

    per_hour: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for zone, price in self.per_hour.items():
            require_number(f"price of zone {zone!r:.40}", price, least=0.0)
        object.__setattr__(self, "per_hour", MappingProxyType(dict(self.per_hour)))

    def __bool__(self) -> bool:
        """Whether there are prices, be they 0."""
        return bool(self.per_hour)

    def __reduce__(self) -> tuple[type[Tariff], tuple[dict[str, float]]]:
        return Tariff, (dict(self.per_hour),)

    def amounts(self, zones: Sequence[str], stay_s: FloatArray | float) -> FloatArray:
        """Return what stays cost in each zone, (..., n_zones) in the currency.

        Args:
            zones: names of the zones.
            stay_s: (...) s, lengths of the stays.
        """
        per_hour = np.array([self.per_hour.get(zone, 0.0) for zone in zones])
        # A stay for ever is free where an hour is.
        with np.errstate(invalid="ignore"):
            return np.where(per_hour > 0.0, np.multiply.outer(np.asarray(stay_s) / HOUR_S, per_hour), 0.0)

    def require_zones(self, zones: Sequence[str], lot: str) -> None:
        """Check that a lot has every zone with a price.

        Raises:
            InputError: it does not; the message names the nearest zone.
        """
        for zone in self.per_hour:
            if zone not in zones:
                raise InputError(f"price: lot {lot!r:.40} has no zone {zone!r:.40}; {nearest(zone, zones)}")
