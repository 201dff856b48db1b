"""The report in a real browser: it loads without errors, plays, steps, sorts, and shows the summary's numbers."""

import json
from dataclasses import replace

import numpy as np
import pytest
from chromium import SOCKETS, every, one, painted, screen
from command_line import parkenv
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import WebDriverWait

from parkenv.lots import packaged_lot, write_lot
from parkenv.world.facility import Facility
from parkenv.world.tariff import Price, Zone

pytestmark = [SOCKETS, pytest.mark.slow]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A comparison in two settings, and its report."""
    out = tmp_path_factory.mktemp("browser") / "compare"
    command = "compare --scenario mini --agents mdp,first-free,greedy-goal,oracle --failure-cost 10,30 -n 6"
    assert parkenv(f"{command} --occupancy-levels none --jobs 1 --report --out", out).returncode == 0
    return out


@pytest.fixture
def page(browser, run):
    screen(browser, 1400)
    browser.get((run / "report.html").as_uri())
    yield browser
    assert browser.get_log("browser") == []


def seconds(page):
    return float(one(page, "#replay input[type=range]").get_attribute("value"))


def cells(page, key):
    """Values of a column of the results, from top to bottom as they stand."""
    found = every(page, f'table[data-table="rows"] td[data-key="{key}"]')
    return [json.loads(cell.get_attribute("data-value")) for cell in found if cell.is_displayed()]


def test_its_numbers_are_those_of_the_summary(page, run):
    rows = json.loads((run / "summary.json").read_text())["rows"]
    assert cells(page, "agent") == [row["agent"] for row in rows]
    assert cells(page, "total_s") == [[row["total_s"], *row["total_s_ci95"]] for row in rows]
    assert cells(page, "difference_s") == [[row["difference_s"], *row["difference_s_ci95"]] for row in rows]
    assert cells(page, "walk_s") == [row["walk_s"] for row in rows]
    shown = [cell.text for cell in every(page, 'table[data-table="rows"] td[data-key="total_s"]')]
    for text, row in zip(shown, rows, strict=True):
        low, high = row["total_s_ci95"]
        assert text == f"{row['total_s']:.1f}[{low:.1f}, {high:.1f}]"
    labels = [svg.get_attribute("aria-label") for svg in every(page, "#chart .grid svg")]
    assert ", ".join(labels) == ", ".join(f"{row['agent']} {row['total_s']:.1f} s" for row in rows)


def test_tables_sort_by_click_and_by_enter(page):
    before = cells(page, "total_s")
    heading = one(page, 'table[data-table="rows"] th[data-key="total_s"]')
    heading.find_element(By.TAG_NAME, "button").click()
    assert heading.get_attribute("aria-sort") == "ascending"
    assert cells(page, "total_s") == sorted(before)
    heading.find_element(By.TAG_NAME, "button").send_keys(Keys.ENTER)
    assert heading.get_attribute("aria-sort") == "descending"
    assert cells(page, "total_s") == sorted(before, reverse=True)
    word = one(page, 'table[data-table="rows"] th[data-key="agent"]')
    word.find_element(By.TAG_NAME, "button").send_keys(Keys.SPACE)
    assert cells(page, "agent") == sorted(cells(page, "agent"))
    assert heading.get_attribute("aria-sort") == "none"


def test_the_keyboard_plays_and_steps(page, run):
    data = json.loads(one(page, "#report-data").get_attribute("textContent"))
    shown = {panel.get_attribute("data-agent") for panel in every(page, "#replay .panel")}
    searches = [s for s in data["worlds"][0]["searches"] if s["agent"] in shown]
    moments = sorted({t / 100 for s in searches for t in s["t"]} | {s["total_s"] for s in searches})
    keys = ActionChains(page)
    for expected in moments[1:6]:
        keys.send_keys(Keys.ARROW_RIGHT).perform()
        assert seconds(page) == pytest.approx(expected, abs=0.006)
    keys.send_keys(Keys.ARROW_LEFT).perform()
    assert seconds(page) == pytest.approx(moments[4], abs=0.006)
    keys.send_keys(Keys.HOME).perform()
    assert seconds(page) == 0.0
    keys.send_keys(Keys.SPACE).perform()
    assert one(page, "#replay .play").get_attribute("aria-label") == "Pause"
    keys.send_keys(Keys.SPACE).perform()
    assert one(page, "#replay .play").get_attribute("aria-label") == "Play"


def test_the_end_of_a_replay_is_the_end_of_the_search(page):
    data = json.loads(one(page, "#report-data").get_attribute("textContent"))
    slider = one(page, "#replay input[type=range]")
    page.execute_script(
        "arguments[0].value = arguments[0].max; arguments[0].dispatchEvent(new Event('input'))", slider
    )
    panels = every(page, "#replay .panel")
    assert len(panels) == 2
    for panel in panels:
        agent = panel.get_attribute("data-agent")
        (search,) = [s for s in data["worlds"][0]["searches"] if s["agent"] == agent]
        assert int(panel.get_attribute("data-vertex")) == search["vertex"][-1]
        assert panel.find_element(By.CSS_SELECTOR, ".clock").text == f"{search['total_s']:.1f} s"
        assert "at the goal" in panel.find_element(By.CSS_SELECTOR, ".status").text
        parts = [float(b.text) for b in panel.find_elements(By.CSS_SELECTOR, ".split b")]
        assert sum(parts) == pytest.approx(search["total_s"], abs=0.2)
        assert panel.find_element(By.CSS_SELECTOR, ".check").text == "✓ as in episodes.csv"
    # Back at the start, everything is as it was before.
    ActionChains(page).send_keys(Keys.ARROW_LEFT).perform()
    one(page, "#replay button[aria-label='To the start']").click()
    assert all(
        int(p.get_attribute("data-vertex")) == data["worlds"][0]["searches"][0]["vertex"][0] for p in panels
    )


def opened(browser, page, *size, **look):
    screen(browser, *size, **look)
    browser.get(page.as_uri())
    return json.loads(one(browser, "#report-data").get_attribute("textContent"))


def fits_a_phone(browser, page, canvas, dark):
    opened(browser, page, 390, 844, dark=dark)
    assert browser.execute_script("return document.documentElement.scrollWidth") <= 390
    assert painted(browser, canvas) > 20
    assert browser.get_log("browser") == []


def test_a_day_with_many_cars_is_played(browser, tmp_path):
    command = (
        "fleet --scenario mini --hours 08:00-08:30 --arrivals-per-hour 40 --knows own,reserve -n 1 --jobs 1"
    )
    assert parkenv(f"{command} --report --out", tmp_path).returncode == 0
    days = opened(browser, tmp_path / "report.html", 1400)["fleets"]
    assert [p.get_attribute("data-setting") for p in every(browser, "#crowd .panel")] == ["own", "reserve"]
    slider = one(browser, "#crowd input[type=range]")
    for seconds in (0.0, 700.0, 1500.0, 300.0):
        script = "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('input'));"
        browser.execute_script(script, slider, seconds)
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
    near = np.argsort(lot.walk_m())
    names = np.full(lot.n_slots, "", dtype="U16")
    names[near[:60]], names[near[60:100]] = "Mill Street", "Station"
    supply = {
        "facilities": (Facility("Mill Street", "kerb", "inner"), Facility("Station", "lot")),
        "slot_facility": names,
        "zone_rules": {"inner": Zone("inner", Price(2.0)), "other": Zone("other")},
    }
    write_lot(replace(lot, **supply), tmp_path / "town.geojson")
    command = (
        "fleet --lot town.geojson --hours 08:00-11:00 --arrivals-per-hour 60,120 --knows own -n 1 --jobs 1"
    )
    assert parkenv(f"{command} --out out", cwd=tmp_path).returncode == 0
    page = tmp_path / "out" / "fleet.html"
    data = opened(browser, page, 1280)
    town, shown = data["towns"][0], data["maps"][0]
    canvas = one(browser, "canvas.town")

    def heading():
        return one(browser, ".about h3").text

    assert heading() == town["name"]
    x0, y0, x1, y1 = town["bounds"]
    width, height = canvas.rect["width"], canvas.rect["height"]
    scale = min(width / (x1 - x0 + 10), height / (y1 - y0 + 10))
    for block in (0, 1):
        x, y = town["blocks"][block]["at"]
        across, up = scale * (x - (x0 + x1) / 2), scale * (y - (y0 + y1) / 2)
        ActionChains(browser).move_to_element_with_offset(canvas, round(across), round(-up)).click().perform()
        assert heading() == town["blocks"][block]["name"]
        cells = [cell.text for cell in every(browser, ".about tbody td:nth-child(3)")]
        arrivals = shown["blocks"]["arrivals"][block][: len(shown["hours"])]
        assert cells == [f"{cars:.0f}" for cars in arrivals]
    # The keyboard chooses, zooms and moves; the hour at hand is marked.
    one(browser, "#map-block").send_keys("Mill")
    assert heading() == "Mill Street"
    canvas.send_keys("0")
    whole = painted_bytes(browser)
    canvas.send_keys("+" + Keys.ARROW_RIGHT)
    assert painted_bytes(browser) != whole
    canvas.send_keys(Keys.ESCAPE)
    assert heading() == town["name"]
    one(browser, "#town button[title^='To the start']").click()
    for hour in range(3):
        one(browser, "#town .step-on").click()
        assert one(browser, ".about tr.now td").text == f"{8 + hour:02}:00"
        assert f"{shown['states']['searching'][hour]:.0f} searching" in one(browser, "#town .counts").text
    # Another setting, and revenue instead of occupancy.
    one(browser, "#map-setting").send_keys("120")
    before = painted_bytes(browser)
    one(browser, "#map-measure").send_keys("rev")
    assert painted_bytes(browser) != before
    fits_a_phone(browser, page, "canvas.town", dark=False)


def painted_bytes(page):
    return page.execute_script("return document.querySelector('canvas.town').toDataURL()")


def test_a_survey_drive_is_shown_in_step(browser, tmp_path):
    assert (
        parkenv("survey --scenario mini --sessions 1 --every 4 --jobs 1 --report --out", tmp_path).returncode
        == 0
    )
    (drive,) = opened(browser, tmp_path / "report.html", 1400)["drives"]
    slider = one(browser, "#drive input[type=range]")
    one(browser, "#drive button[title^='To the start']").click()
    for k in range(1, len(drive["frames"])):
        one(browser, "#drive .step-on").click()
        assert float(slider.get_attribute("value")) == pytest.approx(drive["frames"][k]["t"], abs=0.006)
    facts = [b.text for b in every(browser, "#drive .facts b")]
    judged = {}
    for frame in drive["frames"]:
        judged |= dict(zip(frame["belief"][::2], frame["belief"][1::2], strict=True))
    assert int(facts[1]) == sum(value >= 0 for value in judged.values())
    # The camera's frame is decoded and drawn; so are three pictures of the lot.
    WebDriverWait(browser, 60).until(lambda _: painted(browser, "#drive .panel canvas") > 500)
    assert len(every(browser, "#drive canvas")) == 4
    assert browser.get_log("browser") == []


@pytest.mark.parametrize("dark", [False, True])
def test_it_fits_a_phone_and_follows_the_theme(browser, run, dark):
    screen(browser, 390, 844, dark=dark)
    browser.get((run / "report.html").as_uri())
    assert browser.execute_script("return document.documentElement.scrollWidth") <= 390
    assert browser.execute_script("return document.documentElement.dataset.theme") == (
        "dark" if dark else "light"
    )
    paper = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
    red = int(paper.removeprefix("rgb(").split(",")[0])
    assert red < 60 if dark else red > 200
    assert len(every(browser, "#replay .panel")) == 1
    assert painted(browser, "#replay .panel canvas") > 20
    before = browser.execute_script("return document.documentElement.dataset.theme")
    one(browser, "#theme").click()
    assert browser.execute_script("return document.documentElement.dataset.theme") != before
    assert browser.get_log("browser") == []
