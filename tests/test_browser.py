"""Every widget in a real browser: JupyterLab, a headless Chromium, sliders moved, keys held, pictures that change."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
if not CHROMIUM:
    pytest.skip(
        "no chromium on the PATH, so no widget is tried in a browser: install it (Debian: apt-get install chromium)",
        allow_module_level=True,
    )
playwright = pytest.importorskip(
    "playwright.sync_api", reason="no playwright: pip install -r environment.txt", exc_type=ImportError
)

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
FLAGS = "--no-sandbox --disable-gpu --no-first-run --disable-background-networking --disable-component-update"
PICTURE = ".jp-OutputArea-output img"


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A JupyterLab with its own settings: (its address, the folder that it serves)."""
    folder = tmp_path_factory.mktemp("lab")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    places = {f"JUPYTER_{kind}_DIR": str(folder / kind) for kind in ("CONFIG", "RUNTIME")}
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root", f"--port={port}", "--ip=127.0.0.1"]
    command += ["--IdentityProvider.token=t", f"--ServerApp.root_dir={folder}", "--ServerApp.port_retries=0"]
    command += ["--LabApp.extension_manager=readonly"]
    settings = folder / "CONFIG" / "labconfig" / "default_setting_overrides.json"
    settings.parent.mkdir(parents=True)
    settings.write_text(json.dumps({"@jupyterlab/apputils-extension:notification": QUIET}))
    with (folder / "server.log").open("w") as log:
        server = subprocess.Popen(command, stdout=log, stderr=log, env={**os.environ, **places}, start_new_session=True)
    address = f"http://127.0.0.1:{port}"
    for _ in range(600):
        try:
            urllib.request.urlopen(f"{address}/api?token=t", timeout=5)
            break
        except OSError:
            assert server.poll() is None, (folder / "server.log").read_text()
            time.sleep(0.1)
    yield address, folder
    server.send_signal(signal.SIGTERM)
    server.wait(20)


QUIET = {"fetchNews": "false", "checkForUpdates": False}


@pytest.fixture(scope="module")
def browser():
    """One Chromium for all tests."""
    with playwright.sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=CHROMIUM, headless=True, args=FLAGS.split())
        yield chromium
        chromium.close()


@pytest.fixture
def run(lab, browser):
    """run(cells) writes a notebook of these code cells, runs it in the browser and returns the page.

    At the end of the test the page must not have reported an error.
    """
    address, folder = lab
    errors, pages = [], []

    def run_notebook(*cells, name="test.ipynb", content=None):
        (folder / name).write_text(json.dumps(content or as_notebook(cells)))
        page = browser.new_page(viewport={"width": 1300, "height": 1000})
        pages.append(page)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.goto(f"{address}/lab/workspaces/auto-{time.time_ns()}/tree/{name}?token=t")
        page.wait_for_selector(".jp-Notebook .jp-CodeCell")
        page.get_by_text("| Idle").wait_for(timeout=60_000)  # before that JupyterLab would ask which kernel to take
        page.get_by_role("menuitem", name="Run", exact=True).click()
        page.get_by_role("menuitem", name=re.compile("Run All Cells$")).click()
        return page

    yield run_notebook
    print(errors)
    for page in pages:
        page.close()
    assert errors == []


def as_notebook(cells):
    """Code cells as a notebook."""
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    made = [
        {"cell_type": "code", "id": f"c{n}", "source": cell, "metadata": {}, "outputs": [], "execution_count": None}
        for n, cell in enumerate(cells)
    ]
    return {"cells": made, "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}


SEAT = """
from stad_lab import load_agent
from stad_lab.play import Session
from stad_lab.play_widget import drive_yourself
session = Session(load_agent("input"), track=1)
drive_yourself(session)
"""


def test_seat(run):
    page = run(SEAT)
    picture = page.locator(".stad-lab-pixels")
    try:
        picture.wait_for(timeout=40_000)
    finally:
        page.screenshot(path="/tmp/fail.png")
    time.sleep(1)
    page.screenshot(path="/tmp/seat0.png")
    page.evaluate("""() => { const p = document.querySelector('.stad-lab-pixels'); window.pictures = 0;
        p.addEventListener('load', () => { window.pictures += 1 }) }""")
    picture.hover()
    page.keyboard.down("ArrowUp")
    page.get_by_role("button", name="drive").click()
    picture.hover()
    page.keyboard.down("w")
    time.sleep(2)
    page.screenshot(path="/tmp/seat1.png")
    a, t = page.evaluate("window.pictures"), time.time()
    time.sleep(8)
    b, u = page.evaluate("window.pictures"), time.time()
    print("PICTURES", (b - a) / (u - t), os.getloadavg())
    page.keyboard.up("w")
    page.keyboard.press("t")
    time.sleep(1)
    page.screenshot(path="/tmp/seat2.png")
    page.get_by_role("button", name="the dream").click()
    time.sleep(2)
    page.screenshot(path="/tmp/seat3.png")
