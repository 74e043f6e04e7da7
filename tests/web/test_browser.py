"""The live page and the report in a real browser."""

import numpy as np
import pytest
from report_studies import HOSTILE, TRIALS

from chargetune.report import read_study, report_page

DRAWN = "html[data-drawn]"
# What the buttons of a figure may do: nothing that sends it anywhere.
BUTTONS = ["Download plot as a PNG", "Zoom", "Pan", "Zoom in", "Zoom out", "Reset axes"]
SHOWN = """() => [...document.querySelectorAll('.plot')].map(
  (plot) => [...plot.querySelectorAll('.modebar-btn')].map((button) => button.dataset.title || button.getAttribute('aria-label')))"""


@pytest.fixture(scope="module")
def address(store, serve):
    with serve(store) as where:
        yield where


@pytest.fixture(scope="module")
def report(store, tmp_path_factory):
    """The report of the first study as a file."""
    file = tmp_path_factory.mktemp("report") / "report.html"
    file.write_text(report_page(read_study(store, "charge")), encoding="utf-8")
    return file


def column(page, index):
    return page.locator(f"#rows tr td:nth-child({index})").all_inner_texts()


def test_list_leads_to_the_studies(open_page, address, store):
    page = open_page(address, wait="#studies tr")
    rows = page.locator("#studies tr").all_inner_texts()
    # The youngest first.
    assert [row.split("\t")[0] for row in rows] == [HOSTILE, "charge"]
    broke = sum(t.score is not None and not t.feasible for t in read_study(store, "charge").trials)
    assert rows[1].split("\t")[1:5] == ["8", "0", "2", str(broke)]
    page.get_by_role("link", name="charge", exact=True).click()
    page.wait_for_selector(DRAWN, state="attached")
    assert page.locator("h1").inner_text() == "charge"
    assert page.wrong == []


def test_a_script_in_a_name_is_text(open_page, address):
    page = open_page(f"{address}/studies/2", wait="#rows tr")
    assert page.locator("h1").inner_text() == HOSTILE
    assert HOSTILE in page.title()
    # The ending of the last trial is markup too, as are the names of the limits.
    assert HOSTILE in page.locator("tr[data-number='11']").inner_text()
    page.locator("tr[data-number='3'] button").click()
    page.wait_for_selector("#compared:not([hidden])")
    page.wait_for_selector(DRAWN, state="attached")
    assert page.locator("main script, h1 script, title script").count() == 0
    assert page.wrong == []


def test_every_panel_is_drawn(open_page, address, store):
    page = open_page(f"{address}/studies/1", wait=DRAWN)
    captions = page.locator("figcaption").all_inner_texts()
    assert captions[:4] == ["SOC (%)", "current (A)", "voltage (V)", "voltage near limit (V)"]
    assert {"backoff b (mV)", "R0 (mΩ)", "R1 (mΩ)"} <= set(captions)
    view = read_study(store, "charge")
    shown = page.evaluate("document.querySelectorAll('#signals .plot')[2].data.map((trace) => [trace.name, Math.max(...trace.y)])")
    by_name = dict(shown)
    for label, trial in (("untuned", view.untuned), ("tuned", view.tuned)):
        highest = max(v.max() for v in view.episode(trial).signal("voltage_V"))
        assert by_name[f"{label} (trial {trial.number})"] == pytest.approx(highest, rel=1e-5)
    limits = page.evaluate("document.querySelectorAll('#signals .plot')[2].layout.shapes.map((shape) => shape.y0)")
    assert limits == [2.5, 4.2]
    best = page.evaluate("document.querySelector('#convergence .plot').data.find((trace) => trace.name === 'best so far').y")
    from chargetune.report.figures.convergence import incumbents

    np.testing.assert_allclose([np.nan if v is None else v for v in best], incumbents(view), rtol=1e-6)
    assert page.wrong == []


def test_sorting_by_a_heading(open_page, address):
    page = open_page(f"{address}/studies/1", wait="#rows tr")
    assert column(page, 1) == [str(n) for n in reversed(range(TRIALS))]
    heading = page.locator("th[data-key='overshoot_mV']")
    for direction, order in (("ascending", sorted), ("descending", lambda v: sorted(v, reverse=True))):
        heading.locator("button").click()
        # The page answers in its own time, which a busy machine makes long.
        page.wait_for_selector(f"th[data-key='overshoot_mV'][aria-sort='{direction}']")
        position = page.evaluate("[...document.querySelectorAll('#headings th')].findIndex((th) => th.dataset.key === 'overshoot_mV')") + 1
        texts = column(page, position)
        values = [float(text) for text in texts if text != "-"]
        assert values == order(values)
        assert len(values) > 2
        # Without a value, and failed: at the end in both directions.
        assert all(text == "-" for text in texts[len(values) :])
        assert len(texts) == TRIALS


