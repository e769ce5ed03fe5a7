"""The live pages on speeds, the KL weight and evolution: opened from the disk in a Chromium."""

import base64
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from stad_lab.agent import Agent, load_agent, rollout
from stad_lab.envs.cars import Cars
from stad_lab.models.controller import control

LIVE = Path(__file__).parent.parent / "docs" / "live"
sys.path.insert(0, str(LIVE))
import live_build  # noqa: E402
import record_speeds  # noqa: E402

SLOW = 60_000  # milliseconds to wait for anything: a busy machine is no fault
NAMES = ("speeds", "nat", "evolution")


@pytest.fixture(scope="module")
def tabs(browser, live_pages):
    """A page in a tab of a phone's size by its name, and all errors and requests of the network."""
    errors, tabs = [], {}
    for name in NAMES:
        page = tabs[name] = browser.new_page(viewport={"width": 360, "height": 740})
        page.set_default_timeout(SLOW)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("request", lambda one: one.url.startswith("http") and errors.append(one.url))
        page.goto((live_pages / f"{name}.html").as_uri())
    return tabs, errors


@pytest.fixture
def opened(tabs):
    """A function that returns a page when it is ready; no page may have an error."""
    tabs, errors = tabs

    def ready(name):
        tabs[name].bring_to_front()  # a hidden page draws nothing
        tabs[name].wait_for_selector("#live[data-state=ready]")
        return tabs[name]

    yield ready
    assert not errors


def pycma(start, sigma, normals):
    """pycma's strategy on a stream of standard normal numbers (generations, population, n)."""
    import cma  # this takes seconds

    stream = iter(normals)

    def randn(*_):
        # The square root of C is symmetric in ours; pycma's is not, so its numbers are turned.
        return next(stream) @ strategy.sm.B

    options = {"popsize": normals.shape[1], "randn": randn, "seed": np.nan}
    strategy = cma.CMAEvolutionStrategy(start, sigma, options | {"verbose": -9, "verb_log": 0})
    # pycma begins not quite round
    strategy.sm.B[:] = strategy.sm.C[:] = np.eye(len(start))
    strategy.sm.D[:] = 1
    return strategy


