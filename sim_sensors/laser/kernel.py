"""Compiled laser scanner: each obstacle is drawn into the interval of beams that it covers.

A ray caster tests every beam against all segments. Here a convex footprint becomes the interval of beams between its
two silhouette corners, and the lines of its visible faces. The inverse range of a line
along a beam is linear in the beam's direction (u, v): 1/r = a·u + b·v. A beam enters a footprint through the face with
the smallest inverse range, and hits first the obstacle with the largest. So a beam costs two products per face and a
comparison, and no division. A rectangle shows at most two faces. A wall is a polygon of two corners.
"""

import math
from typing import NamedTuple

import numpy as np

from parkenv.compiled.arrays import Float32Array
from parkenv.compiled.jit import compiled
from sim_sensors.laser.footprints import LANES, LARGEST_IN_A_CELL_M, NO_RETURN, OCTAGON, QUAD, WALL

BEAMS_PER_BLOCK = 16
BEAMS_PER_DRAW = 64  # beams that use neighbouring numbers of the noise table, from one random offset
POSES_PER_CHUNK = 8  # number of scans that fit into the first-level cache

# Intervals are widened by this many beams against float32 rounding, so that no beam passes between two walls that share
# an end. At 30 m this is 0.03 mm.
WIDENING = 2e-4

# No flag that forbids NaN or infinity: unused lanes hold NaN, and inf is the range without a return.
_FAST = {"contract", "reassoc", "arcp", "nsz"}


class BeamTable(NamedTuple):
    """Beams in a frame along their middle direction, padded to whole blocks."""

    u: Float32Array  # (n_padded,) direction of each beam, with v
    v: Float32Array
    number: Float32Array  # (n_padded,) 0, 1, 2, ...
    n: int  # number of beams
    middle: float  # number of the beam along the frame's x axis; a half lies between two beams
    per_radian: float  # beams per radian
    max_range: float  # m


@compiled(inline="always")
def _angle(x, y):  # type: ignore[no-untyped-def]
    """Return the direction of (x, y), rad, without branches; atan by a minimax polynomial, error below 4e-8."""
    f = np.float32
    a, b = abs(x), abs(y)
    q = min(a, b) / max(a, b)
    z = q * q
    p = f(-0.004054537984708659)
    p = p * z + f(0.021862849361052622)
    p = p * z + f(-0.0559121659168168)
    p = p * z + f(0.09642185214354208)
    p = p * z + f(-0.13908624679920795)
    p = p * z + f(0.19946564650638207)
    p = p * z + f(-0.3332986069424402)
    p = (p * z + f(0.999999335555099)) * q
    p = f(math.pi / 2) - p if b > a else p
    p = f(math.pi) - p if x < f(0) else p
    return -p if y < f(0) else p