def test_a_click_shows_a_trace_and_a_second_one_compares(open_page, address, store):
    page = open_page(f"{address}/studies/1", wait=DRAWN)
    assert page.locator("#compared").is_hidden()
    page.locator("tr[data-number='4'] button").click()
    page.wait_for_function("() => document.querySelectorAll('#signals .plot')[0].data.some((trace) => trace.name === 'trial 4')")
    page.locator("tr[data-number='7'] td:nth-child(2)").click()
    page.wait_for_function("() => document.querySelectorAll('#signals .plot')[0].data.some((trace) => trace.name === 'trial 7')")
    page.wait_for_function("() => document.getElementById('compared-head').textContent.includes('difference')")
    assert page.url.endswith("#4,7")
    view = read_study(store, "charge")
    texts = page.locator("#compared-rows tr").all_inner_texts()
    first = next(text for text in texts if text.startswith("backoff_V[0]")).split("\t")
    a, b = view.trials[4].theta[0], view.trials[7].theta[0]
    assert [float(v) for v in first[1:]] == pytest.approx([a, b, b - a], rel=1e-3)
    with page.expect_download() as download:
        page.get_by_role("link", name="trace of trial 4 (CSV)").click()
    assert download.value.suggested_filename == "charge-trial-4.csv"
    again = open_page(page.url, wait="#compared:not([hidden])")
    assert "trial 7" in again.locator("#compared-head").inner_text()
    assert page.wrong == again.wrong == []


def test_failed_trials_say_why_there_is_no_curve(open_page, address):
    page = open_page(f"{address}/studies/1#6", wait="#compared:not([hidden])")
    page.wait_for_function("() => document.getElementById('message').textContent.includes('no trace is stored')")
    assert "the cycler lost its connection" in page.locator("tr[data-number='6']").inner_text()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("path", ["", "/studies/1#4,7"])
def test_nothing_is_wider_than_a_phone(open_page, address, path, scheme):
    page = open_page(f"{address}{path}", width=390, scheme=scheme, wait=DRAWN if path else "#studies tr")
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    for plot in page.locator(".plot .main-svg").all():
        assert plot.bounding_box()["width"] <= 390
    bright = [int(v) for v in page.evaluate("getComputedStyle(document.body).backgroundColor").strip("rgb()").split(",")]
    assert (sum(bright) > 3 * 128) == (scheme == "light")


@pytest.mark.parametrize("width", [390, 1400])
def test_report_opens_from_a_file_without_a_network(open_page, report, width):
    page = open_page(report.as_uri(), width=width)
    page.context.set_offline(True)
    page.wait_for_selector(DRAWN, state="attached")
    captions = page.locator("figcaption").all_inner_texts()
    assert {"SOC (%)", "current (A)", "voltage (V)", "voltage near limit (V)", "backoff b (mV)", "R0 (mΩ)"} <= set(captions)
    assert page.locator(".plot .main-svg").count() >= 2 * len(captions)
    assert page.evaluate("document.documentElement.scrollWidth") == width
    assert page.evaluate("performance.getEntriesByType('resource').length") == 0
    assert page.locator("#drawing").count() == 0
    assert page.wrong == []


@pytest.mark.parametrize("kind", ["report", "live"])
def test_no_button_sends_a_figure_anywhere(open_page, address, report, kind):
    page = open_page(report.as_uri() if kind == "report" else f"{address}/studies/1", wait=DRAWN)
    shown = page.evaluate(SHOWN)
    assert len(shown) > 4
    assert all(buttons == BUTTONS for buttons in shown), shown
    sends = page.evaluate("() => [...document.querySelectorAll('.plot')].map((plot) => plot._context.plotlyServerURL)")
    assert set(sends) == {""}
    assert page.wrong == []


def test_a_filter_shows_some_trials_and_theta_can_stand_in_the_table(open_page, address, store):
    page, view = open_page(f"{address}/studies/1", wait="#rows tr"), read_study(store, "charge")
    assert page.locator("th[data-key^='theta ']").count() == 0
    page.locator("#with-theta").check()
    assert page.locator("th[data-key^='theta ']").count() == view.space.dimension
    entry, bound = view.space.entries[0], float(np.median([t.theta[0] for t in view.trials]))
    page.locator("#filter").fill(f"{entry} > {bound}")
    assert sorted(map(int, column(page, 1))) == [t.number for t in view.trials if t.theta[0] > bound]
    page.locator("#filter").fill("")
    page.locator("#kind").select_option("failed")
    assert sorted(map(int, column(page, 1))) == [3, 6]
    assert page.wrong == []
