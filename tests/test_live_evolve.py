"""The page that evolves a driver: in a Chromium, from the disk."""

import numpy as np
import pytest
from test_live import LOSE

from stad_lab.agent import drive, load_agent
from stad_lab.io.weights import load_controller

SMALL = "#seed=3&population=12&agent=frame"
LOG = """(count) => stad.page.log.slice(0, count).map(({ scores, mean, laps, checksum }) =>
    ({ scores, mean, laps, checksum }))"""
# Evolutions with other settings, which other links have led to.
OTHERS = """[4, 5, 4].forEach((seed) => {
    const settings = { ...stad.evolveSettings.fromAddress(), seed }
    stad.evolveSettings.keep({ settings, log: [], bet: null })
})"""
FAIL_ONCE = """() => {
    const make = stad.controllerFile
    stad.controllerFile = async () => {
        stad.controllerFile = make
        throw new Error("no download")
    }
}"""
TILE = 1000 / 200  # points; a track has more tiles


SHORT = "globalThis.stad = { get LONGEST() { return 60 }, set LONGEST(_) {} }"  # frames


def evolve(page, generations):
    """Drive so many more generations, one by one."""
    for _ in range(generations):
        done = page.evaluate("stad.page.log.length")
        page.press("#step", "Enter")
        page.wait_for_function(f"stad.page.log.length > {done} && !stad.page.busy")


@pytest.fixture(scope="module")
def running(browser, live_pages):
    """A page after a small generation, which draws seldom, and its errors."""
    page, errors = (
        browser.new_page(reduced_motion="reduce", viewport={"width": 800, "height": 500}),
        [],
    )
    page.set_default_timeout(60_000)  # milliseconds: a busy machine is no fault
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("request", lambda one: one.url.startswith("http") and errors.append(one.url))
    page.goto((live_pages / "evolve.html").as_uri() + SMALL)
    page.wait_for_selector("#live[data-state=ready]")
    evolve(page, 1)
    yield page, errors
    page.close()


@pytest.fixture
def evolved(running):
    """A page after one or more generations: a generation takes seconds, so tests share the page."""
    page, errors = running
    yield page
    assert not errors


def test_after_a_reload_evolution_goes_on_as_it_would_have(evolved):
    page, done = evolved, evolved.evaluate("stad.page.log.length")
    page.evaluate(OTHERS)
    page.reload()
    page.wait_for_selector("#live[data-state=ready]")
    assert page.evaluate("stad.page.log.length") == done
    evolve(page, 1)
    resumed = page.evaluate(LOG, done + 1)
    page.click("summary")
    page.fill("#seed", "-5")
    page.click("#restart")
    assert "-5" in page.inner_text("#warning")
    page.fill("#seed", "3")
    page.evaluate(FAIL_ONCE)
    page.click("#download")
    page.wait_for_function("document.querySelector('#answer').innerText === 'no download'")
    page.dblclick("#restart")  # this asks, so nothing is lost by it
    assert f"generation {done + 1}" in page.inner_text("#warning")
    assert page.evaluate("stad.page.log.length") == done + 1
    page.click("#restart")
    page.wait_for_function("stad.page.log.length === 0")
    evolve(page, done + 1)
    assert page.evaluate(LOG, done + 1) == resumed


STOP = """() => {
    const [run, step] = ["run", "step"].map(stad.get)
    run.click()
    const before = step.textContent
    step.click()
    return [before, step.textContent]
}"""


def test_the_button_that_stops_after_a_generation_says_that_it_will(evolved):
    done = evolved.evaluate("stad.page.log.length")
    assert evolved.evaluate(STOP) == ["Stop after this generation", "Stops after this generation"]
    evolved.wait_for_function("!stad.page.busy")
    assert evolved.evaluate("stad.page.log.length") <= done + 1  # none, if none had begun


def test_networks_that_do_not_arrive_leave_the_evolution_as_it_was(evolved):
    page, done = evolved, evolved.evaluate("stad.page.log.length")
    page.evaluate(LOSE)
    page.evaluate("document.querySelector('#live details').open = true")
    page.select_option("#agent", "input")
    page.click("#restart")
    page.click("#restart")  # the first click asks
    page.wait_for_selector("#live[data-state=failed]")
    assert "agent=frame" in page.get_attribute("#race", "href")
    evolve(page, 1)
    assert page.evaluate("stad.page.log.length") == done + 1
    assert page.get_attribute("#live", "data-state") == "ready"


