"""Measure the engine in a browser tab: `python docs/live/record_tab.py`, with nothing else running.

Writes `engine/speed.json`, which docs/speed.md shows: frames a second of one car in one thread of a
headless Chromium, the median of some rounds. Takes a minute.
"""

import json
import shutil
import statistics
import tempfile
from pathlib import Path

import live_build
from playwright.sync_api import Browser, Playwright, sync_playwright

from stad_lab.training.record import processor

SPEED = live_build.HERE / "engine" / "speed.json"
SCRIPTS = ("safetensors", "page", "engine", *live_build.NETWORKS)
AGENT, TRACK, ROUNDS, SECONDS = "input_output", 7, 5, 2.0

MEASURE = """async ([name, track, seconds]) => {
    const engine = await stad.loadEngine()
    const networks = [stad.VAE.load(name), stad.MDNRNN.load(name), stad.loadController(name)]
    const agent = new stad.Agent(...(await Promise.all(networks)))
    const [car, road] = [engine.makeCar(), engine.makeTrack(track)]
    const straight = [0, 0.05, 0]
    const drivers = {
        "no picture": () => car.step(straight),
        "agent's frame": () => (car.frame(), car.step(straight)),
        "V + M + C": () => car.step(agent.act(car.frame())),
    }
    return Object.entries(drivers).map(([driver, step]) => {
        const begin = performance.now()
        let frames = 0
        for (; performance.now() - begin < 1000 * seconds; frames++) {
            if (frames % 500 === 0) { car.reset(road); agent.reset() }
            step()
        }
        return [driver, (1000 * frames) / (performance.now() - begin)]
    })
}"""


def launch(playwright: Playwright) -> Browser:
    """The Chromium of this machine."""
    names = ("chromium", "chromium-browser", "google-chrome")  # as tests/conftest.py
    path = next(filter(None, map(shutil.which, names)), None)
    return playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])


def measure(folder: Path) -> dict:
    """The browser, and of each driver the frames a second in each round; a page in this folder."""
    live_build.write_scripts(folder)
    tags = "".join(f'<script src="js/{name}.js"></script>' for name in SCRIPTS)
    (folder / "index.html").write_text(f"<!doctype html><title>speed</title>{tags}", "utf-8")
    speeds: dict[str, list[float]] = {}
    with sync_playwright() as playwright:
        chromium = launch(playwright)
        page = chromium.new_page()
        page.goto((folder / "index.html").as_uri())
        for _ in range(ROUNDS):
            for driver, speed in page.evaluate(MEASURE, [AGENT, TRACK, SECONDS]):
                speeds.setdefault(driver, []).append(round(speed))
        return {"browser": f"Chromium {chromium.version}", "rounds": speeds}


def main() -> None:
    """Measure, and write the record."""
    with tempfile.TemporaryDirectory() as folder:
        found = measure(Path(folder))
    medians = {driver: statistics.median(rounds) for driver, rounds in found["rounds"].items()}
    record = {"processor": processor(), **found, "median": medians}
    SPEED.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(medians))


if __name__ == "__main__":
    main()
