"""Laser scans a second, beside two other ways of making them, on one core: `python -m tests.bench.bench_laser`."""

import math
import time

import numpy as np
import pymunk
from numba import njit
from rich.console import Console
from rich.table import Table
from scipy.ndimage import distance_transform_edt

from sim_sensors.footprints import ScanPlane
from sim_sensors.laser import LaserScanner

SLOT_WIDTH, SLOT_LENGTH, MODULE, MARGIN = 2.5, 5.0, 16.0, 6.0
GRID_CELL = 0.05  # m, of the occupancy grid that the beam marcher walks


def lot(rng, n_cars, columns=25, corners=4):
    """A walled lot, four slots in five taken; cars 4.5 m by 1.8 m, parked as people do.

    Returns a ScanPlane, and a function that draws poses in the aisles.
    """
    modules = math.ceil(n_cars * 1.25 / (2 * columns))
    size = np.array([2 * MARGIN + SLOT_WIDTH * columns, 2 * MARGIN + MODULE * modules])
    x = MARGIN + SLOT_WIDTH * (np.arange(columns) + 0.5)
    y = np.concatenate([MARGIN + MODULE * m + np.array([2.5, 13.5]) for m in range(modules)])
    slots = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    taken = slots[rng.permutation(len(slots))[:n_cars]]
    centre = taken + rng.normal(0, [0.1, 0.15], (n_cars, 2))
    yaw = np.pi / 2 + rng.normal(0, np.radians(2), n_cars)
    half = np.column_stack([rng.normal(2.25, 0.12, n_cars), rng.normal(0.9, 0.03, n_cars)])
    outline = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]], float)
    if corners == 8:
        outline = np.array(
            [[1, 0.6], [0.8, 1], [-0.8, 1], [-1, 0.6], [-1, -0.6], [-0.8, -1], [0.8, -1], [1, -0.6]]
        )
    local = half[:, None] * outline
    turn = np.stack([np.cos(yaw), np.sin(yaw), -np.sin(yaw), np.cos(yaw)], -1).reshape(-1, 2, 2)
    room = size * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    plane = ScanPlane(local @ turn + centre[:, None], walls=np.stack([room, np.roll(room, -1, 0)], 1))

    def poses(n):
        aisle = rng.integers(0, modules, n) * MODULE + MARGIN + 8 + rng.uniform(-1.2, 1.2, n)
        along = rng.uniform(3, size[0] - 3, n)
        return np.column_stack([along, aisle, rng.choice([0, np.pi], n) + rng.normal(0, 0.2, n)])

    return plane, poses


def pymunk_scanner(plane, laser):
    space = pymunk.Space()
    corners, n_corners = plane.footprints
    for polygon, k in zip(corners, n_corners, strict=True):
        space.add(pymunk.Poly(space.static_body, polygon[:k].tolist()))
    for a, b in plane.walls.tolist():
        space.add(pymunk.Segment(space.static_body, a, b, 0.0))
    everything, reach = pymunk.ShapeFilter(), laser.max_range

    def scan(pose):
        x, y, yaw = map(float, pose)
        ranges = np.full(laser.n_beams, np.inf)
        for i, angle in enumerate((yaw + laser.angles).tolist()):
            end = (x + reach * math.cos(angle), y + reach * math.sin(angle))
            hit = space.segment_query_first((x, y), end, 0.0, everything)
            if hit is not None:
                ranges[i] = hit.alpha * reach
        return ranges

    return scan


@njit(cache=True)
def _march(clearance, cell, x, y, cos, sin, max_range, ranges):
    """Step along each beam by the distance to the nearest taken cell until there is none to step."""
    rows, columns = clearance.shape
    for i in range(len(ranges)):
        r = 0.0
        while r < max_range:
            row, column = int((y + r * sin[i]) / cell), int((x + r * cos[i]) / cell)
            if not (0 <= row < rows and 0 <= column < columns):
                r = max_range
                break
            step = clearance[row, column]
            if step == 0.0:
                break
            r += step
        ranges[i] = r if r < max_range else np.inf


