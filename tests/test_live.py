"""The live pages in a headless Chromium, from the disk: V, M, C and the dream equal the Python."""

import os
import shutil
import subprocess
import time
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

import numpy as np
import pytest
import torch
from test_live_engine import LOAD, compare_episode

from stad_course.play.session import Hand
from stad_lab.agent import load_agent
from stad_lab.config import VARIANTS
from stad_lab.models.controller import control
from stad_lab.models.vae import to_array, to_tensor

LIVE = Path(__file__).parent.parent / "docs" / "live"

CLOSE = 1e-5
SLOW = 60_000  # milliseconds to wait for anything: a busy machine is no fault
MEGABYTES = 6  # of a page, its scripts and its data


def megabytes(page):
    """The size of all that a page has loaded; an AssertionError if it used a network."""
    loaded = [one for one in page.loaded if not one.startswith("data:")]
    assert all(one.startswith("file://") for one in loaded)
    files = [Path(url2pathname(urlsplit(one).path)) for one in loaded]
    return sum(file.stat().st_size for file in files) / 1e6


@pytest.fixture(scope="module")
def still_page(browser, live_pages):
    """The page on the dream, where nothing moves by itself, for tests that only compute."""
    page = browser.new_page(reduced_motion="reduce")
    page.set_default_timeout(SLOW)
    page.goto((live_pages / "dream.html").as_uri())
    page.wait_for_selector("#live[data-state=ready]")
    return page


def some_frames(rng):
    """Two random frames of smooth shapes: uint8 (2, 64, 64, 3)."""
    coarse = rng.integers(0, 256, (2, 8, 8, 3), np.uint8)
    return coarse.repeat(8, axis=1).repeat(8, axis=2)


V_IN_THE_PAGE = """async ([variant, frame, earlier, z]) => {
    const vae = await stad.VAE.load(variant)
    const pictures = [frame, earlier].map((one) => Uint8Array.from(one))
    const mu = vae.encodeMean(...pictures)
    const decoded = vae.decode(Float32Array.from(z))
    return [mu, decoded.frame, decoded.difference].map((one) => one && Array.from(one))
}"""


def test_every_v_encodes_and_decodes_random_inputs_as_in_python(opened, rng):
    page = opened("latent", reduced_motion="reduce")
    for variant in VARIANTS:
        vae = load_agent(variant).vae
        frames, z = some_frames(rng), rng.normal(0, 1.5, 32).astype(np.float32)
        inputs = [variant, *(one.ravel().tolist() for one in (*frames, z))]
        found = page.evaluate(V_IN_THE_PAGE, inputs)
        frame, earlier = frames / np.float32(255)
        pictures = (to_tensor(one[None]) for one in (frame, frame - earlier))
        with torch.no_grad():
            mu, _ = vae.encode(*pictures)
            decoded = vae.decode(torch.from_numpy(z)[None])
        decoded = [None if one is None else to_array(one) for one in decoded]
        for ours, theirs in zip(found, [mu.numpy(), *decoded], strict=True):
            assert (ours is None) == (theirs is None)
            if ours is not None:
                np.testing.assert_allclose(ours, theirs.ravel(), rtol=0, atol=CLOSE)
    assert megabytes(page) < MEGABYTES


M_IN_THE_PAGE = """async ([latents, actions, parameters]) => {
    const [mdnRnn, shipped] = [await stad.MDNRNN.load("input_output"), parameters]
    let state = mdnRnn.emptyState()
    return latents.map((row, t) => {
        const z = Float32Array.from(row)
        const action = stad.control(shipped, z, state.h)
        state = mdnRnn.remember(z, Float32Array.from(actions[t]), state)
        const { logits, mean, logsigma } = mdnRnn.mixture(state.h)
        return [state.h, state.c, logits, mean, logsigma, action].map((one) => Array.from(one))
    })
}"""
DREAM_IN_THE_PAGE = """([z, uniforms, normals, temperature]) => {
    const { mdnRnn, controller, vae } = stad.page
    const [uniform, normal] = [uniforms, normals].map((numbers) => () => numbers.shift())
    const dream = new stad.Dream(mdnRnn, z, mdnRnn.emptyState(), { uniform, normal })
    dream.temperature = temperature
    const steps = []
    while (normals.length) {
        const before = { z: dream.z, ...dream.state }
        const action = stad.control(controller, dream.z, dream.state.h)
        dream.step(action)
        const step = { ...before, action, next: dream.z }
        steps.push(Object.values(step).map((one) => Array.from(one)))
    }
    return [steps, Array.from(vae.decode(dream.z).frame)]
}"""


