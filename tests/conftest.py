"""What the tests share: a quick preset, one real run of the real command line, and its agent."""

import os

os.environ.setdefault("STAD_LAB_PRESET", "quick")
# Dozens of Pythons start here, and each would compile all of our modules again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# A GPU does not repeat its sums bit for bit.
os.environ.setdefault("CUDA_VISIBLE_DEVICES", "")
# check_env tries render_mode="human": no window may open.
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
# Several tests share the cores, with the kernels and commands that they start.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# A kernel drops messages that nobody has read after 1,000.
os.environ.setdefault("TQDM_MININTERVAL", "1")

import json
import re
import shutil
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
from filelock import FileLock
from firefox import Firefox

import stad_lab

LIVE = Path(__file__).parent.parent / "docs" / "live"
GAME = "```{include} race.md\n"  # how the story shows the game

# What takes seconds to import is imported where it is used: the process that hands out the tests
# runs none, and those that run them wait for it.


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    """PyTorch computes on one thread: the models here are tiny."""
    import torch

    torch.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def no_flush():
    """No test cuts the power, and a flush waits for what all other tests write."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.fsync", lambda opened: None)
        yield


# Files that take longest.
LONG = (
    *("test_docs.py", "00_first_drive.ipynb", "test_exercises.py", "test_browser.py"),
    *("test_faults.py", "test_live_race.py", "test_live.py", "test_live_evolve.py"),
    *("test_compete.py", "test_evolution.py", "test_dataset.py"),
)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items):
    """Long files begin first, so that no process has one left when the others have ended."""
    order = {name: place for place, name in enumerate(LONG)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))


def pytest_xdist_auto_num_workers():
    """One process more than cores, because many tests wait for a browser, a kernel or a command.

    There are at most 4: a laptop's memory holds no more.
    """
    return min(4, os.cpu_count() + 1)


def run_stad_lab(*arguments, **environment):
    """Run the real command line in a process of its own."""
    command = [sys.executable, "-m", "stad_lab", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=300, env=os.environ | environment
    )


# Python runs a module named sitecustomize at every start, so this watches the command and all of
# its workers: they may write to the folders in GUARDED alone, and use no network.
GUARD = """
import os, sys

PATHS = ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.truncate")

def guard(event, arguments):
    if event == "socket.getaddrinfo":
        forbid(f"{event} {arguments}")
    if event in ("socket.connect", "socket.bind") and not isinstance(arguments[1], str):
        forbid(f"{event} {arguments}")  # a str is the path of a socket within the machine
    if event in PATHS:
        for where in arguments:  # a bare name lies in a folder that is open
            if isinstance(where, str) and os.path.isabs(where):
                check(where)
    if event == "open" and isinstance(arguments[0], str) and arguments[2] is not None:
        if arguments[2] & (os.O_WRONLY | os.O_RDWR):
            check(os.path.abspath(arguments[0]))

def check(where):
    allowed = [one.rstrip(os.sep) + os.sep for one in os.environ["GUARDED"].split(os.pathsep)]
    if not (where + os.sep).startswith(tuple(allowed)):
        forbid(f"writing to {where}")

def forbid(what):
    print("forbidden:", what, file=sys.stderr)
    raise PermissionError(what)

