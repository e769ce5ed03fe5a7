"""The seat in the browser: a `play.Session` with keys, buttons and a picture that moves. Needs a running kernel.

The loop is a thread of the kernel, so that other cells run while the car drives. ipyevents tells when a key goes down
*and* when it comes up, as long as the pointer rests on the picture; the frame around the picture shows that it does.
"""

import html
import threading
import time

import ipywidgets
from ipyevents import Event

from stad_lab.play.session import KEYS, Session
from stad_lab.viz.plots import ORANGE
from stad_lab.viz.widgets import picture_png

PICTURE_SIZE = 448  # pixels on the page
FRAME_IDLE, FRAME_LISTENING = "4px solid transparent", f"4px solid {ORANGE}"
LONGEST_WAIT = (
    0.2  # seconds that the car waits for a browser which has not shown the last pictures yet
)
PRESSED, RELEASED = (
    ("mousedown", "touchstart"),
    ("mouseup", "mouseleave", "touchend", "touchcancel"),
)
PEDAL_ICONS = {
    "gas": "arrow-up",
    "left": "arrow-left",
    "brake": "arrow-down",
    "right": "arrow-right",
}
HELP = """<style>.stad-lab-pixels {image-rendering: pixelated}</style><div style="line-height: 1.4">
Rest the pointer on the picture: an orange frame says that the keys drive. <b>Arrows</b> or <b>WASD</b> steer, give gas
and brake; <b>T</b> takes the wheel from the agent or gives it back; <b>P</b> drives and pauses.</div>"""


class Loop(threading.Thread):
    """Steps a seat's session at the seat's pace until it is stopped or the episode ends."""

    def __init__(self, seat: "Seat"):
        super().__init__(daemon=True)
        self.seat, self.stopped = seat, threading.Event()

    def run(self) -> None:
        """What the thread does; an error ends the loop and is shown on the page."""
        due = before = time.perf_counter()
        try:
            while not self.stopped.is_set() and self.seat.advance():
                now = time.perf_counter()
                self.seat.pace = 1 / (0.9 / self.seat.pace + 0.1 * max(now - before, 1e-3))
                due, before = (
                    max(due + 1 / self.seat.speed.value, now - 0.1),
                    now,
                )  # a short delay is made good
                self.stopped.wait(
                    max(due - now, 0.002)
                )  # never without a pause: the kernel must hear the keys
                patience = time.perf_counter() + LONGEST_WAIT
                while self.seat.browser_is_behind() and time.perf_counter() < patience:
                    self.stopped.wait(0.005)
        except Exception as error:
            self.seat.error = f"{type(error).__name__}: {error}"
        finally:
            self.seat.loop_ended(self)


def stop_loops() -> None:
    """Stop whatever drives in this kernel: the cell that is run again leaves no car on the road behind it."""
    for thread in threading.enumerate():
        if isinstance(thread, Loop):
            thread.stopped.set()
            thread.join(timeout=5)


def drive_yourself(session: Session) -> ipywidgets.Widget:
    """The seat of a session, with keys, buttons and sliders. At most one car drives in a kernel: the one started last.

    The session goes on belonging to the caller, who may look at its drives in other cells at any time.
    """
    return Seat(session).view


