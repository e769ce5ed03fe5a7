"""Submissions of an imaginary class: most drive, seventeen misbehave, each in its own way."""

from stad_course.compete.drive import STARTER

AGENT = """
import os, sys, time, subprocess, socket, threading
import numpy as np

class Agent:
    frame = 0
    def act(self, observation):
        self.frame += 1
        {act}
        return [0.0, 0.1, 0.0]

{top}
def make_agent():
    {make}
    return Agent()

{last}
"""
# Name: (where the line stands, the line, a part of what its author reads).
MISBEHAVE = {
    "crash": ("act", "if self.frame == 5: raise KeyError('speed')", "KeyError: 'speed' (crash.py"),
    "crash_at_import": ("top", "import no_such_module", "no_such_module"),
    "no_make_agent": ("last", "del make_agent", "no function make_agent()"),
    "hang": ("act", "if self.frame == 5: time.sleep(3600)", "longer than the limit"),
    "hang_at_start": ("make", "while True: pass", "longer than the limit"),
    "nan": ("act", "if self.frame == 5: return [float('nan'), 0, 0]", "not finite"),
    "wrong_shape": ("act", "return [0.0, 1.0]", "shape (2,), expected (3,)"),
    "text": ("act", "return 'left'", "could not convert"),
    "leaves": ("act", "if self.frame == 5: sys.exit(3)", "it called sys.exit"),
    "ends": ("act", "if self.frame == 5: os._exit(3)", "ended by itself"),
    "kills_itself": ("act", "if self.frame == 5: os.kill(os.getpid(), 9)", "ended"),
    "memory": ("act", "if self.frame == 5: self.hog = np.ones((9000, 1000, 100))", "memory"),
    "forks": ("act", "for _ in range(200): subprocess.Popen(['sleep', '60'])", ""),
    "noise": ("act", "os.write(3, b'x' * 99); os.write(4, b'x' * 99)", ""),
    "syntax": ("top", "def broken(:", "SyntaxError"),
    "floods": ("act", "for _ in range(200): print('x' * 10_000_000)", "longer than the limit"),
    "network": ("act", "socket.create_connection(('192.0.2.1', 80), 1)", ""),
}
# These do no harm, and their authors need not hear of anything.
CHEATS = {
    "prints": ("act", "print('left'); print('right', file=sys.stderr)"),
    "patches": ("top", "import stad_lab.envs.cars as c; c.Cars.step = lambda *a: ([999.0], [0])"),
}


def source(place: str, line: str) -> str:
    """The file of a submission with one line of its own."""
    return AGENT.format(**{"act": "pass", "top": "", "make": "pass", "last": ""} | {place: line})


def write_class(folder, good: int, misbehaving=tuple(MISBEHAVE)) -> None:
    """Write `good` copies of the first agent, the cheats, and those that misbehave."""
    folder.mkdir(parents=True, exist_ok=True)
    first = (STARTER / "my_agent.py").read_text(encoding="utf-8")
    for number in range(good):
        text = first.replace("/ 24", f"/ {20 + number}")
        (folder / f"student{number:02d}.py").write_text(text, encoding="utf-8")
    for name, (place, line) in CHEATS.items():
        (folder / f"{name}.py").write_text(source(place, line), encoding="utf-8")
    for name in misbehaving:
        (folder / f"{name}.py").write_text(source(*MISBEHAVE[name][:2]), encoding="utf-8")