def test_m_predicts_and_c_acts_as_in_python_over_200_steps(still_page, rng):
    page, agent = still_page, load_agent("input_output")
    latents = rng.normal(0, 1, (200, 32)).astype(np.float32)
    actions = rng.uniform([-1, 0, 0], 1, (200, 3)).astype(np.float32)
    parameters = agent.parameters + rng.normal(0, 0.1, agent.parameters.shape)
    rows = page.evaluate(M_IN_THE_PAGE, [latents.tolist(), actions.tolist(), parameters.tolist()])
    h, c, logits, mean, logsigma, acted = (np.array(part) for part in zip(*rows, strict=True))
    z, done = torch.from_numpy(latents)[None], torch.from_numpy(actions)[None]
    with torch.no_grad():
        mixture, state = agent.mdn_rnn(z, done)
        hidden = agent.mdn_rnn.remember(z, done)[0][0].numpy()
    before = np.concatenate([np.zeros((1, 256), np.float32), hidden[:-1]])
    expected = control(parameters, np.concatenate([latents, before], axis=1))
    logpi = torch.from_numpy(logits).view(200, 32, 5).log_softmax(-1).numpy()
    for ours, theirs in (
        (h, hidden),
        (c[-1], state[1][0, 0].numpy()),
        (logpi, mixture.logpi[0].numpy()),
        (mean.reshape(200, 32, 5), mixture.mean[0].numpy()),
        (logsigma.reshape(200, 32, 5), mixture.logsigma[0].numpy()),
        (acted, expected),
    ):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=CLOSE)


@torch.no_grad()
def compare_dream(evaluate, rng, temperature, steps):
    """Dream with C in the page; Python computes each step again, from the page's own state.

    From its own it would soon be elsewhere: a dream amplifies the rounding of each step.
    """
    agent, first = load_agent("input_output"), rng.standard_normal(32)
    uniform, normal = rng.uniform(size=(steps, 32)), rng.standard_normal((steps, 32))
    noise = [uniform.ravel().tolist(), normal.ravel().tolist()]
    found, frame = evaluate(DREAM_IN_THE_PAGE, [first.tolist(), *noise, temperature])
    z, h, c, action, following = (np.array(part, np.float32) for part in zip(*found, strict=True))
    expected = control(agent.parameters, np.concatenate([z, h], axis=1))
    np.testing.assert_allclose(action, expected, rtol=0, atol=CLOSE)
    state = tuple(torch.from_numpy(one)[None] for one in (h, c))
    given = (torch.from_numpy(one)[:, None] for one in (z, action))
    logpi, mean, logsigma = (part[:, 0] for part in agent.mdn_rnn(*given, state)[0])
    bounds = (logpi / temperature).softmax(-1).cumsum(-1).numpy()[..., :-1]
    chosen = (uniform[..., None] > bounds).sum(axis=-1)[..., None]
    sigma = np.exp(logsigma.numpy()) * np.sqrt(temperature)
    mean, sigma = (np.take_along_axis(one, chosen, -1)[..., 0] for one in (mean.numpy(), sigma))
    clear = np.abs(bounds - uniform[..., None]).min(axis=-1) > 1e-4  # rounding cannot choose
    assert clear.mean() > 0.99
    np.testing.assert_allclose(following[clear], (mean + sigma * normal)[clear], atol=CLOSE)
    decoded = to_array(agent.vae.decode(torch.from_numpy(following[-1:]))[0]).ravel()
    np.testing.assert_allclose(frame, decoded, rtol=0, atol=CLOSE)


def test_a_dream_of_200_steps_with_the_same_noise_is_that_of_python(still_page, rng):
    compare_dream(still_page.evaluate, rng, float(rng.uniform(0.3, 1.2)), 200)


