"""The report in a real browser: it loads without errors, plays, steps, sorts, and shows the summary's numbers."""

import json
from dataclasses import replace

import numpy as np
import pytest
from chromium import SOCKETS, every, one, painted, screen
from command_line import ran, summary_of
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import WebDriverWait

from parkenv.lots import packaged_lot, write_lot
from parkenv.world.facility import Facility
from parkenv.world.tariff import Price, Zone

pytestmark = [SOCKETS, pytest.mark.slow]


def opened(browser, page, *size, **look):
    """The data of a page that is shown on a screen."""
    screen(browser, *size, **look)
    browser.get(page.as_uri())
    return json.loads(one(browser, "#report-data").get_attribute("textContent"))


def moved(browser, slider, value):
    script = "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('input'));"
    browser.execute_script(script, slider, value)


def fits_a_phone(browser, page, canvas, dark):
    opened(browser, page, 390, 844, dark=dark)
    assert browser.execute_script("return document.documentElement.scrollWidth") <= 390
    assert painted(browser, canvas) > 20
    assert browser.get_log("browser") == []


def test_a_comparison_has_the_numbers_of_its_summary_sorts_and_replays(browser, tmp_path):
    agents = "mdp,first-free,greedy-goal,oracle"
    command = f"compare --scenario mini --agents {agents} --failure-cost 10,30 -n 6 --occupancy-levels none"
    ran(*command.split(), "--jobs", 1, "--report", "--out", tmp_path)
    rows, page = summary_of(tmp_path)["rows"], tmp_path / "report.html"
    data = opened(browser, page, 1400)

    def cells(key):
        """Values of a column of the results, from top to bottom as they stand."""
        shown = every(browser, f'table[data-table="rows"] td[data-key="{key}"]')
        return [json.loads(cell.get_attribute("data-value")) for cell in shown if cell.is_displayed()]

    assert cells("agent") == [row["agent"] for row in rows]
    totals = [[row["total_s"], *row["total_s_ci95"]] for row in rows]
    assert cells("total_s") == totals
    texts = [cell.text for cell in every(browser, 'table[data-table="rows"] td[data-key="total_s"]')]
    assert texts == [f"{total:.1f}[{low:.1f}, {high:.1f}]" for total, low, high in totals]
    labels = [svg.get_attribute("aria-label") for svg in every(browser, "#chart .grid svg")]
    assert ", ".join(labels) == ", ".join(f"{row['agent']} {row['total_s']:.1f} s" for row in rows)
    heading = one(browser, 'table[data-table="rows"] th[data-key="total_s"]')
    heading.find_element(By.TAG_NAME, "button").click()
    assert (heading.get_attribute("aria-sort"), cells("total_s")) == ("ascending", sorted(totals))
    heading.find_element(By.TAG_NAME, "button").send_keys(Keys.ENTER)
    assert (heading.get_attribute("aria-sort"), cells("total_s")) == ("descending", sorted(totals)[::-1])

    # The keyboard steps and plays, unless a button has the focus.
    browser.execute_script("document.activeElement.blur()")
    world, slider = data["worlds"][0], one(browser, "#replay input[type=range]")
    panels = every(browser, "#replay .panel")
    of_agent = {search["agent"]: search for search in world["searches"]}
    searches = [of_agent[panel.get_attribute("data-agent")] for panel in panels]
    moments = sorted({t / 100 for s in searches for t in s["t"]} | {s["total_s"] for s in searches})
    keys = ActionChains(browser)
    for key, expected in ((Keys.ARROW_RIGHT, moments[1]), (Keys.ARROW_RIGHT, moments[2]), (Keys.HOME, 0.0)):
        keys.send_keys(key).perform()
        assert float(slider.get_attribute("value")) == pytest.approx(expected, abs=0.006)
    for label in ("Pause", "Play"):
        keys.send_keys(Keys.SPACE).perform()
        assert one(browser, "#replay .play").get_attribute("aria-label") == label
    # The end of the replay is that of the search.
    moved(browser, slider, slider.get_attribute("max"))
    assert len(panels) == 2
    for panel, search in zip(panels, searches, strict=True):
        assert int(panel.get_attribute("data-vertex")) == search["vertex"][-1]
        assert panel.find_element(By.CSS_SELECTOR, ".clock").text == f"{search['total_s']:.1f} s"
        parts = [float(b.text) for b in panel.find_elements(By.CSS_SELECTOR, ".split b")]
        assert sum(parts) == pytest.approx(search["total_s"], abs=0.2)
        assert panel.find_element(By.CSS_SELECTOR, ".check").text == "✓ as in episodes.csv"
    one(browser, "#replay button[aria-label='To the start']").click()
    assert {int(panel.get_attribute("data-vertex")) for panel in panels} == {searches[0]["vertex"][0]}
    assert browser.get_log("browser") == []
    # The theme is that of the reader's system, until it is changed.
    for dark in (False, True):
        fits_a_phone(browser, page, "#replay .panel canvas", dark)
        paper = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
        red = int(paper.removeprefix("rgb(").split(",")[0])
        assert red < 60 if dark else red > 200
    one(browser, "#theme").click()
    assert browser.execute_script("return document.documentElement.dataset.theme") == "light"


