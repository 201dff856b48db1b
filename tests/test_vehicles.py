"""Vehicle models: sizes by class, meshes that are closed and rightly turned round, footprints that match them."""

import hashlib
import subprocess
import sys
from itertools import product

import numpy as np
import pytest
from shapely.geometry import MultiPoint, Polygon

from sim_sensors.mesh import Material
from sim_sensors.vehicles.classes import BODIES, BODY_SHARE, PAINTS, SIZE_CLASSES
from sim_sensors.vehicles.vehicle import COARSE, DETAILED, FOOTPRINT_CORNERS, KNEE_M, VehicleModel

SEEDS = range(2)
MIRRORS_M = 0.30  # both, beyond the body's sides
EVERY_MESH = pytest.mark.parametrize(("body", "level"), list(product(BODIES, (DETAILED, COARSE))))


def corners(mesh):
    return mesh.vertices[mesh.triangles].astype(np.float64)


def section(mesh, height):
    """Where the edges of all triangles cross a height, (n, 2)."""
    ends = corners(mesh)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2, 3)
    z = ends[..., 2] - height
    ends, z = ends[z[:, 0] * z[:, 1] < 0], z[z[:, 0] * z[:, 1] < 0]
    share = z[:, 0] / (z[:, 0] - z[:, 1])
    return (ends[:, 0] + share[:, None] * (ends[:, 1] - ends[:, 0]))[:, :2]


def first_hits(mesh, origin, direction):
    """For each ray the first triangle that it meets, -1 for none (Möller and Trumbore, 1997)."""
    a, b, c = np.moveaxis(corners(mesh), 1, 0)
    nearest, found = np.full(len(origin), np.inf), np.full(len(origin), -1)
    for i, (o, d) in enumerate(zip(origin, direction, strict=True)):
        p = np.cross(d, c - a)
        volume = np.sum((b - a) * p, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, q = np.sum((o - a) * p, axis=1) / volume, np.cross(o - a, b - a)
            v, t = (q @ d) / volume, np.sum((c - a) * q, axis=1) / volume
        t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6), t, np.inf)
        nearest[i], found[i] = t.min(), t.argmin() if np.isfinite(t.min()) else -1
    return found


def digest(model):
    data = hashlib.sha256()
    for level in (DETAILED, COARSE):
        mesh = model.mesh(level)
        for array in (mesh.vertices, mesh.normals, mesh.triangles, mesh.material, mesh.color):
            data.update(np.ascontiguousarray(array).tobytes())
    data.update(model.footprint().tobytes())
    return data.hexdigest()


@pytest.mark.parametrize("body", BODIES)
def test_sizes_stay_within_their_class_and_fill_it(body):
    models = [VehicleModel.from_seed(body, seed) for seed in range(150)]
    classes = {c.segment: c for c in SIZE_CLASSES[body]}
    for model in models:
        limits = classes[model.segment][2:]
        assert all(low <= size <= high for size, (low, high) in zip(model.size, limits, strict=True))
    assert {m.segment for m in models} == set(classes)
    assert np.std([m.length for m in models]) > 0.03


def test_bodies_and_paints_are_as_common_as_stated():
    models = [VehicleModel.from_seed(None, seed) for seed in range(2000)]
    share = [sum(m.body == body for m in models) / len(models) for body in BODIES]
    np.testing.assert_allclose(share, BODY_SHARE, atol=0.03)
    spread = np.array([max(m.paint) - min(m.paint) for m in models])
    neutral = sum(p.share for p in PAINTS if p.name in ("white", "black", "grey", "silver"))
    assert np.mean(spread < 25) == pytest.approx(neutral, abs=0.05)
    assert sum(p.share for p in PAINTS) == pytest.approx(1.0)
    assert all(sum(c.share for c in group) == pytest.approx(1.0) for group in SIZE_CLASSES.values())


@EVERY_MESH
def test_the_mesh_is_as_large_as_the_model_says_and_its_normals_point_outwards(body, level):
    for seed in SEEDS:
        model = VehicleModel.from_seed(body, seed)
        mesh = model.mesh(level)
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        assert high[0] - low[0] == pytest.approx(model.length, abs=0.02)
        assert 0.0 <= low[2] < 0.02
        assert -0.01 < high[2] - model.height < 0.06  # rails stand higher
        below_mirrors = mesh.vertices[mesh.vertices[:, 2] < 0.75, 1]
        assert np.ptp(below_mirrors) == pytest.approx(model.width, abs=0.03)
        assert np.ptp(mesh.vertices[:, 1]) < model.width + MIRRORS_M
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-5)
        a, b, c = np.moveaxis(corners(mesh), 1, 0)
        face = np.cross(b - a, c - a)
        area = np.linalg.norm(face, axis=1)
        assert area.min() > 0
        assert np.array_equal(np.unique(mesh.triangles), np.arange(len(mesh.vertices)))
        for k in range(3):
            agree = np.sum(face * mesh.normals[mesh.triangles[:, k]], axis=1) / area
            assert agree.min() > 0.3