def marching_scanner(plane, laser):
    """Ray marching in the distance transform of an occupancy grid, the method of the f1tenth simulator."""
    corners, n_corners = plane.footprints
    width, height = plane.walls.reshape(-1, 2).max(0)
    taken = np.zeros((int(height / GRID_CELL) + 1, int(width / GRID_CELL) + 1), bool)
    taken[[0, -1]] = taken[:, [0, -1]] = True
    for polygon, k in zip(corners, n_corners, strict=True):
        low, high = (np.floor(f(polygon[:k], 0) / GRID_CELL).astype(int) for f in (np.min, np.max))
        column, row = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
        p = (np.stack([column, row], -1) + 0.5) * GRID_CELL
        edge = np.roll(polygon[:k], -1, 0) - polygon[:k]
        off = p[:, :, None] - polygon[:k]
        inside = (edge[:, 0] * off[..., 1] - edge[:, 1] * off[..., 0] > 0).all(-1)
        taken[row, column] |= inside
    clearance = distance_transform_edt(~taken) * GRID_CELL
    ranges = np.empty(laser.n_beams)

    def scan(pose):
        angle = pose[2] + laser.angles
        _march(clearance, GRID_CELL, pose[0], pose[1], np.cos(angle), np.sin(angle), laser.max_range, ranges)
        return ranges.copy()

    return scan


def per_second(work, n, seconds=0.6):
    """Items a second of `work`, which does n: the median of its runs, the first left out."""
    work()
    times = []
    end = time.perf_counter() + seconds
    while len(times) < 3 or time.perf_counter() < end:
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return n / float(np.median(times))


def laser_rows():
    """Rows for the table of throughputs; a ratio above 1 means that ours is the faster."""
    rng = np.random.default_rng(0)
    laser = LaserScanner()
    plane, draw = lot(rng, 200)
    poses = draw(256)
    single = poses[:32]
    march, query = marching_scanner(plane, laser), pymunk_scanner(plane, laser)
    exact = np.minimum(laser.scan_batch(plane, poses[:4]), 30)
    for peer, pose_limit, tolerance in ((march, 4, 2 * GRID_CELL), (query, 2, 2e-3)):
        seen = np.minimum([peer(p) for p in poses[:pose_limit]], 30)
        if (np.abs(seen - exact[:pose_limit]) > tolerance).mean() > 0.05:
            raise AssertionError("a peer does not see what the laser sees")
    batch = per_second(lambda: laser.scan_batch(plane, poses), 256)
    marched = per_second(lambda: [march(p) for p in single], len(single))
    queried = per_second(lambda: [query(p) for p in single[:4]], 4)
    rows = []

    def row(case, value, peer, peer_value):
        rows.append(
            {
                "part": "laser",
                "case": case,
                "value": value,
                "unit": "scans/s",
                "peer": peer,
                "peer_value": peer_value,
                "ratio": value / peer_value,
            }
        )

    row("200 cars, batch of 256", batch, "beam marching in a grid", marched)
    row("200 cars, batch of 256", batch, "pymunk segment_query_first", queried)
    noisy = per_second(lambda: laser.scan_batch(plane, poses, rng), 256)
    row("200 cars, batch of 256, noise", noisy, "beam marching in a grid", marched)
    one = per_second(lambda: [laser.scan(plane, p) for p in single], len(single))
    row("200 cars, one by one", one, "beam marching in a grid", marched)
    one = per_second(lambda: [laser.scan(plane, p, rng) for p in single], len(single))
    row("200 cars, one by one, noise", one, "beam marching in a grid", marched)
    ids = per_second(lambda: laser.scan_batch_with_ids(plane, poses), 256)
    row("200 cars, batch of 256, ids", ids, "beam marching in a grid", marched)
    octagons, draw = lot(np.random.default_rng(0), 200, corners=8)
    many = draw(256)
    eight = per_second(lambda: laser.scan_batch(octagons, many), 256)
    row("200 cars of 8 corners, batch of 256", eight, "beam marching in a grid", marched)
    large, draw = lot(np.random.default_rng(0), 10_000, columns=177)
    many = draw(256)
    row(
        "10,000 cars, batch of 256", per_second(lambda: laser.scan_batch(large, many), 256), "200 cars", batch
    )
    return rows


if __name__ == "__main__":
    table = Table("case", "scans/s", "peer", "scans/s", "ratio")
    for r in laser_rows():
        table.add_row(
            r["case"], f"{r['value']:,.0f}", r["peer"], f"{r['peer_value']:,.0f}", f"{r['ratio']:.1f}"
        )
    Console().print(table)
