import numpy as np
import pytest
from matplotlib.collections import EllipseCollection
from matplotlib.colors import to_hex
from PIL import Image

from parkenv import InputError, make_scenario
from parkenv.show.figures.charts import spread
from parkenv.show.figures.picture_files import CAPTION, INK, save_picture
from parkenv.show.figures.searches import BELIEF_MAP, draw_searches
from parkenv.show.figures.times import (
    AGENT_COLORS,
    draw_time_against_occupancy,
    draw_time_distribution,
    draw_time_split,
)
from parkenv.studies.compare.cases import Case
from parkenv.studies.compare.figures import FIGURES, ComparisonResults, draw_figures, remove_figures
from parkenv.studies.results import EPISODES
from planners import AGENT_NAMES


def row(agent="mdp", drive=30.0, failed=5.0, walk=60.0, price=0.0, gave_up=0.0, **more):
    total = drive + failed + walk + price + gave_up
    return {
        "scenario": "campus", "agent": agent, "failure_cost_s": 10.0, "v_walk_kmh": 4.0, "v_drive_kmh": 10.0,
        "episodes": 20, "total_s": total, "total_s_ci95": [0.9 * total, 1.1 * total], "drive_s": drive,
        "failed_s": failed, "walk_s": walk, "parking_cost_s": price, "gave_up_s": gave_up, "bound_s": 50.0,
    } | more  # fmt: skip


def trace(name="mdp"):
    return Case(make_scenario("mini"), name).runner().run(0)


AGENTS = ("mdp", "greedy-goal", "first-free", "oracle")
TOTALS = {name: np.linspace(30.0, 90.0, 10) for name in AGENTS}
LAID_OUT = {
    "split": lambda n: draw_time_split([row(name, failure_cost_s=c) for c in range(n) for name in AGENTS]),
    "searches": lambda n: draw_searches([trace(AGENTS[i % 4]) for i in range(n)]),
    "distribution": lambda n: draw_time_distribution({f"lot {i}": TOTALS for i in range(n)}),
}


@pytest.mark.parametrize(("kind", "panels"), [(kind, n) for kind in LAID_OUT for n in (1, 5)])
def test_any_number_of_panels_is_laid_out(kind, panels):
    figure = LAID_OUT[kind](panels)
    assert len(figure.axes) >= panels
    width, height = figure.get_size_inches()
    assert 4.0 <= width <= 16.0
    assert 1.5 <= height <= 17.0


def test_bars_stack_the_terms_and_an_agent_off_the_scale_is_cut():
    rows = [row(), row("greedy-goal", drive=70.0, failed=0.0, price=10.0), row("mdp-static", failed=5000.0)]
    (ax,) = draw_time_split(rows).axes
    left, limit = ax.get_xlim()
    assert left == 0.0
    assert 140.0 < limit < 200.0
    drive, failed, walk, price, gave_up = ([bar.get_width() for bar in bars] for bars in ax.containers)
    assert [drive, walk, gave_up] == [[30.0, 70.0, 30.0], [60.0, 60.0, 0.0], [0.0] * 3]
    assert failed == pytest.approx([5.0, 0.0, limit - 30.0])
    assert price == pytest.approx([0.0, 10.0, 0.0])
    assert [text.get_text() for text in ax.texts] == ["95 s", "140 s", "5,090 s"]
    assert [text.get_weight() for text in ax.texts] == ["bold", "normal", "normal"]
    assert [label.get_text() for label in ax.get_yticklabels()] == ["mdp", "greedy-goal", "mdp-static"]


@pytest.mark.parametrize("interval", [[None, None], [float("nan"), float("nan")]])
def test_a_single_search_without_a_bound_has_no_interval(interval):
    alone = row(total_s_ci95=interval, episodes=1)
    del alone["bound_s"]
    (bars,) = draw_time_split([alone]).axes
    assert all(set(line.get_xdata()) <= {95.0} for line in bars.lines)
    (lines,) = draw_time_against_occupancy([alone | {"occupancy": 0.9}]).axes
    assert lines.lines[0].get_xydata().tolist() == [[90.0, 95.0]]


def test_lines_against_occupancy_are_labelled_where_they_end(tmp_path):
    levels = (0.5, 0.8, 0.95)
    rows = [row(name, drive=d * o, occupancy=o) for name, d in (("mdp", 30), ("oracle", 20)) for o in levels]
    rows += [row("random", failed=f, occupancy=o) for f, o in zip((5.0, 80.0, 9000.0), levels, strict=True)]
    (ax,) = draw_time_against_occupancy(rows).axes
    assert sorted(text.get_text() for text in ax.texts) == ["mdp", "oracle", "random ↑ 9,090 s"]
    assert np.diff(sorted(text.xyann[1] for text in ax.texts)).min() > 0.06 - 1e-9
    assert ax.get_ylim()[0] == 0.0
    assert ax.get_ylim()[1] < 200.0
    colors = [AGENT_COLORS[agent] for agent in ("mdp", "oracle", "random")]
    assert [to_hex(line.get_color()) for line in ax.lines] == colors
    swept = [r | {"failure_cost_s": c} for r in rows for c in (10.0, 90.0)]
    save_picture(draw_time_against_occupancy(swept), tmp_path / "occupancy.png")
    with Image.open(tmp_path / "occupancy.png") as image:
        assert image.size == (1500, 615)


