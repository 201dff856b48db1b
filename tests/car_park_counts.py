"""A file of counts of three car parks."""

import gzip
from datetime import date, timedelta

import numpy as np
from scipy.special import expit, logit

CURVE = np.array([0.1] * 6 + [0.15, 0.3, 0.6, 0.85, 0.95, 0.97, 0.97, 0.96, 0.95, 0.9, 0.8, 0.6, 0.4, 0.3]
                 + [0.2, 0.15, 0.12, 0.1])  # fmt: skip


def write_counts(path, first=date(2024, 1, 1), days=40, change=lambda park, day, taken: taken):
    """Counts of three car parks of 100 places, one of them never used; a name that ends in .gz is packed."""
    noise = np.random.default_rng(3).normal(0.0, 0.5, (2, days))
    lines = ["car_park,capacity,hour,free"]
    for day in range(days):
        for hour, mean in enumerate(CURVE):
            moment = f"{first + timedelta(day)}T{hour:02d}:00"
            for park in range(2):
                taken = change(park, day, expit(logit(mean) + noise[park, day]))
                lines.append(f"P{park},100,{moment},{round(100 * (1 - taken))}")
            lines.append(f"empty,100,{moment},100")
    text = ("\n".join(lines) + "\n").encode()
    path.write_bytes(gzip.compress(text) if path.suffix == ".gz" else text)
    return path
