"""Vehicle classes: bodies, market segments with their sizes, and paints.

No law defines the sizes of segments (the European Commission only names them, case COMP/M.1406). Lengths follow common
tables, limited to models on the market:

- A to F, *Euro Car Segment*, Wikipedia: A 2.7-3.7 m, B 3.7-4.2, C 4.2-4.6, D 4.6-4.8, E 4.8-5.0.
- SUVs, *Subcompact*, *Compact* and *Mid-size crossover SUV*, Wikipedia: below 4.4 m (JB), 4.4-4.7 (JC), 4.7-5.1 (JD
  and JE). JC and JD begin 5 and 10 cm lower, for older cars: a Nissan Qashqai has 4.31 m in 2007, 4.43 m in 2021.
- People carriers, *Compact MPV* and *Minivan*, Wikipedia: 4.2-4.6 m (MC; those with seven seats 4.3-4.6), 1.6-1.8 m
  tall; large ones (MD) are about as long as a car of segment D.
- Vans that park among cars (N1) are the short ones of the medium class; no table is known, so sizes are those that the
makers of the two models below publish.
- Pick-ups: most double cabs of the mid-size class have 5.2 to 5.4 m (CarExpert, *Ute tray dimensions detailed*).

Widths, without mirrors, and heights span the makers' data for the models below, of generations from about 2010 to 2020
(a BMW X5 of 2013: 1.94 m × 1.76 m). Check: JATO Dynamics gives the mean new car in Europe as 4.42 m × 1.80 m in 2013
and 4.53 m × 1.84 m in 2023.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

BODIES = ("hatchback", "sedan", "estate", "suv", "van", "pickup")  # body types

# How common each of `BODIES` is in a lot: a European fleet of about 2020, hatchbacks first, SUVs rising.
BODY_SHARE = (0.37, 0.11, 0.16, 0.24, 0.10, 0.02)


class SizeClass(NamedTuple):
    segment: str
    share: float
    length: tuple[float, float]
    width: tuple[float, float]
    height: tuple[float, float]


# Segments of each body.
SIZE_CLASSES: dict[str, tuple[SizeClass, ...]] = {
    "hatchback": (
        SizeClass("A", 0.20, (3.45, 3.70), (1.60, 1.68), (1.46, 1.54)),  # Fiat 500, VW up!, Kia Picanto
        SizeClass("B", 0.45, (3.80, 4.15), (1.67, 1.80), (1.42, 1.53)),  # VW Polo, Renault Clio, Opel Corsa
        SizeClass("C", 0.35, (4.20, 4.45), (1.76, 1.83), (1.42, 1.50)),  # VW Golf, Ford Focus, Opel Astra
    ),
    "sedan": (
        SizeClass("C", 0.30, (4.45, 4.65), (1.77, 1.82), (1.42, 1.48)),  # Audi A3, Toyota Corolla sedan
        SizeClass("D", 0.45, (4.60, 4.85), (1.80, 1.85), (1.41, 1.48)),  # BMW 3, Audi A4, VW Passat
        SizeClass("E", 0.20, (4.85, 5.00), (1.84, 1.90), (1.44, 1.49)),  # BMW 5, Mercedes E, Audi A6
        SizeClass("F", 0.05, (5.05, 5.25), (1.88, 1.92), (1.46, 1.51)),  # Mercedes S, BMW 7
    ),
    "estate": (
        SizeClass("C", 0.50, (4.50, 4.69), (1.77, 1.83), (1.45, 1.51)),  # VW Golf Variant, Skoda Octavia
        SizeClass("D", 0.40, (4.65, 4.88), (1.80, 1.86), (1.43, 1.52)),  # VW Passat Variant, BMW 3 Touring
        SizeClass("E", 0.10, (4.88, 5.00), (1.84, 1.90), (1.46, 1.52)),  # Volvo V90, Audi A6 Avant
    ),
    "suv": (
        SizeClass("JB", 0.35, (4.05, 4.30), (1.75, 1.82), (1.52, 1.65)),  # VW T-Roc, Renault Captur
        SizeClass("JC", 0.42, (4.35, 4.60), (1.80, 1.87), (1.60, 1.70)),  # VW Tiguan, Nissan Qashqai
        SizeClass("JD", 0.18, (4.60, 4.80), (1.86, 1.92), (1.62, 1.72)),  # Volvo XC60, BMW X3
        SizeClass("JE", 0.05, (4.85, 5.10), (1.92, 1.98), (1.70, 1.80)),  # VW Touareg, BMW X5
    ),
    "van": (
        SizeClass("MC", 0.50, (4.35, 4.60), (1.79, 1.86), (1.63, 1.84)),  # VW Touran, Citroën Berlingo
        SizeClass("MD", 0.20, (4.70, 4.90), (1.84, 1.92), (1.68, 1.78)),  # VW Sharan, Ford Galaxy
        SizeClass("N1", 0.30, (4.90, 5.20), (1.89, 1.96), (1.88, 1.99)),  # VW Transporter, Mercedes Vito
    ),
    "pickup": (SizeClass("N1", 1.0, (5.20, 5.40), (1.80, 1.92), (1.74, 1.86)),),  # Toyota Hilux, Ford Ranger
}


class Paint(NamedTuple):
    name: str
    share: float
    color: tuple[int, int, int]
    spread: tuple[int, int, int]


# Shares after Axalta's Global Automotive Color Popularity Report, 2019 to 2021: white, black, grey and silver
# together near 80 %; in Europe grey 27 % of new cars, black 22 %, blue about 10 %. A fleet is older than what is
# sold, so some of today's grey is still silver. Colours are sRGB, 0 to 255.
PAINTS = (
    Paint("white", 0.24, (226, 227, 226), (10, 10, 10)),
    Paint("black", 0.21, (22, 23, 25), (8, 8, 9)),
    Paint("grey", 0.20, (92, 95, 99), (22, 22, 22)),
    Paint("silver", 0.14, (164, 167, 170), (14, 14, 14)),
    Paint("blue", 0.09, (32, 54, 104), (18, 22, 34)),
    Paint("red", 0.06, (142, 22, 26), (24, 10, 10)),
    Paint("green", 0.02, (38, 66, 52), (14, 16, 14)),
    Paint("brown", 0.02, (92, 76, 62), (16, 14, 12)),
    Paint("yellow", 0.01, (205, 164, 32), (20, 20, 16)),
    Paint("orange", 0.01, (196, 82, 24), (20, 16, 12)),
)


def draw_body(rng: np.random.Generator) -> str:
    return BODIES[int(rng.choice(len(BODIES), p=BODY_SHARE))]


def draw_size(body: str, rng: np.random.Generator) -> tuple[str, tuple[float, float, float]]:
    """Draw a segment of a body, and length, width and height, m, within its limits.

    The dimensions are correlated, since longer cars of a class tend to be wider, and concentrate around the middle.
    """
    classes = SIZE_CLASSES[body]
    chosen = classes[int(rng.choice(len(classes), p=[c.share for c in classes]))]
    common, *own = rng.normal(0.0, 0.5, 4)
    at = np.clip(0.5 + 0.25 * (common + np.array(own)), 0.0, 1.0)
    sizes = [low + a * (high - low) for a, (low, high) in zip(at, chosen[2:], strict=True)]
    return chosen.segment, (float(sizes[0]), float(sizes[1]), float(sizes[2]))


def draw_paint(rng: np.random.Generator) -> tuple[int, int, int]:
    paint = PAINTS[int(rng.choice(len(PAINTS), p=[p.share for p in PAINTS]))]
    drawn: NDArray[np.float64] = np.array(paint.color) + np.array(paint.spread) * rng.uniform(-1.0, 1.0)
    r, g, b = np.clip(np.round(drawn + rng.uniform(-3, 3, 3)), 0, 255).astype(int).tolist()
    return r, g, b
