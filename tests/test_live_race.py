"""The game on the live pages, and the story's figures: played in a Chromium, from the disk."""

import json

# The worker of a race has a clock that runs four times as fast; the page's own stays true.
CLOCK = """;{
    const [now, later] = [performance.now.bind(performance), setTimeout.bind(globalThis)]
    performance.now = () => 4 * now()
    globalThis.setTimeout = (act, wait) => later(act, wait / 4)
}"""
FASTER = """{
    const Plain = Blob
    globalThis.Blob = class extends Plain {
        constructor(parts, options) {
            super(options?.type === "text/javascript" ? [...parts, CLOCK] : parts, options)
        }
    }
}""".replace("CLOCK", json.dumps(CLOCK))


def phase(page, wanted):
    """Wait for a phase of the race."""
    page.wait_for_selector(f"#live[data-phase={wanted}]")


def test_a_race_begins_with_one_key_scores_pauses_and_goes_on(opened):
    page = opened("race", reduced_motion="reduce")
    phase(page, "attract")
    page.keyboard.down("ArrowUp")
    phase(page, "race")
    page.wait_for_function("Number(document.querySelector('#your-score').textContent) > 20")
    page.keyboard.press("p")
    phase(page, "paused")
    frames = page.evaluate("stad.page.state.you.frames")
    page.wait_for_timeout(100)
    assert page.evaluate("stad.page.state.you.frames") == frames
    assert "Paused" in page.inner_text("#card")
    page.keyboard.press("ArrowLeft")
    phase(page, "race")
    page.wait_for_function(f"stad.page.state.you.frames > {frames}")
    page.evaluate("dispatchEvent(new Event('blur'))")
    phase(page, "paused")


GAMEPAD = """() => {
    const buttons = Array.from({ length: 8 }, () => ({ value: 0 }))
    globalThis.trigger = buttons[7]
    navigator.getGamepads = () => [{ axes: [0], buttons }]
}"""


def test_a_gamepad_begins_a_race_but_holding_it_does_not_end_a_pause(opened):
    page = opened("race", reduced_motion="reduce")
    page.evaluate(GAMEPAD)
    page.evaluate("trigger.value = 0.05")  # a worn one, which nobody holds
    assert stays(page, "attract")
    page.evaluate("trigger.value = 0.5")
    phase(page, "race")
    page.wait_for_function("stad.page.state.action[1] === 0.5")
    page.keyboard.press("p")
    phase(page, "paused")
    page.wait_for_timeout(200)
    assert page.get_attribute("#live", "data-phase") == "paused"
    page.evaluate("trigger.value = 0")
    page.wait_for_timeout(100)
    page.keyboard.press("p")
    phase(page, "race")
    page.wait_for_function("stad.page.state.action[1] === 0")
    page.click("#auto")
    page.wait_for_selector("#auto[aria-pressed=true]")
    page.evaluate("trigger.value = 0.5")
    page.wait_for_selector("#auto[aria-pressed=false]")


def stays(page, wanted):
    """Whether a phase lasts, long enough for the worker to answer."""
    page.wait_for_timeout(100)
    return page.get_attribute("#live", "data-phase") == wanted


def test_esc_gives_the_arrow_keys_to_the_page_and_a_text_field_has_its_letters(opened):
    page = opened("race", reduced_motion="reduce", viewport={"width": 1000, "height": 500})
    page.keyboard.press("ArrowDown")  # to brake before a race is no wish to race
    assert stays(page, "attract") and page.evaluate("scrollY") > 0
    page.keyboard.press("ArrowUp")
    phase(page, "race")
    page.evaluate("scrollTo(0, 0)")
    page.keyboard.press("Escape")
    phase(page, "paused")
    assert "Press P or click the picture" in page.inner_text("#card")
    page.keyboard.press("ArrowDown")
    page.keyboard.press("ArrowUp")
    page.keyboard.press("ArrowDown")
    assert stays(page, "paused") and page.evaluate("scrollY") > 0
    page.keyboard.press("p")
    phase(page, "race")
    page.keyboard.press("Escape")
    phase(page, "paused")
    page.focus("#seat")
    page.keyboard.press("ArrowLeft")
    phase(page, "race")
    page.focus("#auto")
    page.keyboard.press("p")  # this disables the button, which takes no keys then
    phase(page, "paused")
    page.wait_for_timeout(50)
    page.keyboard.press("p")
    phase(page, "race")
    page.evaluate("race.insertAdjacentHTML('afterend', '<input id=search style=position:fixed>')")
    page.focus("#search")
    page.keyboard.type("wasd dream p")
    assert page.input_value("#search") == "wasd dream p"
    assert page.get_attribute("#live", "data-phase") == "race" and page.is_hidden("#dream")