class Seat:
    """The controls of a session and the picture, wired together.

    Attributes:
        view: all of it, the widget that a cell shows.
        pace: pictures that the loop has lately made in a second.
    """

    def __init__(self, session: Session):
        stop_loops()
        self.session, self.loop, self.pace, self.error = session, None, 0.0, ""
        self.lock, self.told = (
            threading.RLock(),
            0.0,
        )  # of the session; when the status was last written
        self.picture = ipywidgets.Image(format="png", width=PICTURE_SIZE, height=PICTURE_SIZE)
        self.picture.layout = {"border": FRAME_IDLE, "max_width": "none"}
        self.picture.add_class("stad-lab-pixels")
        self.status = ipywidgets.HTML()
        self.go = ipywidgets.ToggleButton(
            description="drive", icon="play", layout={"width": "240px"}
        )
        self.driver = choice({"you": "hand", "the agent": "agent"}, session.driver)
        self.world = choice({"the real track": "real", "the dream": "dream"}, session.world)
        self.temperature = ipywidgets.FloatSlider(
            session.dream.temperature, min=0.1, max=2.5, step=0.05
        )
        self.speed = ipywidgets.IntSlider(30, min=10, max=50)
        self.track = ipywidgets.BoundedIntText(
            session.track, min=0, max=999_999, layout={"width": "110px"}
        )
        self.begin = ipywidgets.Button(description="begin", icon="flag", layout={"width": "124px"})
        # The browser copies every tenth picture's number back: without an answer, pictures would pile up in a slow one.
        self.shown, self.sent, self.seen = 0, ipywidgets.IntText(), ipywidgets.IntText()
        self.answer = ipywidgets.jsdlink((self.sent, "value"), (self.seen, "value"))
        self._connect()
        self.show()
        self.view = ipywidgets.Box(
            [self.picture, self._controls()], layout={"flex_flow": "row wrap"}
        )

    def _controls(self) -> ipywidgets.VBox:
        pedals = {pedal: self._pedal(pedal, icon) for pedal, icon in PEDAL_ICONS.items()}
        below = ipywidgets.HBox([pedals["left"], pedals["brake"], pedals["right"]])
        rows = [
            self.status,
            self.go,
            self.driver,
            self.world,
            named("temperature of the dream", self.temperature),
            named("frames a second (the real car: 50)", self.speed),
            named("track", ipywidgets.HBox([self.track, self.begin])),
            ipywidgets.VBox(
                [pedals["gas"], below], layout={"align_items": "center", "width": "240px"}
            ),
            ipywidgets.HTML(HELP),
        ]
        return ipywidgets.VBox(rows, layout={"width": "330px", "margin": "0 0 0 16px"})

    def _pedal(self, pedal: str, icon: str) -> ipywidgets.Button:
        """A button that holds its pedal for as long as a mouse or a finger holds the button."""
        button = ipywidgets.Button(
            icon=icon, tooltip=pedal, layout={"width": "76px", "height": "40px"}
        )
        event = Event(
            source=button, watched_events=[*PRESSED, *RELEASED], prevent_default_action=True
        )
        event.on_dom_event(lambda happened: self.press(pedal, happened["type"] in PRESSED))
        return button

    def _connect(self) -> None:
        self.go.observe(lambda change: self.drive(change["new"]), "value")
        self.driver.observe(lambda change: self._command(self.session.give, change["new"]), "value")
        self.world.observe(lambda change: self._command(self.session.enter, change["new"]), "value")
        self.temperature.observe(
            lambda change: setattr(self.session.dream, "temperature", change["new"]), "value"
        )
        self.begin.on_click(lambda _: self.begin_track())
        watched = ["keydown", "keyup", "mouseenter", "mouseleave"]
        self.keys = Event(source=self.picture, watched_events=watched, prevent_default_action=True)
        self.keys.on_dom_event(self.on_event)

    def on_event(self, event: dict) -> None:
        """What the browser saw on the picture: a key that went down or up, the pointer that came or left."""
        kind, key = event["type"], event.get("code")
        if kind in ("mouseenter", "mouseleave"):
            self.picture.layout.border = FRAME_LISTENING if kind == "mouseenter" else FRAME_IDLE
            self.session.hand.held.clear()  # a key that comes up elsewhere is not seen
        elif key in KEYS:
            self.press(KEYS[key], kind == "keydown")
        elif kind == "keydown" and not event.get("repeat") and key == "KeyP":
            self.go.value = not self.go.value
        elif kind == "keydown" and not event.get("repeat") and key == "KeyT":
            self._command(self.session.give, "agent" if self.session.driver == "hand" else "hand")
            self.driver.value = (
                self.session.driver
            )  # the buttons may have been behind: another cell can `give`

    def press(self, pedal: str, down: bool) -> None:
        """Hold a pedal, or let it go."""
        (self.session.hand.held.add if down else self.session.hand.held.discard)(pedal)
        self.told = 0.0  # so that the loop tells at once

    def drive(self, on: bool) -> None:
        """Start the loop, or pause it. A loop that another seat may have is stopped."""
        if on:
            self.loop = None  # a loop that is still on its way out has no say any more
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
        """One frame, shown; False if the episode has ended."""
        with self.lock:
            if not self.session.ended:
                self.session.step()
        self.show(every=0.2)
        return not self.session.ended

    def loop_ended(self, loop: Loop) -> None:
        """What a loop says when it is over."""
        if loop is self.loop:
            self.go.value = False
        self.show()

    def show(self, every: float = 0.0) -> None:
        """Show the present picture, and the status unless it was written less than `every` seconds ago."""
        with self.lock:
            picture = self.session.picture()
        self.picture.value = picture_png(picture, len(picture))
        self.shown += 1
        if self.shown % 10 == 0:  # an answer costs the page as much as some pictures
            self.sent.value = self.shown
        if time.perf_counter() - self.told > every:
            self.told = time.perf_counter()
            self.status.value = describe(
                self.session, self.pace if self.go.value else 0.0, self.error
            )

    def browser_is_behind(self) -> bool:
        """Whether a browser is there and has not answered for more than 15 pictures."""
        return 0 < self.seen.value < self.shown - 15

    def _command(self, do, value) -> None:
        with self.lock:
            do(value)
        self.show()


def describe(session: Session, pace: float, error: str = "") -> str:
    """Who drives where, the score, and the pictures a second, as HTML."""
    who = "You drive" if session.driver == "hand" else "The agent drives"
    if session.world == "real":
        where, count = f"on track {session.track}", len(session.rows)
        score = f"{session.score:.1f} points"
    else:
        where, count = "in the dream", len(session.dream_rows)
        score = "no points in the dream"
    state = (
        "the episode has ended"
        if session.ended
        else f"{pace:.0f} pictures a second"
        if pace
        else "paused"
    )
    held = ", ".join(sorted(session.hand.held)) or "none"
    line = f"<b>{who} {where}</b><br>{score}, frame {count}, {state}<br>keys held: {held}"
    return f'<div style="line-height: 1.4">{line}{f"<br><b>{html.escape(error)}</b>" if error else ""}</div>'


def named(name: str, control: ipywidgets.Widget) -> ipywidgets.VBox:
    """A control under its name."""
    return ipywidgets.VBox(
        [ipywidgets.Label(name, layout={"margin": "0", "height": "20px"}), control]
    )


def choice(options: dict[str, str], value: str) -> ipywidgets.ToggleButtons:
    """Buttons of which one is down."""
    buttons = ipywidgets.ToggleButtons(options=list(options.items()), value=value)
    buttons.style.button_width = "120px"
    return buttons