def test_the_latest_few_evolutions_are_kept_and_a_link_goes_on_with_its_own(opened):
    page = opened("evolve", SMALL, SHORT)
    page.evaluate(OTHERS.replace("[4, 5, 4]", "[1, 2, 4, 5, 4]"))
    kept = page.evaluate("stad.evolveSettings.all.map(({ settings }) => settings.seed)")
    assert kept == [4, 5, 2]
    evolve(page, 1)
    page.evaluate("location.hash = location.hash.replace('seed=3', 'seed=5')")
    page.wait_for_function("stad.page.log.length === 0")
    page.evaluate("location.hash = location.hash.replace('seed=5', 'seed=3')")
    page.wait_for_function("stad.page.log.length === 1")
    page.evaluate("location.hash = 'population=24'")  # the others are the page's own
    page.wait_for_function("document.querySelector('#population').value === '24'")


KEEP = """() => {
    const [latest] = stad.evolveSettings.all
    const changed = [...latest.log.slice(0, -1), { ...latest.log.at(-1), checksum: "another" }]
    const kept = [latest.log.slice(0, -1), changed, latest.log].map((log) => {
        stad.evolveSettings.keep({ ...latest, log })
        return stad.evolveSettings.all[0].log.at(-1).checksum
    })
    return [latest.log.at(-1).checksum, ...kept]
}"""


def test_another_tab_that_is_behind_in_an_evolution_takes_no_generation_from_it(evolved):
    latest, *kept = evolved.evaluate(KEEP)
    assert kept == [latest, "another", latest]


def test_a_driver_from_the_page_scores_the_same_in_python(evolved, tmp_path):
    done = evolved.evaluate("stad.page.log.length")
    with evolved.expect_download() as started:
        evolved.click("#download")
    file = tmp_path / started.value.suggested_filename
    started.value.save_as(file)
    parameters, metadata = load_controller(file)
    assert np.array_equal(parameters[:32], evolved.evaluate("stad.page.states.at(-1).mean")[:32])
    assert metadata["generation"] == done and metadata["seed"] == 3
    # The next generation lets this mean drive along.
    evolve(evolved, 1)
    (page_score,) = evolved.evaluate("stad.page.log.at(-1).mean")
    track = evolved.evaluate("stad.page.view.map.track.seed")
    agent = load_agent("frame", file)
    (score,) = drive(agent, [track], patience=50).returns
    # z differs by rounding, so a car may touch a tile a moment earlier or later.
    assert score == pytest.approx(page_score, abs=2 * TILE)


def test_the_evolved_driver_is_the_rival_in_the_race_until_an_address_has_none(evolved, opened):
    address = evolved.get_attribute("#race", "href")
    race = opened("race", address[address.index("#") :])
    assert race.input_value("#agent") == "evolved"
    text = address.rpartition("driver=")[2]
    driver = race.evaluate("(text) => [...stad.unpackDriver(text, 32, 256)]", text)
    assert driver == evolved.evaluate("stad.page.states.at(-1).mean")
    race.evaluate("location.hash = '#track=5&agent=frame'")
    race.wait_for_function("document.querySelector('#card-title').innerText === 'Beat the agent'")
    race.wait_for_selector("#live[data-state=ready]")  # or it would not notice the next address
    assert race.input_value("#agent") == "frame"
    race.evaluate("(hash) => { location.hash = hash }", address[address.index("#") :])
    race.wait_for_function("document.querySelector('#agent').value === 'evolved'")
    race.wait_for_selector("#live[data-state=ready]")
    race.select_option("#agent", "input")
    assert "driver" not in race.evaluate("location.hash")


def test_impatient_clicks_break_no_evolution(opened):
    page = opened("evolve", SMALL, SHORT, viewport={"width": 390, "height": 844})
    page.evaluate(
        """for (let i = 0; i < 60; i++) {
            const buttons = [...document.querySelectorAll("#live button")]
            buttons[(7 * i) % buttons.length].click()
        }"""
    )
    page.wait_for_function("!stad.page.busy")
    page.evaluate("restart.click()")
    page.evaluate("stad.page.log.length && restart.click()")
    page.wait_for_function("stad.page.log.length === 0")
    evolve(page, 1)
    assert page.get_attribute("#live", "data-state") == "ready"
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
