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

from stad_course.play.dashboard import SIZE, STRIP, draw_background, draw_moment, end_lines
from stad_course.play.race import Ghost, drive_ghost
from stad_course.play.session import LAST_TRACK, Session
from stad_lab.evaluation.trajectories import FRAMES_A_SECOND
from stad_lab.viz.plots import BLUE, ORANGE, PURPLE
from stad_lab.viz.widgets import picture_png

LONGEST_WAIT = 0.2  # seconds to wait for a browser that has not shown the last pictures
PEDAL_ICONS = {"gas": "up", "left": "left", "brake": "down", "right": "right"}
HELP = f"""<style>.stad-lab-wire, .stad-lab-swap {{display: none}}
.stad-lab-stage {{position: relative; background: #111; border: 4px solid transparent;
  box-sizing: content-box; overflow: hidden; flex: none}}
.stad-lab-stage > * {{position: absolute; left: 0; top: 0; margin: 0}}
.stad-lab-layer {{pointer-events: none}}
.stad-lab-layer .widget-html-content {{line-height: 0}}
.stad-lab-pixels {{image-rendering: pixelated; max-width: none; object-fit: fill; cursor: pointer}}
.stad-lab-listening {{border-color: {ORANGE}}}
.stad-lab-listening.stad-lab-agent {{border-color: {BLUE}}}
.stad-lab-listening.stad-lab-dream {{border-color: {PURPLE}}}</style>
<div style="line-height: 1.4"><b>Arrows</b> or <b>WASD</b> steer, give gas and brake. <b>T</b>: you
or the agent. <b>R</b>: restart. <b>P</b> or <b>Esc</b>: pause. In a coloured frame all plain keys
belong to the game: orange if you drive, blue if the agent does, purple in the dream.</div>"""


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
        self.session, self.pace, self.error = session, 0.0, ""
        self.loop: Loop | None = None
        self.lock, self.described = threading.RLock(), 0.0  # when the status was last written
        self.ghost: Ghost | None = None  # the agent's lap of the present track
        self.picture = marked(ipywidgets.Image(format="png", width=SIZE, height=SIZE), "pixels")
        self.ground, self.moment = (marked(ipywidgets.HTML(), "layer") for _ in range(2))
        self.status = ipywidgets.HTML()
        self.go = marked(ipywidgets.ToggleButton(description="drive", icon="play"), "drive")
        self.driver = choice({"you": "hand", "the agent": "agent"}, session.driver)
        self.world = choice({"the real track": "real", "the dream": "dream"}, session.world)
        temperature = session.dream.temperature
        self.temperature = ipywidgets.FloatSlider(temperature, min=0.1, max=2.5, step=0.05)
        self.speed = ipywidgets.IntSlider(FRAMES_A_SECOND, min=10, max=FRAMES_A_SECOND)
        self.track = ipywidgets.BoundedIntText(session.track, min=0, max=LAST_TRACK)
        self.begin = marked(ipywidgets.Button(description="begin", icon="flag"), "begin")
        self.again = marked(ipywidgets.Button(description="restart", icon="undo"), "again")
        self.wire = marked(ipywidgets.Text(), "wire")  # the held pedals, from keys.js
        self.swap = marked(ipywidgets.Button(), "swap")  # what keys.js clicks for T
        # The browser copies every tenth picture's number back, and the loop waits for it: otherwise
        # pictures would pile up in a slow browser.
        self.shown, self.sent, self.seen = 0, ipywidgets.IntText(), ipywidgets.IntText()
        self.answer = ipywidgets.jsdlink((self.sent, "value"), (self.seen, "value"))
        size = {"width": f"{SIZE}px", "height": f"{SIZE}px"}
        layers = [self.picture, self.ground, self.moment]
        self.stage = marked(ipywidgets.Box(layers, layout=size), "stage")
        self.view = ipywidgets.Box([self.stage, self._controls(), script()])
        marked(self.view, "seat").layout.flex_flow = "row wrap"
        self._connect()
        self._prepare()
        self.show()

    def _controls(self) -> ipywidgets.VBox:
        size = {"width": "76px", "height": "40px"}
        gas, *others = (
            marked(ipywidgets.Button(icon=f"arrow-{icon}", tooltip=pedal, layout=size), pedal)
            for pedal, icon in PEDAL_ICONS.items()
        )
        for control, width in ((self.go, 118), (self.again, 118), (self.begin, 100)):
            control.layout.width = f"{width}px"
        self.track.layout.width = "110px"
        settings = [ipywidgets.Label("temperature of the dream"), self.temperature]
        settings += [ipywidgets.Label("frames a second (the real car: 50)"), self.speed]
        settings += [ipywidgets.Label("track"), ipywidgets.HBox([self.track, self.begin])]
        folded = ipywidgets.Accordion([ipywidgets.VBox(settings)], selected_index=None)
        folded.set_title(0, "temperature, pace, track")
        cross = {"align_items": "center", "width": "240px"}
        rows = [self.status, ipywidgets.HBox([self.go, self.again]), self.driver, self.world]
        rows += [ipywidgets.VBox([gas, ipywidgets.HBox(others)], layout=cross)]
        rows += [ipywidgets.HTML(HELP), folded, self.wire, self.swap]
        return ipywidgets.VBox(rows, layout={"width": "330px", "margin": "0 0 0 16px"})

    def _connect(self) -> None:
        acts = {self.go: self.drive, self.wire: self.hold}
        acts[self.driver] = lambda driver: self._command(self.session.give, driver)
        acts[self.world] = lambda world: self._command(self.session.enter, world)
        acts[self.temperature] = lambda value: setattr(self.session.dream, "temperature", value)
        for control, act in acts.items():
            control.observe(lambda change, act=act: act(change["new"]), "value")
        self.swap.on_click(lambda _: self.change_driver())
        self.begin.on_click(lambda _: self.begin_track(self.track.value))
        self.again.on_click(lambda _: self.begin_track(self.session.track))

    def hold(self, pedals: str) -> None:
        """Hold these pedals, "gas left" for example, and release all others."""
        self.session.hand.hold(*pedals.split())
        self.described = 0.0  # the loop shows it with the next picture
        if not self.go.value:
            self.show()

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

    def begin_track(self, track: int) -> None:
        """Begin an episode on a track, and drive."""
        with self.lock:
            self.session.begin(track)
            self._prepare()
        self.world.value, self.go.value = "real", True
        self.show()

    def _prepare(self) -> Ghost:
        """Let the agent drive its own lap of the track, and draw what does not move."""
        if self.ghost is None or self.ghost.track != self.session.track:
            self.ghost = drive_ghost(self.session.agent, self.session.track)
        self.ground.value = draw_background(self.session.road)
        return self.ghost

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
            ghost = self.ghost
            if ghost is None or ghost.track != self.session.track:  # another cell began an episode
                ghost = self._prepare()
            picture, drawn = self.session.picture(), draw_moment(self.session, ghost)
        cropped = self.session.world == "dream" and self.session.agent.world_model.crop_bar
        self.picture.height = str(SIZE - STRIP if cropped else SIZE)  # the road in its proportions
        self.picture.value = picture_png(picture, len(picture))
        self.moment.value = drawn
        colors = {"agent": self.session.driver == "agent", "dream": self.session.world == "dream"}
        for name, holds in colors.items():
            (self.stage.add_class if holds else self.stage.remove_class)(f"stad-lab-{name}")
        self.shown += 1
        if self.shown % 10 == 0:  # an answer costs the page as much as some pictures
            self.sent.value = self.shown
        if time.perf_counter() - self.described > every:
            self.described = time.perf_counter()
            pace = self.pace if self.go.value else 0.0
            self.status.value = describe(self.session, pace, self.error)
            if self.session.real_ended:  # for screen readers: the picture's card is a drawing
                told = html.escape(". ".join(end_lines(self.session, ghost)))
                self.status.value += f'<div style="line-height: 1.4">{told}</div>'

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