def test_held_keys_make_the_same_actions_as_in_the_package(still_page, rng):
    page, hand = still_page, Hand()
    held = [[p for p in ("left", "right", "gas", "brake") if rng.random() < 0.4] for _ in range(60)]
    found = page.evaluate(
        """(all) => {
            const hand = new stad.Hand()
            return all.map((held) => {
                hand.held = new Map(held.map((pedal) => [pedal, pedal]))
                return Array.from(hand.act())
            })
        }""",
        held,
    )
    for pedals, ours in zip(held, found, strict=True):
        hand.hold(*pedals)
        np.testing.assert_allclose(ours, hand.act(), rtol=0, atol=CLOSE)


def test_the_reader_closes_the_eyes_drives_and_opens_them_with_the_keyboard_alone(opened):
    page = opened("dream", reduced_motion="reduce", viewport={"width": 360, "height": 740})
    page.wait_for_function("stad.page")
    assert page.evaluate("!stad.page.clock.running && !stad.page.dream")  # nothing moves by itself
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    page.locator("#scrub").press("ArrowRight")
    assert page.inner_text("#scrub-value") == "51"
    page.locator("#seat").press("e")
    page.wait_for_function("stad.page.dream?.frames > 3")
    page.keyboard.down("ArrowLeft")
    page.wait_for_function("stad.page.dream.frames > 20")
    assert page.is_checked("input[value=hand]")
    page.wait_for_function("document.querySelector('#dream').ariaLabel.includes('steering -')")
    page.keyboard.up("ArrowLeft")
    page.keyboard.press("e")
    assert page.evaluate("stad.page.dream") is None
    page.locator("#eyes").click()  # after a click the arrow keys steer at once
    page.check("input[value=agent]")
    page.locator("#again").click()
    page.locator("#seat").press("ArrowRight")
    assert page.is_checked("input[value=hand]")
    page.locator("#play").focus()  # and they steer wherever the focus is
    page.keyboard.down("ArrowUp")
    assert page.locator("button[data-pedal=gas].held").count() == 1
    page.keyboard.up("ArrowUp")
    running = page.evaluate("stad.page.clock.running")
    page.keyboard.press("p")
    assert page.evaluate("stad.page.clock.running") is not running
    page.keyboard.press("p")  # the dream goes on
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("Escape")  # gives the keys back, and the dream waits
    page.evaluate("scrollTo(0, 0)")
    page.keyboard.press("ArrowDown")
    page.wait_for_function("scrollY > 0 && !stad.page.clock.running")
    page.keyboard.press("p")
    assert page.evaluate("stad.page.clock.running")


def test_impatient_clicks_break_nothing(opened):
    page = opened("dream")
    page.evaluate(
        """() => {
            const buttons = [...document.querySelectorAll("#live button, #live input[type=radio]")]
            for (let i = 0; i < 200; i++) buttons[(7 * i) % buttons.length].click()
            for (const t of [479, 0, 60]) {
                document.querySelector("#scrub").value = t
                document.querySelector("#scrub").dispatchEvent(new Event("input", {bubbles: true}))
                document.querySelector("#eyes").click()
            }
        }"""
    )
    page.wait_for_function("stad.page?.dream?.frames > 5 && stad.page.clock.running")
    assert megabytes(page) < MEGABYTES
    assert page.get_attribute("#live", "data-state") == "ready"


def test_sliders_the_map_and_another_v_change_the_picture_and_reset_brings_it_back(opened):
    page = opened("latent", reduced_motion="reduce")
    picture = page.locator("#decoded")

    def seen():
        return picture.evaluate("canvas => canvas.toDataURL()")

    first = seen()
    pictures = [first]
    for act in (
        lambda: page.locator("#large input").first.press("End"),
        lambda: page.locator("#map").press("Shift+ArrowUp"),
        lambda: page.locator("#map").click(position={"x": 20, "y": 20}),
        lambda: page.locator("#random").click(),
    ):
        act()
        pictures.append(seen())
    page.locator("#reset").click()
    assert seen() == first
    page.locator("input[value=frame]").press(" ")
    page.wait_for_function("document.querySelector('#decodes-difference').innerText[0] === 'T'")
    pictures.append(seen())
    assert len(set(pictures)) == 6
    page.locator("#scrub").press("ArrowRight")
    page.wait_for_function("document.querySelector('#frame').ariaLabel === 'recorded frame 121'")


