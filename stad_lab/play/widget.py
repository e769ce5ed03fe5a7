"""The driving widget: a `Session` with keys, buttons and a moving picture. Needs a running kernel.

The loop is a thread of the kernel, so other cells run while the car drives. keys.js, in the page,
sends the pedals that are held.
"""

import html
import threading
import time
from collections.abc import Callable
from pathlib import Path

import ipywidgets

from stad_lab.play.session import LAST_TRACK, Session
from stad_lab.viz.plots import ORANGE
from stad_lab.viz.widgets import picture_png

PICTURE_SIZE = 448  # pixels on the page
LONGEST_WAIT = 0.2  # seconds to wait for a browser that has not shown the last pictures
PEDAL_ICONS = {"gas": "up", "left": "left", "brake": "down", "right": "right"}
HELP = f"""<style>.stad-lab-wire, .stad-lab-swap {{display: none}}
.stad-lab-pixels {{image-rendering: pixelated; max-width: none; border: 4px solid transparent}}
.stad-lab-pixels.stad-lab-listening {{border-color: {ORANGE}}}</style>
<div style="line-height: 1.4">In an orange frame, the keys drive: from <b>drive</b> until <b>P</b>
(pause) or <b>Esc</b>, and with the pointer on the picture. <b>Arrows</b> or <b>WASD</b> steer, give
gas and brake; <b>T</b> hands over between you and the agent.</div>"""


class Loop(threading.Thread):
    """Steps a seat's session at the seat's pace until it is stopped or the episode ends."""

    def __init__(self, seat: "Seat"):
        super().__init__(daemon=True)
        self.seat, self.stopped = seat, threading.Event()

    def run(self) -> None:
        """The thread's work; an error ends the loop and is shown on the page."""
        due = before = time.perf_counter()
        try:
            while not self.stopped.is_set() and self.seat.advance():
                now = time.perf_counter()
                self.seat.pace = 1 / (0.9 / self.seat.pace + 0.1 * max(now - before, 1e-3))
                due = max(due + 1 / self.seat.speed.value, now - 0.1)  # catches up short delays
                before = now
                self.stopped.wait(max(due - now, 0.002))  # always a pause: the kernel reads keys
                patience = time.perf_counter() + LONGEST_WAIT
                while self.seat.browser_is_behind() and time.perf_counter() < patience:
                    self.stopped.wait(0.005)
        except Exception as error:
            self.seat.error = f"{type(error).__name__}: {error}"
        finally:
            self.seat.loop_ended(self)


def stop_loops() -> None:
    """Stop every loop of this kernel, so that a cell that runs again leaves none behind."""
    for thread in threading.enumerate():
        if isinstance(thread, Loop):
            thread.stopped.set()
            thread.join(timeout=5)


def drive_yourself(session: Session) -> ipywidgets.Widget:
    """The widget of a session, which other cells may read; a kernel drives the last one started."""
    return Seat(session).view