@compiled(forceinline=True, error_model="numpy", fastmath=_FAST)
def _prepare_block(  # type: ignore[no-untyped-def]
    k, block, corners, xs, ys, radius, label,
    x0, y0, cos, sin, per_radian, middle, max_range, shapes,
):  # fmt: skip
    """Compute the interval of beams, the first and last visible face, and the number of faces, for sixteen obstacles.

    `shapes`, (7 · LANES,) float32: lowest beam, highest beam, a and b of the first face, a and b of the last face,
    number of faces. Obstacles that are out of range get an empty interval. The code has no branches, flat
    arrays and unsigned indices, so that the compiler vectorizes it; `k` is a literal for the same reason.
    """
    f, zero = np.float32, np.float32(0)
    lanes = np.uint64(LANES)
    first = np.uint64(block) * lanes
    base = np.uint64(block) * np.uint64(k * 2 * LANES)
    for i in range(lanes):
        dx, dy = f(xs[first + i] - x0), f(ys[first + i] - y0)
        start_x = start_y = start_ex = start_ey = start_cross = zero
        end_x = end_y = end_ex = end_ey = end_cross = zero
        faces = zero
        # For an edge from p along e and the sensor at 0, the face is visible if p × e < 0. Start with the edge before
        # corner 0; an edge without length (a repeated corner) counts as the one before it.
        lx, ly = corners[base + i], corners[base + lanes + i]
        last = base + np.uint64((k - 1) * 2 * LANES)
        px, py = corners[last + i], corners[last + lanes + i]
        old_ex, old_ey = lx - px, ly - py
        old_cross = (dx + px) * old_ey - (dy + py) * old_ex
        for j in range(k):
            after = base + np.uint64(((j + 1) % k) * 2 * LANES)
            nx, ny = corners[after + i], corners[after + lanes + i]
            x, y, ex, ey = dx + lx, dy + ly, nx - lx, ny - ly
            cross = x * ey - y * ex
            real = cross != zero
            ex, ey, cross = (ex if real else old_ex), (ey if real else old_ey), (cross if real else old_cross)
            visible, was_visible = cross < zero, old_cross < zero
            starts, ends = visible & (not was_visible), was_visible & (not visible)
            start_x, start_y = (x if starts else start_x), (y if starts else start_y)
            start_ex, start_ey = (ex if starts else start_ex), (ey if starts else start_ey)
            start_cross = cross if starts else start_cross
            end_x, end_y = (x if ends else end_x), (y if ends else end_y)
            end_ex, end_ey = (old_ex if ends else end_ex), (old_ey if ends else end_ey)
            end_cross = old_cross if ends else end_cross
            faces = faces + (f(1) if visible & real else zero)
            lx, ly, old_ex, old_ey, old_cross = nx, ny, ex, ey, cross
        reach, squared = radius[first + i] + max_range, dx * dx + dy * dy
        away = squared > reach * reach
        # Without a visible face it is a wall or a sliver seen end-on, or the sensor is inside: the number of faces
        # tells which.
        hidden = away | (start_cross == zero)
        outside = (squared > radius[first + i] * radius[first + i]) | (label[first + i] == WALL)
        faces = f(1) if away | (hidden & outside) else faces
        # Counter-clockwise corners run clockwise along the visible side, which starts at the highest beam.
        high = _angle(cos * start_x + sin * start_y, cos * start_y - sin * start_x) * per_radian + middle
        low = _angle(cos * end_x + sin * end_y, cos * end_y - sin * end_x) * per_radian + middle
        shapes[i] = f(np.inf) if hidden else low - f(WIDENING)
        shapes[lanes + i] = f(-np.inf) if hidden else high + f(WIDENING)
        inverse = f(1) / start_cross
        shapes[np.uint64(2 * LANES) + i] = (cos * start_ey - sin * start_ex) * inverse
        shapes[np.uint64(3 * LANES) + i] = -(cos * start_ex + sin * start_ey) * inverse
        inverse = f(1) / end_cross
        shapes[np.uint64(4 * LANES) + i] = (cos * end_ey - sin * end_ex) * inverse
        shapes[np.uint64(5 * LANES) + i] = -(cos * end_ex + sin * end_ey) * inverse
        shapes[np.uint64(6 * LANES) + i] = faces


@compiled(forceinline=True, error_model="numpy", fastmath=_FAST)
def _visible_faces(k, place, corners, dx, dy, cos, sin, lines):  # type: ignore[no-untyped-def]
    """Write a and b of every visible face of one obstacle into `lines`, (2 · k,) float32; return their number."""
    f = np.float32
    base = place // LANES * (k * 2 * LANES) + place % LANES
    n = 0
    for j in range(k):
        at, after = base + j * 2 * LANES, base + (j + 1) % k * 2 * LANES
        ex, ey = corners[after] - corners[at], corners[after + LANES] - corners[at + LANES]
        cross = (dx + corners[at]) * ey - (dy + corners[at + LANES]) * ex
        if cross < f(0):
            lines[2 * n], lines[2 * n + 1] = (cos * ey - sin * ex) / cross, -(cos * ex + sin * ey) / cross
            n += 1
    return n


@compiled(forceinline=True, error_model="numpy", fastmath=_FAST)
def _draw_two_faces(a0, b0, a1, b1, low, high, begin, end, u, v, number, inverse, row):  # type: ignore[no-untyped-def]
    """Keep the larger inverse range for the beams from `low` to `high`, which lie within `begin` to `end`."""
    for i in range(np.uint64(begin), np.uint64(end)):
        here = min(a0 * u[i] + b0 * v[i], a1 * u[i] + b1 * v[i])
        here = here if (number[i] >= low) and (number[i] <= high) else np.float32(0)
        inverse[np.uint64(row) + i] = max(inverse[np.uint64(row) + i], here)


@compiled(forceinline=True, error_model="numpy", fastmath=_FAST)
def _draw_four_faces(lines, n, low, high, begin, end, u, v, number, inverse, row):  # type: ignore[no-untyped-def]
    """Do as `_draw_two_faces` for three or four faces; without a fourth, the third counts twice."""
    last = 2 * n - 2
    a0, b0, a1, b1 = lines[0], lines[1], lines[2], lines[3]
    a2, b2, a3, b3 = lines[4], lines[5], lines[last], lines[last + 1]
    for i in range(np.uint64(begin), np.uint64(end)):
        one = min(a0 * u[i] + b0 * v[i], a1 * u[i] + b1 * v[i])
        other = min(a2 * u[i] + b2 * v[i], a3 * u[i] + b3 * v[i])
        here = min(one, other) if (number[i] >= low) and (number[i] <= high) else np.float32(0)
        inverse[np.uint64(row) + i] = max(inverse[np.uint64(row) + i], here)