def test_a_day_with_many_cars_is_played(browser, tmp_path):
    command = "fleet --scenario mini --hours 08:00-08:30 --arrivals-per-hour 40 --knows own,reserve -n 1"
    ran(*command.split(), "--jobs", 1, "--report", "--out", tmp_path)
    days = opened(browser, tmp_path / "report.html", 1400)["fleets"]
    assert [p.get_attribute("data-setting") for p in every(browser, "#crowd .panel")] == ["own", "reserve"]
    slider = one(browser, "#crowd input[type=range]")
    for seconds in (0.0, 1500.0, 300.0):
        moved(browser, slider, seconds)
        for day, counts in zip(days, every(browser, "#crowd .counts"), strict=True):
            now = 100 * float(slider.get_attribute("value"))
            cars = list(zip(day["arrival"], day["ended"], day["slot"], day["leaves"], strict=True))
            searching = sum(arrival <= now < ended for arrival, ended, _, _ in cars)
            taken = sum(leaves > now for leaves in day["residents"][1::2])
            taken += sum(slot >= 0 and ended <= now < leaves for _, ended, slot, leaves in cars)
            assert counts.text.startswith(f"{searching} searching")
            assert f"{taken * 10} % of the slots taken" in counts.text
            assert "as in days.csv" in counts.text
    one(browser, "#crowd .play").click()
    WebDriverWait(browser, 30).until(lambda _: float(slider.get_attribute("value")) > 310.0)
    fits_a_phone(browser, tmp_path / "report.html", "#crowd .panel canvas", dark=True)


def test_a_day_on_a_map_is_played_and_its_blocks_tell_their_day(browser, tmp_path):
    lot = packaged_lot("campus")
    near, names = np.argsort(lot.walk_m()), np.full(lot.n_slots, "", dtype="U16")
    names[near[:60]], names[near[60:100]] = "Mill Street", "Station"
    supply = {
        "facilities": (Facility("Mill Street", "kerb", "inner"), Facility("Station", "lot")),
        "slot_facility": names,
        "zone_rules": {"inner": Zone("inner", Price(2.0)), "other": Zone("other")},
    }
    write_lot(replace(lot, **supply), tmp_path / "town.geojson")
    command = "fleet --hours 08:00-11:00 --arrivals-per-hour 60,120 --knows own -n 1 --jobs 1"
    ran(*command.split(), "--lot", tmp_path / "town.geojson", "--out", tmp_path / "out")
    page = tmp_path / "out" / "fleet.html"
    data = opened(browser, page, 1280)
    town, shown = data["towns"][0], data["maps"][0]
    canvas = one(browser, "canvas.town")

    def heading():
        return one(browser, ".about h3").text

    def picture():
        return browser.execute_script("return document.querySelector('canvas.town').toDataURL()")

    assert heading() == town["name"]
    x0, y0, x1, y1 = town["bounds"]
    scale = min(canvas.rect["width"] / (x1 - x0 + 10), canvas.rect["height"] / (y1 - y0 + 10))
    x, y = town["blocks"][0]["at"]
    across, up = scale * (x - (x0 + x1) / 2), scale * (y - (y0 + y1) / 2)
    ActionChains(browser).move_to_element_with_offset(canvas, round(across), round(-up)).click().perform()
    assert heading() == town["blocks"][0]["name"]
    cells = [cell.text for cell in every(browser, ".about tbody td:nth-child(3)")]
    assert cells == [f"{cars:.0f}" for cars in shown["blocks"]["arrivals"][0][: len(shown["hours"])]]
    # The keyboard chooses, zooms and moves; the hour at hand is marked.
    one(browser, "#map-block").send_keys("Mill")
    assert heading() == "Mill Street"
    canvas.send_keys("0")
    whole = picture()
    canvas.send_keys("+" + Keys.ARROW_RIGHT)
    assert picture() != whole
    canvas.send_keys(Keys.ESCAPE)
    assert heading() == town["name"]
    one(browser, "#town button[title^='To the start']").click()
    for hour in range(3):
        one(browser, "#town .step-on").click()
        assert one(browser, ".about tr.now td").text == f"{8 + hour:02}:00"
        assert f"{shown['states']['searching'][hour]:.0f} searching" in one(browser, "#town .counts").text
    # Another setting, and revenue instead of occupancy.
    one(browser, "#map-setting").send_keys("120")
    before = picture()
    one(browser, "#map-measure").send_keys("rev")
    assert picture() != before
    fits_a_phone(browser, page, "canvas.town", dark=False)


def test_a_survey_drive_is_shown_in_step(browser, tmp_path):
    ran(*"survey --scenario mini --sessions 1 --every 8 --jobs 1 --report --out".split(), tmp_path)
    (drive,) = opened(browser, tmp_path / "report.html", 1400)["drives"]
    slider = one(browser, "#drive input[type=range]")
    one(browser, "#drive button[title^='To the start']").click()
    for frame in drive["frames"][1:]:
        one(browser, "#drive .step-on").click()
        assert float(slider.get_attribute("value")) == pytest.approx(frame["t"], abs=0.006)
    facts = [b.text for b in every(browser, "#drive .facts b")]
    judged = {}
    for frame in drive["frames"]:
        judged |= dict(zip(frame["belief"][::2], frame["belief"][1::2], strict=True))
    assert int(facts[1]) == sum(value >= 0 for value in judged.values())
    # The camera's frame is decoded and drawn; so are three pictures of the lot.
    WebDriverWait(browser, 60).until(lambda _: painted(browser, "#drive .panel canvas") > 500)
    assert len(every(browser, "#drive canvas")) == 4
    assert browser.get_log("browser") == []
