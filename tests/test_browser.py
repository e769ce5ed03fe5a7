"""Every widget in a real browser: JupyterLab, a headless Chromium, moved sliders and held keys."""

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
SLOW = 180  # seconds to wait for anything: a busy machine is no fault


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A JupyterLab with its own settings: (its address, the folder that it serves)."""
    folder = tmp_path_factory.mktemp("lab")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    quiet, dark = {"fetchNews": "false", "checkForUpdates": False}, {"theme": "JupyterLab Dark"}
    places = {f"JUPYTER_{kind}_DIR": str(folder / kind) for kind in ("CONFIG", "RUNTIME")} | {
        "OMP_NUM_THREADS": "1"
    }
    command = [
        sys.executable,
        "-m",
        "jupyterlab",
        "--no-browser",
        "--allow-root",
        f"--port={port}",
        "--ip=127.0.0.1",
    ]
    command += [
        "--IdentityProvider.token=t",
        f"--ServerApp.root_dir={folder}",
        "--ServerApp.port_retries=0",
    ]
    command += ["--LabApp.extension_manager=readonly"]
    settings = folder / "CONFIG" / "labconfig" / "default_setting_overrides.json"
    settings.parent.mkdir(parents=True)
    extension = "@jupyterlab/apputils-extension"
    settings.write_text(
        json.dumps({f"{extension}:notification": quiet, f"{extension}:themes": dark})
    )
    with (folder / "server.log").open("w") as log:
        server = subprocess.Popen(
            command,
            stdout=log,
            stderr=log,
            env={**os.environ, **places, "OMP_NUM_THREADS": "1"},
            start_new_session=True,
        )
    address = f"http://127.0.0.1:{port}"
    for _ in range(600):
        try:
            urllib.request.urlopen(f"{address}/api?token=t", timeout=5)
            break
        except OSError:
            assert server.poll() is None, (folder / "server.log").read_text(encoding="utf-8")
            time.sleep(0.1)
    yield address, folder
    server.send_signal(signal.SIGTERM)
    server.wait(20)


@pytest.fixture(scope="module")
def tabs(browser):
    """A window whose tabs share a cache: JupyterLab has megabytes of scripts."""
    return browser.new_context(viewport={"width": 1300, "height": 1400})


@pytest.fixture
def run(lab, tabs):
    """run(cells) writes a notebook of these code cells, runs it and returns the page.

    At the end of the test the page must not have reported an error.
    """
    address, folder = lab
    errors, pages = [], []

    def run_notebook(*cells, name="test.ipynb", content=None):
        (folder / name).write_text(json.dumps(content or as_notebook(cells)))
        page = tabs.new_page()
        pages.append(page)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on(
            "console",
            lambda message: errors.append(message.text) if message.type == "error" else None,
        )
        page.goto(f"{address}/lab/workspaces/auto-{time.time_ns()}/tree/{name}?token=t")
        page.wait_for_selector(".jp-Notebook .jp-CodeCell")
        page.get_by_text("| Idle").wait_for(
            timeout=1000 * SLOW
        )  # before that JupyterLab would ask which kernel to take
        page.get_by_role("menuitem", name="Run", exact=True).click()
        page.get_by_role("menuitem", name=re.compile("Run All Cells$")).click()
        return page

    yield run_notebook
    for page in pages:
        page.close()
    assert errors == []


def as_notebook(cells):
    """Code cells as a notebook."""
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    made = [
        {
            "cell_type": "code",
            "id": f"c{n}",
            "source": cell,
            "metadata": {},
            "outputs": [],
            "execution_count": None,
        }
        for n, cell in enumerate(cells)
    ]
    return {"cells": made, "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}


def wait_for(fact, what, seconds=SLOW):
    """Wait until fact() holds."""
    end = time.monotonic() + seconds
    while not fact():
        assert time.monotonic() < end, f"{what} did not come about in {seconds} seconds"
        time.sleep(0.05)


def sees_another_picture(picture, act):
    """Do something, and wait until the picture is another one."""
    picture.wait_for(timeout=1000 * SLOW)
    before = picture.get_attribute("src")
    act()
    wait_for(lambda: picture.get_attribute("src") != before, "another picture")


SLIDERS = (
    """