@compiled(error_model="numpy", fastmath=_FAST)
def _draw_lines(lines, n, low, high, begin, end, label, u, v, number, inverse, ids, row, here):  # type: ignore[no-untyped-def]
    """Do as `_draw_two_faces` for any number of faces, with optional ids."""
    first, stop, start = np.uint64(begin), np.uint64(end), np.uint64(row)
    a, b = lines[0], lines[1]
    for i in range(first, stop):
        here[i] = a * u[i] + b * v[i]
    for j in range(1, n):
        a, b = lines[2 * j], lines[2 * j + 1]
        for i in range(first, stop):
            here[i] = min(here[i], a * u[i] + b * v[i])
    for i in range(first, stop):
        here[i] = here[i] if (number[i] >= low) and (number[i] <= high) else np.float32(0)
    if len(ids):
        for i in range(first, stop):
            ids[start + i] = label if here[i] > inverse[start + i] else ids[start + i]
    for i in range(first, stop):
        inverse[start + i] = max(inverse[start + i], here[i])


@compiled(error_model="numpy", fastmath=_FAST)
def _draw_table(cells, poses, first_pose, last_pose, heading, beams, work):  # type: ignore[no-untyped-def]
    """Draw the obstacles of a cell table that are within range of several poses.

    Scan s has row s of `inverse` and, if it is not empty, of `ids`, (chunk · n_padded,). `covered[s]` is set to the
    label of a footprint that contains the sensor. One call processes all poses of a chunk: counting references costs.
    """
    f = np.float32
    corners, xs, ys, radius, label, cell_start, frame, k = cells
    shapes, lines, inverse, ids, here, covered = work
    u, v, number, max_range = beams.u, beams.v, beams.number, f(beams.max_range)
    per_radian, middle = f(beams.per_radian), f(beams.middle)
    last_beam, half_turn, n_padded = f(beams.n - 1), f(math.pi) * per_radian, len(u)
    left, bottom, size, rows, columns = frame[0], frame[1], frame[2], int(frame[3]), int(frame[4])
    reach = max_range + LARGEST_IN_A_CELL_M
    for pose in range(first_pose, last_pose):
        scan = pose - first_pose
        scan_row = scan * n_padded
        x0, y0, forward = poses[pose, 0], poses[pose, 1], poses[pose, 2] + heading
        cos, sin = f(math.cos(forward)), f(math.sin(forward))
        low_row = int(min(max(math.floor((y0 - reach - bottom) / size), 0.0), frame[3]))
        high_row = int(min(max(math.floor((y0 + reach - bottom) / size), -1.0), frame[3] - 1))
        done = 0  # blocks come in order; a block shared by two runs is drawn once
        for row in range(low_row, high_row + 2):
            run_begin, run_end = cell_start[rows * columns], int(frame[5])
            if row <= high_row:
                below = bottom + row * size
                across = max(0.0, max(below - y0, y0 - below - size))
                half = math.sqrt(max(0.0, reach * reach - across * across))
                first = int(min(max(math.floor((x0 - half - left) / size), 0.0), frame[4]))
                last = int(min(max(math.floor((x0 + half - left) / size), -1.0), frame[4] - 1))
                if first > last:
                    continue
                run_begin = cell_start[row * columns + first]
                run_end = cell_start[row * columns + last + 1]
            for block in range(max(done, run_begin // LANES), (run_end - 1) // LANES + 1):
                done = block + 1
                if k == QUAD:
                    _prepare_block(
                        QUAD, block, corners, xs, ys, radius, label,
                        x0, y0, cos, sin, per_radian, middle, max_range, shapes,
                    )  # fmt: skip
                elif k == OCTAGON:
                    _prepare_block(
                        OCTAGON, block, corners, xs, ys, radius, label,
                        x0, y0, cos, sin, per_radian, middle, max_range, shapes,
                    )  # fmt: skip
                else:
                    _prepare_block(
                        k, block, corners, xs, ys, radius, label,
                        x0, y0, cos, sin, per_radian, middle, max_range, shapes,
                    )  # fmt: skip
                for i in range(LANES):
                    low, high, faces = shapes[i], shapes[LANES + i], shapes[6 * LANES + i]
                    if faces == f(0):
                        covered[scan] = label[block * LANES + i]
                    if high == f(-np.inf):
                        continue
                    # An interval that contains the direction opposite to the middle is given by its two ends.
                    wraps = low - high > half_turn
                    for part in range(2 if wraps else 1):
                        lo = f(-1) if wraps and part == 1 else low
                        hi = last_beam + f(1) if wraps and part == 0 else high
                        if hi < f(0) or lo > last_beam:
                            continue
                        begin = int(max(lo, f(0))) // BEAMS_PER_BLOCK * BEAMS_PER_BLOCK
                        end = min((int(hi) // BEAMS_PER_BLOCK + 1) * BEAMS_PER_BLOCK, n_padded)
                        if faces <= f(2) and len(ids) == 0:
                            _draw_two_faces(
                                shapes[2 * LANES + i], shapes[3 * LANES + i],
                                shapes[4 * LANES + i], shapes[5 * LANES + i],
                                lo, hi, begin, end, u, v, number, inverse, scan_row,
                            )  # fmt: skip
                        else:
                            place, n = block * LANES + i, 2
                            for j in range(4):
                                lines[j] = shapes[(2 + j) * LANES + i]
                            if faces > f(2):
                                dx, dy = f(xs[place] - x0), f(ys[place] - y0)
                                n = _visible_faces(k, place, corners, dx, dy, cos, sin, lines)
                            if 2 < n <= 4 and len(ids) == 0:
                                _draw_four_faces(
                                    lines, n, lo, hi, begin, end, u, v, number, inverse, scan_row
                                )
                            else:
                                _draw_lines(
                                    lines, n, lo, hi, begin, end, label[place], u, v, number,
                                    inverse, ids, scan_row, here,
                                )  # fmt: skip


@compiled(error_model="numpy", fastmath=_FAST)
def _add_noise(ranges, scan, max_range, noise):  # type: ignore[no-untyped-def]
    f, n = np.float32, ranges.shape[1]
    table, offsets, sd, lost = noise
    for draw in range(offsets.shape[1]):
        at, drop = np.uint64(offsets[scan, draw, 0]), np.uint64(offsets[scan, draw, 1])
        first = draw * BEAMS_PER_DRAW
        part = ranges[scan, first : min(first + BEAMS_PER_DRAW, n)]
        for i in range(np.uint64(len(part))):
            noisy = min(max(part[i] + sd * table[at + i], f(0)), max_range)
            gone = (part[i] == f(np.inf)) | (table[drop + i] < lost)
            part[i] = f(np.inf) if gone else noisy


@compiled(nogil=True, error_model="numpy", fastmath=_FAST)
def scan_all(quads, others, poses, heading, beams, noise, ranges, ids):  # type: ignore[no-untyped-def]
    """Fill `ranges`, (b, n_beams) float32, and `ids`, of the same shape, or (0, n_beams) to omit them.

    `noise` are a table of normal numbers; where neighbouring beams of each scan begin to read it, (b, n_draws, 2)
    int64, for noise and dropouts; the standard deviation, m; and the number below which a return is lost.
    """
    f, n, n_padded, with_ids = np.float32, beams.n, len(beams.u), len(ids) > 0
    max_range = f(beams.max_range)
    least = f(1) / max_range
    shapes, here = np.empty(7 * LANES, np.float32), np.empty(n_padded, np.float32)
    lines = np.empty(2 * max(quads[-1], others[-1]), np.float32)
    chunk = min(POSES_PER_CHUNK, len(poses))
    inverse, covered = np.empty(chunk * n_padded, np.float32), np.empty(chunk, np.int32)
    seen = np.empty(chunk * n_padded if with_ids else 0, np.int32)
    work = (shapes, lines, inverse, seen, here, covered)
    for first in range(0, len(poses), POSES_PER_CHUNK):
        last = min(first + POSES_PER_CHUNK, len(poses))
        inverse[:], covered[:], seen[:] = least, NO_RETURN, NO_RETURN
        for cells in (quads, others):
            if len(cells[1]) > 0:
                _draw_table(cells, poses, first, last, heading, beams, work)
        for scan in range(first, last):
            row = np.uint64((scan - first) * n_padded)
            inside = covered[scan - first] != NO_RETURN
            for i in range(np.uint64(n)):
                ranges[scan, i] = f(1) / inverse[row + i] if inverse[row + i] > least else f(np.inf)
            if inside:
                ranges[scan, :] = f(0)
            _add_noise(ranges, scan, max_range, noise)
            if with_ids:
                for i in range(np.uint64(n)):
                    hit = covered[scan - first] if inside else seen[row + i]
                    ids[scan, i] = hit if ranges[scan, i] < f(np.inf) else NO_RETURN
