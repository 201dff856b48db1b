"""The proportions of a vehicle body, drawn from distributions for its type."""

from dataclasses import dataclass

import numpy as np

ARCH_GAP = 0.042  # m, between tyre and arch


@dataclass(frozen=True)
class Form:
    """Lines of a body. Vehicle frame (x forward, y left, z up, origin on the ground under the centre), m."""

    body: str  # one of `vehicles.classes.BODIES`
    length: float  # overall, without mirrors
    width: float
    height: float
    rear_axle: float  # x
    front_axle: float
    wheel_radius: float  # outer radius of the tyres
    sill: float  # z of the lower edge
    belt: float  # z of the side windows' lower edge
    nose: float  # z of the bonnet's front edge
    deck: float  # z of the body's upper edge at the tail
    cowl: float  # x of the windscreen's lower edge, at its corners; `header`: of the upper one
    header: float
    roof_end: float  # x of the rear window's upper edge (the cab's, for a pick-up), at its corners; `glass_end`: lower
    glass_end: float
    screen_bow: float  # bulge of the windscreen in plan; `rear_bow`: of the rear window
    rear_bow: float
    tumblehome: float  # inward lean of the side windows
    crown: float  # height of the middle of the roof above its edges
    roof_drop: tuple[float, float]  # of the roof's edge, from its top to the header and to its rear end
    nose_depth: float  # length of the rounding of the plan at either end
    tail_depth: float
    nose_power: float  # exponents of that rounding (superellipse); 2 is round, 4 boxy
    tail_power: float
    doors: int  # per side, 1 or 2
    side_windows: int  # panes per side, from the front; the others are sheet metal
    variety: tuple[float, ...]  # (8,) in [0, 1], for choices of trim

    @property
    def arch_radius(self) -> float:
        return self.wheel_radius + ARCH_GAP

    @property
    def pillar(self) -> float:
        share = 0.44 if self.doors == 1 else 0.47
        if self.body == "pickup":
            share = 0.40
        rear = max(self.glass_end, self.rear_axle)
        return rear + share * (self.cowl - 0.25 - rear)


# By body: overhangs front and rear (of the length); wheel radius, sill (m); belt, nose, deck (of the height);
# windscreen corner from the nose (of the length), its run to the header (m); rear window: lower and upper edge
# from the tail (m).
_USUAL: dict[str, tuple[float, ...]] = {
    "hatchback": (0.190, 0.165, 0.310, 0.205, 0.640, 0.505, 0.680, 0.290, 0.78, 0.30, 0.50),
    "sedan": (0.182, 0.215, 0.328, 0.195, 0.645, 0.505, 0.690, 0.300, 0.82, 0.60, 1.26),
    "estate": (0.186, 0.220, 0.325, 0.195, 0.640, 0.500, 0.675, 0.300, 0.82, 0.30, 0.58),
    "suv": (0.192, 0.188, 0.360, 0.270, 0.640, 0.545, 0.660, 0.300, 0.74, 0.31, 0.52),
    "van": (0.190, 0.190, 0.330, 0.215, 0.605, 0.490, 0.620, 0.262, 0.78, 0.22, 0.30),
    "pickup": (0.175, 0.225, 0.385, 0.350, 0.650, 0.580, 0.620, 0.295, 0.62, 1.66, 1.78),
}


def draw_form(body: str, segment: str, size: tuple[float, float, float], rng: np.random.Generator) -> Form:
    length, width, height = size
    usual = np.array(_USUAL[body])
    delivery = body == "van" and segment == "N1"
    if delivery:  # a boxy nose, with the driver right behind it
        usual[[4, 5, 6, 7, 8]] = [0.590, 0.490, 0.600, 0.215, 0.72]
    drawn = usual * (1.0 + np.clip(rng.normal(0.0, 0.022, len(usual)), -0.045, 0.045))
    front, rear, wheel, sill, belt, nose, deck, cowl, rake, glass_end, roof_end = drawn.tolist()
    if body == "hatchback":  # small hatchbacks have their wheels at the corners
        shrink = np.clip((length - 3.45) / 0.9, 0.0, 1.0)
        front, rear = front - 0.03 * (1 - shrink), rear - 0.015 * (1 - shrink)
        cowl, wheel = cowl - 0.025 * (1 - shrink), wheel - 0.018 * (1 - shrink)
    wheel *= 1.0 + 0.25 * (length / {"pickup": 5.3, "van": 4.7}.get(body, 4.5) - 1.0)
    half = length / 2
    variety = rng.random(8)
    boxy = {"van": 1.1, "suv": 0.5, "pickup": 0.7}.get(body, 0.0)
    header = half - cowl * length - rake
    side_windows = 3 if body in ("estate", "suv", "van") or (body == "hatchback" and variety[0] < 0.55) else 2
    if delivery and variety[0] < 0.6:  # a panel van
        side_windows = 1
    return Form(
        body=body,
        length=length,
        width=width,
        height=height,
        rear_axle=-half + rear * length,
        front_axle=half - front * length,
        wheel_radius=wheel,
        sill=sill,
        belt=belt * height,
        nose=nose * height,
        deck=deck * height,
        cowl=half - cowl * length,
        header=header,
        roof_end=-half + roof_end,
        glass_end=-half + glass_end,
        screen_bow=0.20 + 0.06 * float(rng.random()),
        rear_bow=0.02 if body == "pickup" else (0.06 if delivery else 0.12),
        tumblehome={"van": 0.10 if delivery else 0.15, "suv": 0.175, "pickup": 0.16}.get(body, 0.20),
        crown=0.05,
        roof_drop=(0.055, {"van": 0.025, "estate": 0.07, "suv": 0.06, "pickup": 0.03}.get(body, 0.085)),
        nose_depth=min(front * length - wheel - ARCH_GAP - 0.03, 0.48),
        tail_depth=min(rear * length - wheel - ARCH_GAP - 0.03, 0.40),
        nose_power=2.05 + 0.5 * boxy + 0.25 * float(rng.random()),
        tail_power=2.2 + 0.9 * boxy + 0.3 * float(rng.random()),
        doors=1 if body == "hatchback" and length < 4.0 and rng.random() < 0.3 else 2,
        side_windows=side_windows,
        variety=tuple(variety.tolist()),
    )