# The last has 99 dimensions, as C with z: there C's axes are computed in every other generation.
@pytest.mark.parametrize(
    ("population", "dimensions", "generations", "name"),
    [(6, 2, 15, "rosenbrock"), (13, 2, 15, "rastrigin"), (24, 2, 15, "ellipse"), (6, 99, 7, "")],
)
def test_cma_es_agrees_with_pycma_on_the_same_random_numbers(
    opened, rng, population, dimensions, generations, name
):
    page = opened("evolution")
    normals = rng.standard_normal((generations, population, dimensions))
    start, sigma = rng.uniform(-2, 2, dimensions).tolist(), float(rng.uniform(0.2, 1))
    found = page.evaluate(
        """([normals, start, sigma, name]) => {
            const narrow = (...x) => x.reduce((sum, value, i) => sum + (1 + i) * value ** 2, 0);
            const { f } = stad.landscapes[name] ?? { f: narrow };
            const strategy = new stad.CMAES(start, sigma, normals[0].length);
            return normals.map((some) => {
                const points = strategy.ask(some).map((point) => [...point]);
                const fitness = points.map((point) => f(...point));
                strategy.tell(points, fitness);
                const { mean, sigma } = strategy;
                return { points, fitness, mean, sigma, covariance: [...strategy.covariance] };
            });
        }""",
        [normals.tolist(), start, sigma, name],
    )
    strategy = pycma(start, sigma, normals)
    for ours in found:
        points = strategy.ask()
        np.testing.assert_allclose(ours["points"], points, rtol=1e-9, atol=1e-9)
        strategy.tell(points, ours["fitness"])
        covariance = np.reshape(ours["covariance"], strategy.sm.C.shape)
        np.testing.assert_allclose(ours["mean"], strategy.mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(ours["sigma"], strategy.sigma, rtol=1e-9)
        np.testing.assert_allclose(covariance, strategy.sm.C, rtol=1e-9, atol=1e-9)


def test_the_recorded_controllers_are_those_of_the_shipped_run():
    tensors = live_build.load_file(LIVE / "data" / "evolution_tensors.safetensors")
    shown = json.loads((LIVE / "data" / "evolution.json").read_text("utf-8"))["generations"]
    agent = load_agent("cropped_input")
    first, last = tensors["controllers"][shown.index(0)], tensors["controllers"][shown.index(95)]
    np.testing.assert_allclose(last, agent.parameters, atol=1e-6)
    assert np.count_nonzero(first) == 1 and first[-2] == -0.5  # the gas alone


def test_a_recorded_path_is_what_its_controller_drives():
    tensors = live_build.load_file(LIVE / "data" / "evolution_tensors.safetensors")
    facts = json.loads((LIVE / "data" / "evolution.json").read_text("utf-8"))
    cars, places = Cars(1, "frame", bar=False), []
    cars.reset([facts["tracks"][0]["track"]])
    agent = Agent(load_agent("cropped_input").world_model, tensors["controllers"][-1].astype(float))
    rollout(agent, cars, 76, observe=lambda *_: places.append(cars.cars["position"][0, 0].copy()))
    begin = sum(facts["tracks"][0]["points"][:-1])
    recorded = tensors["paths.0"][begin : begin + 16]  # one in five frames
    np.testing.assert_allclose(places[:: facts["every"]], recorded, atol=0.3)  # of half precision


def test_the_recorded_drive_is_that_of_the_shipped_agent():
    facts = json.loads((LIVE / "data" / "drive.json").read_text("utf-8"))
    actions = np.frombuffer(base64.b64decode(facts["actions"]), "<f4").reshape(-1, 3)
    sheet, agent = np.asarray(Image.open(LIVE / "data" / "drive.webp")), load_agent(facts["agent"])
    for t in range(facts["columns"]):  # the first row of the picture
        frame = sheet[:64, 64 * t : 64 * (t + 1)].copy()
        acted = agent.act_batch(frame[None])[0]
        np.testing.assert_allclose(acted, actions[t], atol=1e-2, err_msg="run record.py")


def test_the_frames_of_the_speeds_are_those_that_the_engine_draws(rng):
    cars = Cars(1, "frame", bar=False)
    cars.reset([record_speeds.TRACK])
    place = int(rng.integers(record_speeds.PLACES))
    sheet = np.asarray(Image.open(LIVE / "data" / "speeds.webp"))
    row = sheet[64 * place : 64 * (place + 1)].astype(int)
    assert np.abs(row - record_speeds.place_row(cars, place)).mean() < 0.1


def test_the_dream_of_a_generation_begins_as_in_python(opened, rng):
    page, agent = opened("evolution"), load_agent("cropped_input")
    tensors = live_build.load_file(LIVE / "data" / "evolution_tensors.safetensors")
    chosen = int(rng.integers(len(tensors["controllers"])))
    found = page.evaluate(
        """async (chosen) => {
            const tensors = await stad.loadTensors("evolution_tensors");
            const mdnRnn = await stad.MDNRNN.load("cropped_input");
            const vae = await stad.VAE.load("cropped_input");
            const row = (name) => tensors[name].data.slice(0, tensors[name].shape[1]);
            const [z, h, c] = ["z", "h", "c"].map((part) => row(`start.${part}`));
            const [, size] = tensors.controllers.shape;
            const parameters = tensors.controllers.data.slice(chosen * size, (chosen + 1) * size);
            const action = stad.control(parameters, z, h);
            const next = mdnRnn.remember(z, action, { h, c });
            const numbers = { frame: vae.decode(z).frame, action, h: next.h, c: next.c };
            for (const name of Object.keys(numbers)) numbers[name] = [...numbers[name]];
            return numbers;
        }""",
        chosen,
    )
    z, h, c = (tensors[f"start.{part}"][:1] for part in "zhc")
    action = control(tensors["controllers"][chosen].astype(float), np.concatenate([z, h], axis=1))
    sight, done = torch.from_numpy(z)[:, None], torch.from_numpy(action)[:, None]
    with torch.no_grad():
        state = (torch.from_numpy(h)[None], torch.from_numpy(c)[None])
        _, (hidden, cell) = agent.mdn_rnn.remember(sight, done, state)
        frame = agent.vae.decode(torch.from_numpy(z))[0].permute(0, 2, 3, 1)
    expected = {"frame": frame, "action": action, "h": hidden, "c": cell}
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], np.ravel(value), atol=1e-5, err_msg=name)


def test_a_generation_shows_its_path_its_points_and_its_dream(opened):
    page = opened("evolution")
    facts = json.loads((LIVE / "data" / "evolution.json").read_text("utf-8"))
    page.wait_for_function("document.querySelector('#dream-text').textContent.match(/ [1-9]/)")
    for place in (0, len(facts["generations"]) - 1):
        page.focus("#generation")
        page.keyboard.press("End" if place else "Home")
        words, generation = page.inner_text("#summary"), facts["generations"][place]
        expected = round(facts["tracks"][0]["returns"][place])
        assert f"{generation}: {expected} points" in words
        assert ("a complete lap in" in words) == facts["tracks"][0]["laps"][place]
        page.wait_for_function(f"track.ariaLabel.includes('Generation {generation}:')")