@EVERY_MESH
def test_no_gap_shows_a_surface_from_behind(body, level):
    """Rays at a car from all directions first hit an outer surface, never an inner one through a hole."""
    rng, model = np.random.default_rng(8), VehicleModel.from_seed(body, 2)
    mesh = model.mesh(level)
    around, up = rng.uniform(0, 2 * np.pi, 600), rng.uniform(0.0, 0.9, 600)
    origin = 12.0 * np.column_stack([np.cos(around) * np.cos(up), np.sin(around) * np.cos(up), np.sin(up)])
    origin[:, 2] += 0.5
    target = rng.uniform(-0.5, 0.5, (600, 3)) * [model.length, model.width, 0.8 * model.height]
    direction = target + np.array([0, 0, 0.55 * model.height]) - origin
    found = first_hits(mesh, origin, direction)
    a, b, c = np.moveaxis(corners(mesh)[found], 1, 0)
    inside = np.sum(np.cross(b - a, c - a) * direction, axis=1) >= 0
    # Thin sheets that are meant to be seen from both sides, and slits narrower than a seam.
    assert np.mean((found >= 0) & inside) <= 0.005, model


@pytest.mark.parametrize("body", BODIES)
def test_one_looks_through_the_glass_onto_an_interior(body):
    mesh = VehicleModel.from_seed(body, 4).mesh()
    opaque = mesh.material != Material.GLASS
    assert 20 < np.sum(~opaque) < 400
    parts = (part[opaque] for part in (mesh.triangles, mesh.material, mesh.color))
    seen = type(mesh)(mesh.vertices, mesh.normals, *parts)
    rng, panes = np.random.default_rng(3), corners(mesh)[~opaque]
    normal = np.cross(panes[:, 1] - panes[:, 0], panes[:, 2] - panes[:, 0])
    side = panes[np.abs(normal[:, 1]) > 0.8 * np.linalg.norm(normal, axis=1)].mean(axis=1)
    target = side[rng.integers(len(side), size=120)]
    origin = target + np.column_stack([rng.uniform(-2, 2, 120), np.sign(target[:, 1]) * 6, np.full(120, 0.7)])
    hit = first_hits(seen, origin, target - origin)
    kinds = seen.material[hit[hit >= 0]]
    assert np.mean(kinds == Material.INTERIOR) > 0.35
    assert np.mean(hit < 0) > 0.02  # and out through the other side


@pytest.mark.parametrize("body", BODIES)
def test_levels_of_detail_have_their_size_and_one_outline(body):
    model = VehicleModel.from_seed(body, 5)
    fine, coarse = model.mesh(DETAILED), model.mesh(COARSE)
    assert 1500 < len(fine.triangles) < 4200
    assert len(coarse.triangles) < 650
    sides = [MultiPoint(m.vertices[:, [0, 2]]).convex_hull for m in (fine, coarse)]
    assert sides[0].symmetric_difference(sides[1]).area < 0.05 * sides[0].area


@pytest.mark.parametrize("body", BODIES)
def test_footprints_are_convex_and_agree_with_the_mesh(body):
    for seed in range(8):
        model = VehicleModel.from_seed(body, seed)
        footprint = model.footprint()
        assert footprint.shape[1] == 2
        assert 8 <= len(footprint) <= FOOTPRINT_CORNERS
        edge = np.roll(footprint, -1, axis=0) - footprint
        after = np.roll(edge, -1, axis=0)
        assert (edge[:, 0] * after[:, 1] - edge[:, 1] * after[:, 0] > 0).all()
        hull = MultiPoint(section(model.mesh(), KNEE_M)).convex_hull
        assert Polygon(footprint).hausdorff_distance(hull) < 0.02


def test_the_same_seed_gives_the_same_mesh_in_another_process():
    program = (
        "import sys; sys.path.insert(0, 'tests'); from test_vehicles import digest, VehicleModel;"
        "print(digest(VehicleModel.from_seed('suv', 11)))"
    )
    other = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert other.stdout.strip() == digest(VehicleModel.from_seed("suv", 11))


def test_seeds_give_different_cars_and_paint_changes_nothing_but_colour():
    assert len({digest(VehicleModel.from_seed("sedan", seed)) for seed in range(12)}) == 12
    model = VehicleModel.from_seed("van", 3)
    red, plain = model.painted((200, 10, 10)).mesh(), model.mesh()
    assert red.vertices is plain.vertices
    assert red.triangles is plain.triangles
    assert not np.array_equal(red.color, plain.color)
    glass = red.material == Material.GLASS
    assert np.array_equal(red.color[glass], plain.color[glass])