def test_labels_are_spread_and_every_agent_has_a_colour_of_its_own():
    for places, want in (([], []), ([0.2, 0.5, 0.5], [0.2, 0.5, 0.6]), ([0.2, 1.0, 1.0], [0.2, 0.9, 1.0])):
        assert spread(places, 0.1) == pytest.approx(want)
    assert set(AGENT_NAMES) <= set(AGENT_COLORS)
    assert len(set(AGENT_COLORS.values())) == len(AGENT_COLORS)


def test_a_search_shows_truth_forecast_path_and_policy():
    policies = {}
    for name in ("mdp", "greedy-goal"):
        searched = trace(name)
        ax = draw_searches([searched]).axes[0]
        ring, disc = (c for c in ax.collections if isinstance(c, EllipseCollection))
        assert np.allclose(ring.get_facecolors(), BELIEF_MAP(searched.forecast))
        assert np.allclose(disc.get_facecolors(), BELIEF_MAP(searched.occupied.astype(float)))
        assert (ring.get_widths() > disc.get_widths()).all()
        title = ax.get_title(loc="left")
        assert title.startswith(f"{name}: failure cost 10 s")
        assert f"total {searched.metrics['total_s']:.0f} s" in title.replace("\n", " ")
        assert [text.get_text() for text in ax.texts][-2:] == ["1", "2"]
        # Every P twice: with an outline below.
        policies[name] = sum(len(line.get_xdata()) for line in ax.lines if "P" in str(line.get_marker())) / 2
    assert policies == {"mdp": np.sum(trace().policy == 4), "greedy-goal": 0}
    assert policies["mdp"] > 0


@pytest.mark.parametrize("draw", [draw_time_split, draw_time_against_occupancy, draw_searches])
def test_nothing_to_draw_is_refused(draw):
    with pytest.raises(InputError, match="no "):
        draw([])


def test_figures_come_out_the_same_and_a_place_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(InputError, match=r"missing/x\.png: cannot be written"):
        save_picture(draw_time_split([row()]), tmp_path / "missing" / "x.png")
    for name in ("a.png", "b.png"):
        save_picture(draw_time_split([row(), row("oracle")]), tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.png", "b.png"]


def test_the_distribution_rises_by_one_search_at_its_total_time_and_marks_the_mean():
    quick, slow = np.array([30.0, 10.0, 20.0, 20.0]), np.array([40.0, 50.0, 60.0, 900.0])
    ax = draw_time_distribution({"campus": {"mdp": quick, "oracle": slow}}).axes[0]
    curves, dots = {}, {}
    for line in ax.lines:
        (dots if line.get_drawstyle() == "default" else curves)[to_hex(line.get_color())] = line
    end = ax.get_xlim()[1]
    assert 60.0 < end < 200.0, "one long search does not squash the rest"
    for name, times in (("mdp", quick), ("oracle", slow)):
        color = AGENT_COLORS["mdp"] if name == "mdp" else INK
        x, share = curves[color].get_data()
        for limit in (10.0, 20.0, 25.0, 55.0):
            assert share[x <= limit][-1:].sum() == 100.0 * np.mean(times <= limit)
        (at,), (height,) = dots[color].get_data()
        assert at == min(times.mean(), end)
        assert height == 100.0 * np.mean(times <= at)
    assert dots[AGENT_COLORS["mdp"]].get_marker() == "o"
    assert dots[INK].get_marker() == ">", "its mean is beyond the axis"
    assert "12 % longer, up to 900 s" in ax.get_xlabel()


def test_every_registered_figure_can_be_drawn_and_only_those_are_removed(tmp_path):
    mini = make_scenario("mini")
    cases = [(Case(mini, name), range(2)) for name in ("mdp", "first-free")]
    rows = {case.agent: case.run(seeds) for case, seeds in cases}
    episodes = {EPISODES.key(row): row for its in rows.values() for row in its}
    table = [{**row(case.agent), "scenario": "mini"} for case, _ in cases]
    files = draw_figures(ComparisonResults(cases, episodes, table), tmp_path)
    assert sorted(files) == sorted(tmp_path.iterdir())
    drawn = {name for name in FIGURES if any(file.name.startswith(name) for file in files)}
    of_sweeps = {f"time_against_{what}" for what in ("failure_cost", "map")}
    assert drawn == FIGURES.keys() - of_sweeps
    (tmp_path / "map.png").touch()
    remove_figures(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["map.png"]


def test_only_asked_for_figures_are_drawn(tmp_path):
    flat = {"my_lot-constant-forecast-0.5": ("my_lot", 0.5)}
    table = [row(name, scenario=s) for name in ("mdp", "oracle") for s in ("my_lot", *flat)]
    results = ComparisonResults([], {}, table, (), flat)
    files = draw_figures(results, tmp_path, ("time_split", "time_against_map"))
    assert [file.name for file in files] == ["time_split_my_lot.png", "time_against_map_my_lot.png"]
    with Image.open(files[0]) as opened:
        assert opened.info[CAPTION] == "Where the time goes: my_lot"


def test_a_parking_cost_is_in_the_key_only_where_slots_have_one():
    for price in (0.0, 12.0):
        figure = draw_time_split([row(price=price), row("oracle")])
        labels = [text.get_text() for text in figure.legends[0].get_texts()]
        assert ("parking cost" in labels) == (price > 0.0)
        assert "give-up penalty" not in labels
