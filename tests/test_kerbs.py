"""The made district `kerbs` is as full as the law says that real kerbs are, and its block faces differ as theirs."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.special import logit

import parkenv
from parkenv.lots import packaged_lot
from parkenv.scenarios.build import make_scenario

LAW = json.loads((Path(parkenv.__file__).parent / "scenarios/packaged/kerbs_law.json").read_text("utf-8"))


@pytest.fixture(scope="module")
def process():
    return make_scenario("kerbs").occupancy


@pytest.mark.parametrize(("kind", "days"), [("weekday", range(5)), ("saturday", (5,)), ("sunday", (6,))])
def test_the_share_taken_by_hour_is_that_of_the_law(process, kind, days):
    hours = range(7, 21)
    for day in days:
        taken = [process.marginal(86_400 * day + 3600 * (hour + 0.5)).mean() for hour in hours]
        np.testing.assert_allclose(taken, [LAW["share_taken"][kind][hour] for hour in hours], atol=0.04)


def test_block_faces_differ_and_opposite_ones_are_alike(process):
    faces, face = np.unique(packaged_lot("kerbs").slot_facility, return_inverse=True)
    bays = np.bincount(face)
    assert (bays.min(), bays.max()) == (4, 24)
    popularity = np.log(process.arrival_factor / process.departure_factor)
    mean = np.bincount(face, popularity) / bays
    within = np.sqrt(((popularity - mean[face]) ** 2).sum() / (len(popularity) - len(faces)))
    assert within == pytest.approx(LAW["between_bays"], rel=0.1)
    assert mean.std() == pytest.approx(LAW["between_faces"], rel=0.2)
    apart = zip(faces, mean - mean.mean(), strict=True)
    sides = {tuple(name.rsplit(", ", 1)): value for name, value in apart}
    pairs = [(value, sides[block, "right"]) for (block, side), value in sides.items()
             if side == "left" and (block, "right") in sides]  # fmt: skip
    assert np.corrcoef(np.transpose(pairs))[0, 1] == pytest.approx(LAW["opposite_correlation"], abs=0.25)


def test_stays_are_those_of_the_law(process):
    stays = 1.0 / (process.departure_factor * process.departure_profile[12] * 60.0)
    assert np.median(stays) == pytest.approx(LAW["stay_min"], rel=0.35)
    assert logit(process.marginal(12.5 * 3600.0)).std() > LAW["between_faces"] / 2