def test_out_of_sight_no_key_begins_a_race_and_the_demonstration_stands_still(opened):
    page = opened("race")
    frames = "stad.page.state.rival.frames"
    page.click("#pause")
    assert page.inner_text("#pause") == "Play"
    page.wait_for_timeout(100)
    begun = page.evaluate(frames)
    assert stays(page, "attract") and page.evaluate(frames) == begun
    page.keyboard.press("p")
    page.wait_for_function(f"{frames} > {begun}")
    page.evaluate("live.insertAdjacentHTML('afterend', '<p style=height:200vh>')")
    page.evaluate("scrollTo(0, 1e6)")
    page.wait_for_timeout(200)
    begun = page.evaluate(frames)
    page.keyboard.press("ArrowUp")  # the button of the race has the focus
    assert stays(page, "attract") and page.evaluate(frames) == begun


def test_another_rival_in_a_pause_ends_the_race_and_its_dream(opened):
    page = opened("race", reduced_motion="reduce")
    page.keyboard.down("ArrowUp")
    phase(page, "race")
    page.wait_for_function("stad.page.state.you.frames > 10")
    page.click("#auto")
    page.focus("#seat")
    page.keyboard.press("e")
    page.keyboard.press("p")
    phase(page, "paused")
    page.select_option("#agent", "input")
    phase(page, "attract")
    assert page.is_hidden("#dream") and page.get_attribute("#auto", "aria-pressed") == "false"


SLOW = """() => {
    const load = stad.loadTensors
    stad.loadTensors = async (name) => {
        await new Promise((done) => (globalThis.arrive ??= []).push(done))
        return load(name)
    }
}"""


def test_no_race_begins_before_a_rival_that_loads_slowly_is_there(opened):
    page = opened("race", reduced_motion="reduce")
    phase(page, "attract")
    page.evaluate(SLOW)
    page.select_option("#agent", "input")
    page.focus("#seat")
    page.keyboard.press("ArrowUp")
    assert stays(page, "attract") and "is being loaded" in page.inner_text("#card-way")
    page.evaluate("arrive.forEach((done) => done())")
    page.wait_for_function("!document.querySelector('#card-way').textContent.includes('loaded')")
    page.keyboard.press("ArrowUp")
    phase(page, "race")
    page.wait_for_function("stad.page.state.you.frames > 10")


def test_a_race_that_was_begun_goes_on_when_another_rival_does_not_arrive(opened):
    page = opened("race", reduced_motion="reduce")
    page.click("#again")
    phase(page, "race")
    page.evaluate("() => { stad.loadTensors = async () => { throw new Error('lost') } }")
    page.select_option("#agent", "input")
    page.wait_for_selector("#live[data-state=failed]")
    page.click("#pause")
    phase(page, "paused")
    page.click("#pause")
    phase(page, "race")


def test_without_its_files_a_rival_is_not_raced_and_another_one_is(opened):
    page = opened("race", reduced_motion="reduce")
    phase(page, "attract")
    page.evaluate("() => { stad.loads = stad.loadTensors }")
    page.evaluate("() => { stad.loadTensors = async () => { throw new Error('lost') } }")
    page.select_option("#agent", "input")
    page.wait_for_function("document.querySelector('#card-way').textContent.includes('another')")
    for start in ("#again", "#race"):
        page.click(start)
        assert stays(page, "attract")
    page.evaluate("() => { stad.loadTensors = stad.loads }")
    page.select_option("#agent", "output")
    page.wait_for_function("!document.querySelector('#card-way').textContent.includes('another')")
    page.click("#again")
    phase(page, "race")


def test_a_button_that_starts_a_race_brings_it_into_the_window(opened):
    page = opened("race", viewport={"width": 844, "height": 390}, has_touch=True)
    page.tap("#again")
    phase(page, "race")
    box = page.locator("#race").bounding_box()
    shown = min(box["y"] + box["height"], 390) - max(box["y"], 0)
    assert shown > 0.9 * box["height"]
    page.wait_for_function("stad.page.state.you.pose.speed > 10")  # a finger gives gas by itself


def test_the_easy_way_gives_no_gas_above_60_until_it_is_switched_off(opened):
    page = opened("race", script=FASTER)
    page.keyboard.down("ArrowUp")
    phase(page, "race")
    page.wait_for_function("stad.page.state.you.frames > 200")
    assert 50 < page.evaluate("stad.page.state.you.pose.speed") < 63
    page.uncheck("#easy")
    page.keyboard.up("ArrowUp")
    page.keyboard.down("ArrowUp")  # the box has the focus, and the keys drive all the same
    page.wait_for_function("stad.page.state.you.pose.speed > 70")