import numpy as np
from stad_lab import load_agent
from stad_lab.viz.plots import plot_curves
from stad_lab.viz.widgets import explore, explore_latents, slider
def draw(bend):
    return plot_curves({"line": np.sin(bend * np.arange(20.0))}, f"bend {bend}", "x", "y")
explore(draw, bend=slider(0.0, 1.0, 0.5, "bend"))
""",
    """
agent = load_agent("input_output")
explore_latents(agent.vae, np.zeros(32, np.float32))
""",
)


def test_a_slider_changes_every_figure(run):
    page = run(*SLIDERS)  # one page for both: a kernel takes seconds to start
    cells = page.locator(".jp-CodeCell")
    for number, pictures, sliders in ((0, 1, 1), (1, 2, 32)):
        cell = cells.nth(number)
        handles = cell.locator(".noUi-handle")
        handles.first.wait_for(timeout=1000 * SLOW)
        assert handles.count() == sliders
        for place in range(pictures):
            picture = cell.locator(".jp-OutputArea-output img").nth(place)
            sees_another_picture(picture, lambda handles=handles: handles.first.press("ArrowRight"))


SEAT = """
from stad_lab import load_agent
from stad_course.play.session import Session
from stad_course.play.widget import drive_yourself
session = Session(load_agent("cropped_input"), track=1)
drive_yourself(session)
"""
COUNT = """picture => {
    window.pictures = 0
    const counter = new MutationObserver(() => { window.pictures += 1 })
    counter.observe(picture, { attributes: true, attributeFilter: ["src"] })
}"""


def test_a_student_drives_with_keys_dreams_and_shares_the_wheel_with_the_agent(run):
    page = run(SEAT)
    picture = page.locator(".stad-lab-pixels")
    status = page.locator(".widget-html", has_text="frame")

    def tells(text, seconds=SLOW):
        wait_for(lambda: text in status.first.inner_text(), text, seconds)

    tells("You drive on track 1")
    picture.evaluate(COUNT)
    sees_another_picture(picture, picture.click)  # as good as the button
    for key, pedal in (("ArrowUp", "gas"), ("a", "left")):
        page.keyboard.down(key)
        tells(f"keys held: {pedal}")
        page.keyboard.up(key)
        tells("keys held: none")
    page.keyboard.down("w")
    tells("keys held: gas")
    before, begin = page.evaluate("window.pictures"), time.monotonic()
    time.sleep(2)
    rate = (page.evaluate("window.pictures") - before) / (time.monotonic() - begin)
    print(f"{rate:.1f} pictures a second arrive in the browser; load {os.getloadavg()[0]:.1f}")
    assert rate > 5  # a busy machine is slow; the line above says how fast this one was
    page.keyboard.up("w")
    tells("keys held: none")

    page.keyboard.press("t")
    tells("The agent drives on track 1")
    page.get_by_role("button", name="the dream").click()
    tells("The agent drives in the dream")
    page.keyboard.press("Escape")  # from here on the keys move sliders, not the car
    tells("paused")
    page.get_by_text("temperature, pace, track").click()
    temperature = page.locator(".widget-readout").first
    before = temperature.inner_text()
    page.locator(".noUi-handle").first.press("ArrowRight")
    wait_for(lambda: temperature.inner_text() != before, "another temperature", SLOW)
    picture.click()
    wait_for(lambda: listening(page), "the coloured frame")
    page.keyboard.press("t")
    tells("You drive in the dream")
    page.get_by_role("button", name="the real track").click()
    tells("You drive on track 1")

    def frame():
        return int(re.search(r"frame (\d+)", status.first.inner_text())[1])

    wait_for(lambda: frame() > 60, "frame 60", SLOW)
    before = frame()
    page.keyboard.press("r")
    wait_for(lambda: frame() < before, "a restarted episode", SLOW)
    page.evaluate("window.dispatchEvent(new Event('blur'))")  # the reader turns to another window
    tells("paused")
    assert (
        page.locator(".jp-CodeCell").count() == 1
    )  # no key that drives was taken for a command of JupyterLab


# While a car drives, keys belong to the game wherever the pointer is: none edits the notebook.

DRIVEN = """
from stad_lab import load_agent
from stad_course.play.session import Session
from stad_course.play.widget import drive_yourself
session = Session(load_agent("input"), track=1)
for _ in range(frames):
    session.step()