# The next file of weights does not arrive.
LOSE = """() => {
    const load = stad.loadTensors
    stad.loadTensors = (name) => {
        stad.loadTensors = load
        throw new Error(`${name} did not arrive`)
    }
}"""
CHOOSE = {
    "race": """(name) => {
        document.querySelector("#agent").value = name
        document.querySelector("#agent").dispatchEvent(new Event("change"))
    }""",
    "latent": "(name) => document.querySelector(`input[value=${name}]`).click()",
}


@pytest.mark.parametrize("name", CHOOSE)
def test_after_a_network_that_does_not_arrive_another_one_can_be_chosen(name, opened):
    page = opened(name, reduced_motion="reduce")
    page.evaluate(LOSE)
    page.evaluate(CHOOSE[name], "output")
    page.wait_for_selector("#live[data-state=failed]")
    page.evaluate(CHOOSE[name], "input")
    page.wait_for_selector("#live[data-state=ready]")
    assert page.is_hidden("#message")


@pytest.mark.parametrize("name", ["page", "safetensors", "frames"])
def test_a_page_whose_script_does_not_arrive_says_so(browser, live_pages, tmp_path, name):
    folder = shutil.copytree(live_pages, tmp_path / "live", copy_function=os.link)
    (folder / "js" / f"{name}.js").unlink()
    page = browser.new_page()
    page.set_default_timeout(SLOW)
    page.goto((folder / "dream.html").as_uri())
    text = "A script did not arrive. Please reload the page."
    page.wait_for_function(
        "(text) => document.querySelector('#message').innerText === text", arg=text
    )
    page.close()


READY = """async () => {
    const errors = []
    addEventListener("error", (event) => errors.push(event.message))
    while (document.querySelector("#live").dataset.state === "loading")
        await new Promise((done) => setTimeout(done, 20))
    return [document.querySelector("#live").dataset.state, errors]
}"""


CLOSE_EYES = """() => {
    const button = document.querySelector("#eyes") // the first dream may have begun by itself
    if (button.textContent.startsWith("Close")) button.click()
}"""
PRESS_ALL = """() => {
    const errors = []
    addEventListener("error", (event) => errors.push(event.message))
    for (const button of document.querySelectorAll("#live button")) button.click()
    for (const range of document.querySelectorAll("#live input[type=range]")) {
        range.value = range.max
        range.dispatchEvent(new Event("input", { bubbles: true }))
    }
    return [document.querySelector("#live").dataset.state, errors]
}"""


def test_firefox_opens_every_page_and_dreams_and_drives_as_python(firefox, live_pages, rng):
    for name in ("latent", "nat", "evolution", "evolve", "speeds", "dream"):
        firefox.open((live_pages / f"{name}.html").as_uri())
        assert firefox.evaluate(READY) == ["ready", []]
        if name != "dream":
            assert firefox.evaluate(PRESS_ALL) == ["ready", []]
    firefox.evaluate("() => { scrub.value = 300 }")
    firefox.reload()
    assert firefox.evaluate(READY) == ["ready", []]
    assert firefox.evaluate("() => Number(scrub.value)") < 300  # a value that no script knows
    compare_dream(firefox.evaluate, rng, 1.0, 50)
    state = "() => [stad.page.dream?.frames > 5, document.querySelector('#eyes').textContent]"
    firefox.evaluate(CLOSE_EYES)
    deadline = time.monotonic() + SLOW / 1000
    while firefox.evaluate(state) != [True, "Open the eyes"]:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    firefox.open((live_pages / "story.html").as_uri())
    firefox.evaluate(LOAD)
    compare_episode(firefox.evaluate, int(rng.integers(100_000)), 200)


def test_the_scripts_are_linted_and_formatted():
    if not (LIVE / "node_modules").exists() or not shutil.which("npm"):
        pytest.skip("no eslint: npm install in docs/live")
    run = subprocess.run(["npm", "run", "check"], cwd=LIVE, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
