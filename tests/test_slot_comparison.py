from test_slot_days import simulated

from parkenv.forecast.slot_comparison import OURS, compare_slot_days


def test_ours_is_first_where_slots_have_habits_and_the_lot_drifts():
    weekdays, _ = simulated(20, 0.6, seed=5, drift=0.06)
    weekend, _ = simulated(5, 0.6, seed=6)
    first, done = int(weekdays.days.number[14]), []
    rows = compare_slot_days([weekdays, weekend], first, lambda: done.append(1))
    assert rows[0].model == OURS
    assert {row.days for row in rows} == {6} == {len(done)}
    for row in rows[1:]:
        # The slots of this lot differ in one thing only, which suits gradient boosting.
        margin = 0.02 if row.model == "gradient-boosting" else 0.0
        assert rows[0].log_loss < (1 + margin) * row.log_loss
        assert rows[0].brier < (1 + margin) * row.brier
        assert rows[0].crps < 1.1 * row.crps
    assert rows[0].coverage_90 >= 4 / 6