sys.addaudithook(guard)
print("guarded", file=sys.stderr)
"""


@pytest.fixture(scope="session")
def command_line():
    """The command line as a function."""
    return run_stad_lab


def shared_folder(tmp_path_factory, worker_id):
    """A folder that all processes of this test run share."""
    own = tmp_path_factory.getbasetemp()
    return own if worker_id == "master" else own.parent


@pytest.fixture(scope="session")
def quick_training(tmp_path_factory, worker_id):
    """One run made by the real command: (its folder, the finished process, seconds)."""
    shared = shared_folder(tmp_path_factory, worker_id)
    told = shared / "quick_training.json"
    with FileLock(shared / "quick_training.lock"):
        if not told.exists():
            told.write_text(json.dumps(train_quickly(shared / "quick", shared / "guard")))
    outcome = json.loads(told.read_text(encoding="utf-8"))
    assert outcome["returncode"] == 0, outcome["stderr"]
    folder = tmp_path_factory.mktemp("runs") / "quick"
    shutil.copytree(shared / "quick", folder)
    return folder, SimpleNamespace(**outcome), outcome["seconds"]


def train_quickly(folder, guard):
    """Train with the quick preset under guard; returns what came of it."""
    guard.mkdir()
    (guard / "sitecustomize.py").write_text(GUARD)
    home = Path(stad_lab.__file__).parent  # here Numba keeps the engine
    compiled = [str(folder / "__pycache__") for folder in (home, home / "envs")]
    # PyTorch looks for a place for temporary files in /dev/ and /proc/, too.
    may_write = [str(folder), str(guard), *compiled, "/dev/", "/proc/"]
    guarded = {
        "GUARDED": os.pathsep.join(may_write),
        "TMPDIR": str(guard),
        "PYTHONPATH": os.pathsep.join([str(guard), os.environ.get("PYTHONPATH", "")]),
        "PYTHONDONTWRITEBYTECODE": "1",
        "MPLCONFIGDIR": str(guard),  # matplotlib, which pycma imports, makes a folder
        "TORCHINDUCTOR_CACHE_DIR": str(guard),  # PyTorch hands that of this process on
    }
    begin = time.perf_counter()
    command = ("train", "quick", "--variant", "input_output", "--out", folder)
    process = run_stad_lab(*command, **guarded)
    told = {name: getattr(process, name) for name in ("returncode", "stdout", "stderr")}
    return told | {"seconds": time.perf_counter() - begin}


@pytest.fixture(scope="session")
def quick_run(quick_training):
    """The folder of a finished run. Tests that change files copy it first."""
    return quick_training[0]


@pytest.fixture(scope="session")
def straight_run(quick_run, tmp_path_factory):
    """The run with a C that uses z and h for the gas alone.

    It drives straight on, and leaves the field after some 300 frames.
    """
    import numpy as np

    from stad_lab.io.weights import CONTROLLER_FILE, load_controller, save_controller
    from stad_lab.models.controller import initial_parameters

    folder = shutil.copytree(quick_run, tmp_path_factory.mktemp("runs") / "straight")
    _, metadata = load_controller(folder / CONTROLLER_FILE)
    quick = stad_lab.Config.preset("quick")
    straight = initial_parameters(quick.vae.latent_size, quick.mdn_rnn.hidden_size, gas=-0.2)
    gas = straight[:-3].reshape(3, -1)[1]
    gas[:] = 0.02 * np.random.default_rng(0).standard_normal(gas.shape)
    metadata.pop("kind")
    save_controller(folder / CONTROLLER_FILE, straight, **metadata)
    return folder


@pytest.fixture
def rng():
    """Other numbers in every run; a failure shows their seed."""
    import secrets

    import numpy as np

    seed = secrets.randbits(64)
    print(f"seed {seed}")
    return np.random.default_rng(seed)


@pytest.fixture
def agent(quick_run):
    """The agent of the run."""
    return stad_lab.load_agent(quick_run)


@pytest.fixture(scope="session")
def observations():
    """Sixty observations of one episode: a list of uint8 (96, 96, 3)."""
    env = stad_lab.make_env()
    seen = [env.reset(seed=7)[0]]
    env.action_space.seed(7)
    while len(seen) < 60:
        seen.append(env.step(env.action_space.sample())[0])
    env.close()
    return seen


@pytest.fixture(scope="session")
def noted_tracks():
    """`with noted_tracks() as tracks:` lists the tracks on which this process resets a car."""
    from stad_lab.envs.cars import Cars

    @contextmanager
    def note():
        tracks, reset = [], Cars.reset

        def noting(cars, seeds=None, *arguments, **named):
            tracks.extend(seeds or [])
            return reset(cars, seeds, *arguments, **named)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Cars, "reset", noting)
            yield tracks

    return note


@pytest.fixture(scope="module")
def browser():
    """The Chromium on the PATH, headless. Playwright needs a loop, so asyncio.run comes before."""
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    if not path:
        pytest.skip("no chromium on the PATH: install it (Debian: apt-get install chromium)")
    api = pytest.importorskip("playwright.sync_api", reason="pip install -r environment.txt")
    flags = ["--no-sandbox", "--disable-gpu", "--no-first-run"]
    flags += ["--disable-background-networking", "--disable-component-update"]
    with api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, headless=True, args=flags)
        yield chromium
        chromium.close()


@pytest.fixture
def firefox(tmp_path):
    """A headless Firefox."""
    path = shutil.which("firefox") or shutil.which("firefox-esr")
    if not path:
        pytest.skip("no firefox on the PATH: install it (Debian: apt-get install firefox-esr)")
    one = Firefox(path, tmp_path)
    yield one
    one.close()


@pytest.fixture
def interrupt_after():
    """A context in which a training is interrupted after so many updates, and must end by it."""
    from torch.optim.optimizer import register_optimizer_step_post_hook

    @contextmanager
    def interrupt(updates):
        left = [updates]

        def count(*_):
            left[0] -= 1
            if left[0] == 0:
                raise KeyboardInterrupt

        hook = register_optimizer_step_post_hook(count)
        try:
            with pytest.raises(KeyboardInterrupt):
                yield
        finally:
            hook.remove()

    return interrupt


@pytest.fixture(scope="session")
def live_pages(tmp_path_factory, worker_id):
    """A folder with the live pages as plain HTML, and all their scripts."""
    shared = shared_folder(tmp_path_factory, worker_id)
    with FileLock(shared / "live.lock"):
        if not (shared / "live").exists():
            write_live_pages(shared / "live.part")
            (shared / "live.part").rename(shared / "live")
    return shared / "live"


def write_live_pages(folder):
    """Write the live pages as plain HTML, and all their scripts."""
    sys.path.insert(0, str(LIVE))
    import live_build

    live_build.write_scripts(folder)
    for file in LIVE.glob("*.md"):
        text = file.read_text(encoding="utf-8").replace(GAME, (LIVE / "race.md").read_text("utf-8"))
        if parts := re.findall(r"```\{raw\} html\n(.*?)```", text, re.DOTALL):
            head = '<!doctype html><html lang="en"><meta charset="utf-8"><title>live</title>'
            style = '<link rel="stylesheet" href="live.css"><body>'
            body = "".join(parts)
            (folder / f"{file.stem}.html").write_text(head + style + body, encoding="utf-8")


# The page draws in every third frame of the screen: a busy machine has better things to do.
SELDOM = """{
    const [ask, cancel, asked] = [requestAnimationFrame, cancelAnimationFrame, new Map()]
    let last = 0
    globalThis.requestAnimationFrame = (draw) => {
        const own = ++last
        const wait = (left) =>
            asked.set(own, ask((now) => (left ? wait(left - 1) : (asked.delete(own), draw(now)))))
        wait(2)
        return own
    }
    globalThis.cancelAnimationFrame = (own) => (cancel(asked.get(own)), asked.delete(own))
}"""


@pytest.fixture
def opened(browser, live_pages):
    """A function that opens a live page, at an address in it, and waits until it is ready.

    `script` runs before those of the page. No page may have an error, or ask a network; `loaded`
    has the addresses of all that it loads.
    """
    errors, contexts = [], []

    def open_page(name, address="", script="", **context):
        context.setdefault("viewport", {"width": 800, "height": 500})  # less to draw
        contexts.append(browser.new_context(**context))
        contexts[-1].add_init_script(SELDOM + script)
        page = contexts[-1].new_page()
        page.set_default_timeout(60_000)  # milliseconds: a busy machine is no fault
        page.loaded = set()
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("request", lambda one: page.loaded.add(one.url))
        page.on("request", lambda one: one.url.startswith("http") and errors.append(one.url))
        page.goto((live_pages / f"{name}.html").as_uri() + address)
        page.wait_for_selector("#live[data-state=ready]")
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert not errors