drive_yourself(session)
"""


@pytest.fixture(params=[0])
def seat(run, request):
    """A page in JupyterLab's command mode, the pointer in a corner: (page, reads, cells).

    The parameter is the number of frames that were driven before.
    """
    page = run(f"frames = {request.param}\n{DRIVEN}", "1 + 1")
    status = page.locator(".widget-html", has_text="frame")

    def reads(text):
        wait_for(lambda: text in status.first.inner_text(), text)

    reads("You drive on track 1")
    page.locator(".jp-InputPrompt").first.click()  # selects the first cell, in command mode
    page.mouse.move(5, 5)
    return page, reads, lambda: page.locator(".jp-CodeCell").count()


def press_drive(page):
    """Press the button and move the pointer off everything that is ours."""
    picture = page.locator(".stad-lab-pixels")
    sees_another_picture(picture, lambda: page.get_by_role("button", name="drive").click())
    page.mouse.move(5, 5)
    wait_for(lambda: listening(page), "the orange frame")


def listening(page):
    """Whether the picture's frame says that keys drive."""
    return "stad-lab-listening" in page.locator(".stad-lab-stage").get_attribute("class")


def test_buttons_and_keys_drive_with_the_pointer_elsewhere_and_no_cell_is_deleted_or_inserted(seat):
    page, reads, cells = seat
    press_drive(page)
    page.locator(".stad-lab-gas").hover()
    page.mouse.down()
    reads("keys held: gas")
    page.keyboard.down("a")
    reads("keys held: gas, left")
    page.mouse.up()
    reads("keys held: left")
    page.mouse.down()
    page.mouse.move(5, 5)  # the pointer leaves the button
    reads("keys held: left")
    page.keyboard.up("a")
    for key, pedal in (("d", "right"), ("d", "right"), ("a", "left"), ("ArrowUp", "gas")):
        page.keyboard.down(key)
        reads(f"keys held: {pedal}")
        page.keyboard.up(key)
        reads("keys held: none")
    page.keyboard.down("w")
    page.keyboard.down("a")
    reads("keys held: gas, left")
    page.keyboard.up("w")
    reads("keys held: left")
    page.keyboard.up("a")
    for key in "ddaabbxxmy":  # commands of JupyterLab, some of them also keys of the game
        page.keyboard.press(key)
    page.keyboard.press("t")
    reads("The agent drives on track 1")
    page.keyboard.press("p")
    reads("paused")
    wait_for(lambda: not listening(page), "the end of the orange frame")
    assert cells() == 2
    page.keyboard.press("b")  # paused: the keys are JupyterLab's again
    wait_for(lambda: cells() == 3, "a new cell")


def test_typing_and_escape_pause_the_game_and_give_the_keys_to_the_notebook(seat):
    page, reads, cells = seat
    press_drive(page)
    editor = page.locator(".jp-CodeCell .cm-content").nth(1)
    editor.click()
    reads("paused")
    page.keyboard.press("End")
    page.keyboard.type("000 # wasd")
    assert "1 + 1000 # wasd" in editor.inner_text() and not listening(page)
    page.keyboard.press("Control+Enter")  # the notebook is in command mode now
    page.get_by_text("1001", exact=True).wait_for(timeout=1000 * SLOW)
    page.get_by_role("button", name="drive").click()
    wait_for(lambda: listening(page), "the orange frame")
    page.locator(".jp-InputPrompt").first.click()
    page.keyboard.press("d")
    page.keyboard.press("d")
    page.keyboard.down("w")
    reads("keys held: gas")
    page.keyboard.press("Escape")
    reads("keys held: none")
    reads("paused")
    assert not listening(page) and cells() == 2
    page.locator(".jp-InputPrompt").first.click()
    page.keyboard.press("b")
    wait_for(lambda: cells() == 3, "a new cell")