def test_the_easy_way_holds_for_a_gamepad_too(opened):
    page = opened("race", script=FASTER, reduced_motion="reduce")
    page.evaluate(GAMEPAD)
    page.evaluate("trigger.value = 1")
    page.wait_for_function("stad.page.state.action[1] === 1")
    page.wait_for_function("stad.page.state.you.frames > 200")
    assert 50 < page.evaluate("stad.page.state.you.pose.speed") < 70  # its wheels spin on
    page.uncheck("#easy")
    page.wait_for_function("stad.page.state.you.pose.speed > 80")


def test_closed_eyes_show_the_dream_while_the_car_drives_on(opened):
    page = opened("race", script=FASTER)
    page.keyboard.down("ArrowUp")
    phase(page, "race")
    page.wait_for_function("stad.page.state.you.frames > 20")
    page.keyboard.press("e")
    page.wait_for_selector("#dream:not([hidden])")
    page.wait_for_function("stad.page.state.asleep && stad.page.state.you.frames > 40")
    page.keyboard.press("e")
    page.wait_for_selector("#dream", state="hidden")


def test_the_address_leads_to_the_same_track_and_rival(opened):
    first, second = (opened("race", "#track=19&agent=input") for _ in range(2))
    paths = [page.evaluate("Array.from(stad.page.track.path)") for page in (first, second)]
    assert paths[0] == paths[1]
    assert first.input_value("#agent") == "input" and first.inner_text("#seed") == "19"
    first.click("#another")
    first.wait_for_function("stad.page.track.seed !== 19")
    seed = first.evaluate("stad.page.track.seed")
    assert first.evaluate("location.hash") == f"#track={seed}&agent=input"


def test_a_finger_steers_with_gas_by_itself(opened):
    page = opened("race", viewport={"width": 390, "height": 844}, has_touch=True)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    forget = "Object.defineProperty(event, 'pointerType', { value: undefined })"  # as Safari 16
    page.evaluate(f"document.addEventListener('click', (event) => {forget}, true)")
    page.tap("#race")
    phase(page, "race")
    page.wait_for_function("stad.page.state.you.pose.speed > 10")
    assert abs(page.evaluate("stad.page.state.action[0]")) < 1e-6
    box = page.locator("#race").bounding_box()
    down = {"pointerType": "touch", "pointerId": 7, "bubbles": True, "isPrimary": True}
    down |= {"clientX": box["x"] + 20, "clientY": box["y"] + 200}
    page.evaluate("(on) => { race.setPointerCapture = () => {}; "
                  "race.dispatchEvent(new PointerEvent('pointerdown', on)) }", down)  # fmt: skip
    page.wait_for_function("stad.page.state.action[0] < -0.5")
    slide = down | {"clientX": box["x"] + box["width"] - 20}
    page.evaluate("(on) => race.dispatchEvent(new PointerEvent('pointermove', on))", slide)
    page.wait_for_function("stad.page.state.action[0] > 0.5")
    page.click("#eyes")  # the dream and the scores lie over the canvas
    page.wait_for_selector("#dream:not([hidden])")
    top = "([x, y]) => document.elementFromPoint(x, y).id"
    middle = [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]
    for point in (middle, [box["x"] + 20, box["y"] + 20]):
        assert page.evaluate(top, point) == "race"


ANOTHER_TAB = "localStorage.setItem('stad-race', '{\"7\": 900}')"  # has driven meanwhile


def test_a_lap_with_the_autopilot_is_no_record_and_a_record_leaves_those_of_other_tabs(opened):
    page = opened("race", "#track=5&agent=input_output", FASTER)
    page.keyboard.down("ArrowUp")
    phase(page, "race")
    page.click("#auto")
    page.wait_for_function("stad.page.state.you.frames > 60 && stad.page.state.helped")
    page.click("#auto")  # by hand, off the road and out of the field
    page.keyboard.down("ArrowUp")
    page.wait_for_selector("#live[data-phase=over]", timeout=60_000)
    assert page.evaluate("localStorage.getItem('stad-race')") is None
    page.evaluate(ANOTHER_TAB)
    assert "autopilot" in page.inner_text("#card")
    page.wait_for_timeout(1600)  # a key that is still down begins nothing by chance
    page.keyboard.up("ArrowUp")
    page.keyboard.down("ArrowUp")  # the button for the autopilot had the focus
    page.wait_for_function("!stad.page.state.helped && stad.page.state.phase === 'race'")
    page.wait_for_selector("#live[data-phase=over]", timeout=60_000)
    kept = page.evaluate("JSON.parse(localStorage.getItem('stad-race'))")
    assert kept["7"] == 900 and "5" in kept


