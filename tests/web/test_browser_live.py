"""The live page in a real browser while something changes: a running study, the server, who may look."""

import threading
from itertools import count

from report_studies import LocalSobol, charging

from chargetune.battery.charging.evaluate import Evaluation
from chargetune.episode.score import Score
from chargetune.study.serialization import space_to_json
from chargetune.study.store.store import Store
from chargetune.study.study import Study
from chargetune.study.trial import Trial

TOKEN = "correct horse battery"
# Which of 3000 trials are drawn as points, when 1234 has the largest loss and 777 the smallest excess.
MANY = """async () => {
  const name = head.excesses[0].name;
  const row = (number) => ({
    number, status: "done", value: 2 + Math.sin(number), excesses: { [name]: Math.cos(number) }, feasible: true, counted: true,
  });
  const rows = Array.from({ length: 3000 }, (_, number) => row(number)), node = document.createElement("div");
  rows[1234].value = 99;
  rows[777].excesses[name] = -55;
  document.body.append(node);
  await Figures.convergence(node, head, rows);
  return node.data.filter((trace) => trace.name === "within limits").map((trace) => trace.x);
}"""
DRAWN = "html[data-drawn]"


def test_token_is_refused_and_accepted(open_page, store, serve):
    with serve(store, token=TOKEN) as where:
        page = open_page(f"{where}/studies/1")
        assert "Token needed" in page.inner_text("body")
        page.get_by_label("Token").fill("not the right one")
        page.get_by_role("button", name="Enter").click()
        page.wait_for_load_state()
        assert "Token needed" in page.inner_text("body")
        page.get_by_label("Token").fill(TOKEN)
        page.get_by_role("button", name="Enter").click()
        page.wait_for_selector(DRAWN, state="attached")
        assert page.url == f"{where}/studies/1"
        assert page.locator("#state").inner_text() == "live"


def test_a_running_study_is_followed(open_page, tmp_path, serve):
    """A real study runs beside the browser, which has each told trial in its table before the next one may begin, without a reload."""
    config, path = charging(), tmp_path / "live.sqlite"
    problem, numbers = config.problem(), count()
    go = threading.Semaphore(0)

    def evaluate(theta, seed):
        go.acquire()
        if next(numbers) == 2:
            raise RuntimeError("the cycler lost its connection")
        return Evaluation(problem)(theta, seed)

    def run():
        with (
            Store(path) as opened,
            Study.create_or_resume(opened, "live", config=config.document(), space=problem.space, tuner=LocalSobol()) as study,
        ):
            study.run(evaluate, 5)

    Store(path).close()
    with serve(path) as where:
        listed = open_page(where)
        listed.wait_for_function("() => document.getElementById('state').textContent.includes('no studies yet')")
        worker = threading.Thread(target=run, daemon=True)
        worker.start()
        listed.get_by_role("link", name="live").wait_for()
        page = open_page(f"{where}/studies/1", wait="tr[data-number='0']")
        assert "running" in page.locator("tr[data-number='0']").inner_text()
        page.evaluate("window.first = true")
        for number in range(5):
            go.release()
            page.wait_for_function(f"() => /done|failed/.test(document.querySelector(\"tr[data-number='{number}']\")?.textContent)")
        assert page.evaluate("window.first")
        worker.join()
        page.wait_for_function("() => document.documentElement.dataset.drawn === '5'")
        assert "failed" in page.locator("tr[data-number='2']").inner_text()
        listed.wait_for_function("() => document.querySelector('#studies tr').children[1].textContent === '4'")
        assert page.locator("#counts").inner_text().startswith("5 trials:")
        assert page.wrong == listed.wrong == []


def test_the_server_going_away_is_said_and_its_return_too(open_page, store, serve):
    with serve(store) as where:
        page = open_page(f"{where}/studies/1", wait=DRAWN)
        assert page.locator("#state").inner_text() == "live"
    page.wait_for_function("() => document.getElementById('state').textContent.includes('no connection')")
    port = int(where.rpartition(":")[2])
    with serve(store, port=port):
        page.wait_for_function("() => document.getElementById('state').textContent === 'live'")
    page.wait_for_function("() => document.getElementById('state').textContent.includes('no connection')")
    with serve(store, port=port, token=TOKEN):
        page.wait_for_function("() => document.getElementById('state').textContent.includes('refuses')")


def test_two_thousand_trials(open_page, tmp_path, serve):
    """The table begins with some lines; its further lines come when one scrolls, so that a long study is there as soon as a short one."""
    config, path = charging(), tmp_path / "big.sqlite"
    space = config.problem().space
    with Store(path) as opened:
        identity = {"config": config.document(), "space": space_to_json(space), "tuner": {}, "seed": 0, "batch": 1}
        record = opened.add_study("big", identity)
        opened.add_trials(record.id, [Trial(n, tuple(space.default)) for n in range(2000)])
        for n in range(0, 2000, 100):
            score = Score(-0.1 - 1e-4 * n, -1.0, {"voltage_max_V": -0.01}, {"voltage_max_V": 0.0}, {"t80_min": 20.0 + 1e-2 * n})
            opened.finish_trial(record.id, n, score=score, ending="done", trace=None, provenance={})
    with serve(path) as where:
        open_page(where, wait="#studies tr")
        page = open_page(f"{where}/studies/1", wait="#rows tr")
        assert page.locator("#counts").inner_text().startswith("2000 trials")
        before = page.locator("#rows tr").count()
        assert before < 500
        page.evaluate("document.getElementById('table').scrollTop = 1e6")
        page.wait_for_function(f"() => document.querySelectorAll('#rows tr').length > {before}")
        page.wait_for_selector(DRAWN, state="attached")
        losses, excesses = page.evaluate(MANY)
        assert 1234 in losses
        assert 777 in excesses
        assert max(len(losses), len(excesses)) <= 450
        assert page.wrong == []
