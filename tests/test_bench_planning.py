"""The planning part of the bench: its rows, and that it measures what an agent does."""

import numpy as np
import pytest

from parkenv.lots import grid_lot
from parkenv.studies.bench.planning import drive, forecast_process, planning_rows, transitions
from planners.thesis.label_repair import repair
from planners.thesis.label_setting import StoppingGraph, set_labels


@pytest.mark.slow
def test_rows_have_the_keys_of_every_bench_and_stand_beside_the_thesis():
    rows = planning_rows(seconds=0.01, largest=2_000)
    keys = {"part", "case", "value", "unit", "peer", "peer_value", "ratio"}
    assert all(set(row) == keys and row["value"] > 0 for row in rows)
    assert {row["part"] for row in rows} == {"plan", "replan", "search"}
    by_thesis = [row for row in rows if row["peer"] == "policy iteration, sparse LU"]
    assert len(by_thesis) == 2
    assert all(row["ratio"] > 0 for row in by_thesis)


def test_what_peers_are_given_is_the_same_process():
    mdp = forecast_process(grid_lot(2, 6), 0)
    p = transitions(mdp)
    n = mdp.n_states
    np.testing.assert_allclose(np.asarray(p.sum(axis=1)).ravel(), 1.0)
    values = np.random.default_rng(0).normal(size=n)
    ahead = (p @ np.append(values, 0.0))[:-1].reshape(n, 5)
    np.testing.assert_allclose(mdp.rewards() + mdp.gamma * ahead, mdp.action_values(values))


def test_the_measured_drive_ends_and_sees_each_slot_once():
    lot = grid_lot(4, 10)
    mdp = forecast_process(lot, 0)
    graph = StoppingGraph.of(mdp)
    for seed in range(5):
        labels = set_labels(graph, mdp.p_free.copy())
        seen = []
        for slot, p_free in drive(graph, labels, lot.n_slots, np.random.default_rng(seed)):
            seen.append(int(slot[0]))
            repair(graph, labels, slot, p_free)
        assert len(seen) == len(set(seen)) > 0