CLICK_ALL = "(one) => one.querySelectorAll('button').forEach((button) => button.click())"
STORY = ("speed", "eye", "dream", "wheel", "breed", "study", "hairpin")


def bring_near(page, name):
    """Scroll a figure of the story into sight, and wait until it is ready."""
    figure = page.locator(f"[data-figure={name}]")
    figure.evaluate("(one) => one.scrollIntoView({ block: 'center' })")
    page.wait_for_selector(f"[data-figure={name}][data-state=ready]")
    return figure


def test_every_figure_of_the_story_works_when_it_comes_near_and_bears_impatient_clicks(opened):
    page = opened("story", viewport={"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    for name in STORY:
        figure = bring_near(page, name)
        for _ in range(3):
            figure.evaluate(CLICK_ALL)
        page.wait_for_timeout(50)
        assert figure.get_attribute("data-state") == "ready"


def test_the_bend_that_the_agent_leaves_is_driven_live(opened):
    page = opened("story", reduced_motion="reduce")
    figure = bring_near(page, "hairpin")
    marks = figure.locator("[data-part=map]")
    for _ in range(10):
        marks.press("ArrowLeft")
    go = figure.locator("[data-part=go]")
    go.click()
    go.click()
    assert go.inner_text() == "Go on"
    for name in ("study", "hairpin"):  # a pause lasts while the reader looks elsewhere
        show = "(one) => one.scrollIntoView({ block: 'center' })"
        page.locator(f"[data-figure={name}]").evaluate(show)
        page.wait_for_timeout(100)
    assert go.inner_text() == "Go on"
    go.click()
    page.wait_for_function("document.querySelector('[data-figure=hairpin] strong').textContent")
    assert "689 points" in figure.locator("[data-part=answer]").inner_text()


SHORT_DREAMS = """() => {
    const { step } = stad.Dream.prototype
    stad.Dream.prototype.step = function (action) {
        step.call(this, action)
        this.frames += 99
    }
}"""
COUNT_DRIVES = """() => {
    const drive = stad.inBackground
    globalThis.drives = 0
    stad.inBackground = (work) => (drives++, drive(work))
}"""


def test_the_button_of_the_dreams_says_what_it_does(opened):
    page = opened("story")
    figure = bring_near(page, "dream")
    play, again = (figure.locator(f"[data-part={name}]") for name in ("play", "again"))
    figure.locator("[data-part=bets] button").first.click()
    play.get_by_text("Pause").wait_for()
    play.click()
    assert play.inner_text() == "Go on"
    page.evaluate(COUNT_DRIVES)
    again.evaluate("(button) => [button.click(), button.click()]")
    play.get_by_text("Pause").wait_for()
    assert page.evaluate("drives") == 1  # there is one car
    page.evaluate(SHORT_DREAMS)
    play.get_by_text("Again").wait_for()
    assert "of the three" in figure.locator("[data-part=answer]").inner_text()  # the bet is settled
    play.click()
    page.wait_for_function("drives === 2")


MOVES_THE_PAGE = """() => {
    const key = { code: "ArrowDown", key: "ArrowDown", bubbles: true, cancelable: true }
    return document.body.dispatchEvent(new KeyboardEvent("keydown", key))
}"""


def test_the_reader_of_the_story_drives_as_long_as_c_and_gets_the_arrow_keys_back(opened):
    page = opened("story")
    figure = bring_near(page, "wheel")
    answer, seconds = (figure.locator(f"[data-part={name}]") for name in ("answer", "seconds"))
    in_seat = "document.activeElement.closest('[data-part=seat]') !== null"
    figure.locator("[data-part=you]").click()
    seconds.get_by_text("Take over in 2").wait_for()
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("Escape")
    assert "stopped after" in answer.inner_text()
    assert page.evaluate(MOVES_THE_PAGE)
    figure.locator("[data-part=you]").click()
    assert not page.evaluate(MOVES_THE_PAGE)
    assert page.evaluate(in_seat)
    page.evaluate("scrollTo(0, 0)")
    page.wait_for_function(f"!({in_seat})")
    assert page.evaluate(MOVES_THE_PAGE)
    page.evaluate("stad.Dream.prototype.step = function () { this.frames += 25 }")  # stays on it
    bring_near(page, "wheel")
    for name in ("you", "agent"):
        figure.locator(f"[data-part={name}]").click()
        answer.get_by_text("to the end").wait_for()
        assert seconds.inner_text() == "20.0 s"
        figure.locator("[data-part=seat]").press("ArrowUp")  # not so soon
        assert "to the end" in answer.inner_text()