@pytest.mark.parametrize("seat", [850], indirect=True)
def test_keys_that_are_held_when_an_episode_ends_do_not_edit_the_notebook(seat):
    page, reads, cells = seat
    press_drive(page)
    page.keyboard.down("w")
    page.keyboard.down("d")
    reads("keys held: gas, right")
    reads("the episode has ended")
    for _ in range(6):
        page.keyboard.down("d")  # a held key repeats
    assert cells() == 2
    page.keyboard.up("d")
    page.keyboard.press("p")
    wait_for(lambda: not listening(page), "the end of the orange frame")
    page.get_by_text("temperature, pace, track").click()
    page.locator(".stad-lab-begin").click()
    wait_for(lambda: listening(page), "the orange frame of the next episode")
    page.keyboard.down("w")
    reads("keys held: gas")


# Training in the browser

LIVE = """
import shutil, tempfile
from pathlib import Path
from stad_lab import Config
from stad_lab.agent import PRETRAINED
from stad_lab.training.evolution import evolve, fitness_curves
from stad_lab.viz.plots import plot_evolution
from stad_lab.viz.widgets import watch_training
if "folder" not in globals():
    folder = Path(tempfile.mkdtemp())
    for name in ("vae.safetensors", "mdn_rnn.safetensors"):
        shutil.copy(PRETRAINED / "cropped_input" / name, folder)
changes = {"generations": 400, "max_frames": 30}
config = Config.preset("quick", variant="input", processes=1, evolution=changes)
def draw(log):
    return plot_evolution(fitness_curves(log), {}, f"generation {len(log)}")
watch_training(lambda watch: evolve(config, folder, watch=watch), draw)
"""


STOP = "[data-command='notebook:interrupt-kernel'], [title*='Interrupt']"


def test_the_stop_button_ends_a_live_training_in_one_line_and_the_cell_goes_on(run):
    page = run(LIVE)
    picture = page.locator(".jp-RenderedHTMLCommon img").first
    sees_another_picture(picture, lambda: None)
    page.locator(STOP).first.click()
    stopped = page.get_by_text("stopped: run this cell again")
    stopped.wait_for(timeout=1000 * SLOW)
    drawn = generation(picture)
    page.locator(".jp-CodeCell .cm-content").click()
    page.keyboard.press("Control+Enter")
    # the old picture may still change, and a stop before the cell has begun stops nothing
    stopped.wait_for(state="hidden", timeout=1000 * SLOW)
    wait_for(lambda: picture.count() and generation(picture) > drawn, f"a generation after {drawn}")
    page.locator(STOP).first.click()
    stopped.wait_for(timeout=1000 * SLOW)


def generation(picture):
    """The generation that a figure of the live training shows."""
    return int(re.search(r"generation (\d+)", picture.get_attribute("alt"))[1])


@pytest.mark.long
def test_the_first_notebook_runs_to_its_end_in_the_browser(run, lab):
    name = "00_first_drive.ipynb"
    page = run(name=name, content=json.loads((NOTEBOOKS / name).read_text(encoding="utf-8")))

    def code_cells():
        return [
            cell
            for cell in json.loads((lab[1] / name).read_text(encoding="utf-8"))["cells"]
            if cell["cell_type"] == "code"
        ]

    def is_done():
        page.keyboard.press("Control+s")
        time.sleep(1)
        with contextlib.suppress(json.JSONDecodeError):  # read while it was being written
            return all(cell["execution_count"] for cell in code_cells())

    wait_for(is_done, "the end of the notebook", 300)
    outputs = [output for cell in code_cells() for output in cell["outputs"]]
    assert "error" not in [output["output_type"] for output in outputs]
    assert sum("<img" in str(output.get("data")) for output in outputs) >= 8