class Seat:
    """The controls of a session and its picture; `view` is all of it, `pace` pictures a second."""

    def __init__(self, session: Session):
        stop_loops()
        self.session, self.loop, self.pace, self.error = session, None, 0.0, ""
        self.lock, self.described = threading.RLock(), 0.0  # when the status was last written
        size = {"width": PICTURE_SIZE, "height": PICTURE_SIZE}
        self.picture = marked(ipywidgets.Image(format="png", **size), "pixels")
        self.status = ipywidgets.HTML()
        self.go = marked(ipywidgets.ToggleButton(description="drive", icon="play"), "drive")
        self.driver = choice({"you": "hand", "the agent": "agent"}, session.driver)
        self.world = choice({"the real track": "real", "the dream": "dream"}, session.world)
        temperature = session.dream.temperature
        self.temperature = ipywidgets.FloatSlider(temperature, min=0.1, max=2.5, step=0.05)
        self.speed = ipywidgets.IntSlider(30, min=10, max=50)
        self.track = ipywidgets.BoundedIntText(session.track, min=0, max=LAST_TRACK)
        self.begin = ipywidgets.Button(description="begin", icon="flag")
        self.wire = marked(ipywidgets.Text(), "wire")  # the held pedals, from keys.js
        self.swap = marked(ipywidgets.Button(), "swap")  # what keys.js clicks for T
        # The browser copies every tenth picture's number back, and the loop waits for it: otherwise
        # pictures would pile up in a slow browser.
        self.shown, self.sent, self.seen = 0, ipywidgets.IntText(), ipywidgets.IntText()
        self.answer = ipywidgets.jsdlink((self.sent, "value"), (self.seen, "value"))
        self._connect()
        self.show()
        self.view = marked(ipywidgets.Box([self.picture, self._controls(), script()]), "seat")
        self.view.layout.flex_flow = "row wrap"

    def _controls(self) -> ipywidgets.VBox:
        size = {"width": "76px", "height": "40px"}
        gas, *others = (
            marked(ipywidgets.Button(icon=f"arrow-{icon}", tooltip=pedal, layout=size), pedal)
            for pedal, icon in PEDAL_ICONS.items()
        )
        for control, width in ((self.go, 240), (self.track, 110), (self.begin, 124)):
            control.layout.width = f"{width}px"
        cross = {"align_items": "center", "width": "240px"}
        rows = [self.status, self.go, self.driver, self.world]
        rows += [ipywidgets.Label("temperature of the dream"), self.temperature]
        rows += [ipywidgets.Label("frames a second (the real car: 50)"), self.speed]
        rows += [ipywidgets.Label("track"), ipywidgets.HBox([self.track, self.begin])]
        rows += [ipywidgets.VBox([gas, ipywidgets.HBox(others)], layout=cross)]
        rows += [ipywidgets.HTML(HELP), self.wire, self.swap]
        return ipywidgets.VBox(rows, layout={"width": "330px", "margin": "0 0 0 16px"})

    def _connect(self) -> None:
        acts = {self.go: self.drive, self.wire: self.hold}
        acts[self.driver] = lambda driver: self._command(self.session.give, driver)
        acts[self.world] = lambda world: self._command(self.session.enter, world)
        acts[self.temperature] = lambda value: setattr(self.session.dream, "temperature", value)
        for control, act in acts.items():
            control.observe(lambda change, act=act: act(change["new"]), "value")
        self.swap.on_click(lambda _: self.change_driver())
        self.begin.on_click(lambda _: self.begin_track())

    def hold(self, pedals: str) -> None:
        """Hold these pedals, "gas left" for example, and release all others."""
        self.session.hand.hold(*pedals.split())
        self.described = 0.0  # the loop shows it with the next picture

    def change_driver(self) -> None:
        """Hand over between human and agent; another cell may have done so since the last time."""
        self._command(self.session.give, "agent" if self.session.driver == "hand" else "hand")
        self.driver.value = self.session.driver

    def drive(self, on: bool) -> None:
        """Start the loop, or pause it. Any other seat's loop is stopped."""
        # After the end of an episode the game keeps the keys: JupyterLab would obey a held one.
        if not self.session.ended:
            (self.view.add_class if on else self.view.remove_class)("stad-lab-driving")
        if on:
            self.loop = None  # a loop that is still ending must not change the new one's state
            stop_loops()
            self.loop, self.pace, self.error = Loop(self), float(self.speed.value), ""
            self.loop.start()
        elif self.loop:
            self.loop.stopped.set()
        self.go.description, self.go.icon = ("pause", "pause") if on else ("drive", "play")

    def begin_track(self) -> None:
        """Begin an episode on the chosen track, and drive."""
        self._command(self.session.begin, self.track.value)
        self.world.value, self.go.value = "real", True

    def advance(self) -> bool:
        """Drive and show one frame; False if the episode has ended."""
        with self.lock:
            if not self.session.ended:
                self.session.step()
        self.show(every=0.2)
        return not self.session.ended

    def loop_ended(self, loop: Loop) -> None:
        """What a loop calls at its end."""
        if loop is self.loop:
            self.go.value = False
        self.show()

    def show(self, every: float = 0.0) -> None:
        """Show the picture, and the status unless it is younger than `every` seconds."""
        with self.lock:
            picture = self.session.picture()
        self.picture.value = picture_png(picture, len(picture))
        self.shown += 1
        if self.shown % 10 == 0:  # an answer costs the page as much as some pictures
            self.sent.value = self.shown
        if time.perf_counter() - self.described > every:
            self.described = time.perf_counter()
            pace = self.pace if self.go.value else 0.0
            self.status.value = describe(self.session, pace, self.error)

    def browser_is_behind(self) -> bool:
        """Whether a browser is there and has not answered for more than 15 pictures."""
        return 0 < self.seen.value < self.shown - 15

    def _command(self, act: Callable, value: object) -> None:
        with self.lock:
            act(value)
        self.show()


def describe(session: Session, pace: float, error: str = "") -> str:
    """The driver, the place, the score and the pictures a second, as HTML."""
    driver = "You drive" if session.driver == "hand" else "The agent drives"
    if session.world == "real":
        place, count = f"on track {session.track}", len(session.rows)
        score = f"{session.score:.1f} points"
    else:
        place, count, score = "in the dream", len(session.dream_rows), "no points in the dream"
    state = f"{pace:.0f} pictures a second" if pace else "paused"
    state = "the episode has ended" if session.ended else state
    held = ", ".join(sorted(session.hand.held)) or "none"
    lines = [f"<b>{driver} {place}</b>", f"{score}, frame {count}, {state}", f"keys held: {held}"]
    lines += [f"<b>{html.escape(error)}</b>"] if error else []
    return f'<div style="line-height: 1.4">{"<br>".join(lines)}</div>'


def marked(widget: ipywidgets.DOMWidget, name: str) -> ipywidgets.DOMWidget:
    """The widget, with a class by which keys.js finds it."""
    return widget.add_class(f"stad-lab-{name}")


def script() -> ipywidgets.Output:
    """keys.js as an output, which JupyterLab runs when it shows it."""
    data = {"application/javascript": Path(__file__).with_name("keys.js").read_text("utf-8")}
    output = {"output_type": "display_data", "data": data, "metadata": {}}
    return ipywidgets.Output(outputs=(output,))


def choice(options: dict[str, str], value: str) -> ipywidgets.ToggleButtons:
    """Buttons of which one is down."""
    buttons = ipywidgets.ToggleButtons(options=list(options.items()), value=value)
    buttons.style.button_width = "120px"
    return buttons