# No file of weights arrives.
NEVER = "globalThis.stad = { set load(_) {}, get load() { return () => new Promise(() => {}) } }"


def test_cma_es_in_two_dimensions_does_not_wait_for_the_networks(browser, live_pages):
    page = browser.new_page()
    page.add_init_script(NEVER)
    page.goto((live_pages / "evolution.html").as_uri())
    page.click("#step")
    assert "Generation 1" in page.inner_text("#state")
    assert page.get_attribute("#live", "data-state") == "loading"
    page.close()


def test_cma_es_on_the_page_can_be_begun_stepped_by_keyboard(opened):
    page = opened("evolution")
    page.select_option("#landscape", "sphere")
    page.focus("#plane")
    page.keyboard.press("ArrowRight")
    assert "Generation 0" in page.inner_text("#state")
    page.keyboard.press("Enter")
    assert "Generation 1" in page.inner_text("#state")
    page.focus("#step")
    page.evaluate("for (let n = 0; n < 99; n++) stad.get('step').click()")
    assert "at the lowest point" in page.inner_text("#state")
    page.wait_for_timeout(50)
    assert page.evaluate("document.activeElement.id") == "step"
    page.click("#plane", position={"x": 20, "y": 20})
    assert "Generation 0" in page.inner_text("#state")


def test_a_bet_counts_once_and_shows_the_answer(opened):
    page = opened("speeds")
    page.locator("#bets button").first.evaluate("(button) => [button.click(), button.click()]")
    assert page.inner_text("#all-frame") == "1"
    answered = page.inner_text("#answer")
    assert answered.startswith("Right") == (page.inner_text("#right-frame") == "1")
    page.keyboard.press("Enter")  # the focus is on the next car
    assert page.inner_text("#answer") == "" and page.is_visible("#veil")
    page.check("[value=difference]")
    assert not page.is_visible("#veil")
    page.locator("#bets button").last.click()
    assert page.inner_text("#all-difference") == "1" and page.inner_text("#all-frame") == "1"


def test_only_the_difference_image_shows_the_speed(opened):
    page = opened("speeds")
    assert not page.is_visible("#three")  # before a bet nobody needs the answers
    page.click("#all-three summary")
    pixels = "(canvas) => canvas.getContext('2d').getImageData(0, 0, 64, 64).data.join()"
    for stride in ("Home", "End"):
        page.focus("#stride")
        page.keyboard.press(stride)
        frames = [one.evaluate(pixels) for one in page.locator(".frame canvas").all()]
        assert frames[0] == frames[1] == frames[2]
        captions = page.locator(".three .difference figcaption").all_inner_texts()
        changes = [float(text.split()[-1]) for text in captions]
        assert changes[0] == 0 < changes[1] < changes[2]


def test_pictures_and_numbers_follow_the_kl_weight(opened):
    page = opened("nat")
    networks = json.loads((LIVE / "data" / "nat.json").read_text("utf-8"))["networks"]
    page.focus("#weight")
    page.keyboard.press("Home")
    pixels = "(canvas) => canvas.getContext('2d').getImageData(0, 0, 64, 64).data.join()"
    seen = set()
    for network in networks:
        assert f"{network['kl']:.1f} nats" in page.inner_text("#summary")
        active = sum(kl > 0.05 for kl in network["kl_of_latents"])
        assert f" {active} of 32 latents" in page.inner_text("#summary")
        seen.add(page.locator(".strip canvas").nth(5).evaluate(pixels))  # the first reconstruction
        page.keyboard.press("ArrowRight")
    assert len(seen) == len(networks)
    assert networks[0]["kl"] > 50 and active == 0  # from all latents to posterior collapse


@pytest.mark.parametrize("name", NAMES)
def test_a_page_fits_a_phone_and_bears_impatient_clicks(opened, rng, name):
    page = opened(name)
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    page.evaluate(
        """(order) => {
            const kinds = "#live button, #live input, #live canvas";
            const controls = [...document.querySelectorAll(kinds)];
            for (const share of order) {
                const control = controls[Math.floor(share * controls.length)];
                if (control.type === "range") {
                    control.value = share * control.max;
                    control.dispatchEvent(new Event("input", { bubbles: true }));
                } else control.click();
            }
        }""",
        rng.random(200).tolist(),
    )
    assert (
        page.evaluate("new Promise(requestAnimationFrame).then(() => live.dataset.state)")
        == "ready"
    )
