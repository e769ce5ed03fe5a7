"""The live pages in a headless Firefox, from the disk.

Playwright cannot drive a distribution's Firefox, so this speaks Marionette, Firefox's own protocol:
`length:[0, number, command, parameters]` there, and `length:[1, number, error, result]` back.
"""

import json
import shutil
import socket
import subprocess
import time

import pytest

FIREFOX = shutil.which("firefox-esr") or shutil.which("firefox")
SLOW = 120  # seconds to wait for anything: a busy machine is no fault
WATCH = """
const [done] = arguments;
const ready = () => {
    const state = document.querySelector("#live").dataset.state;
    if (state === "loading") setTimeout(ready, 20);
    else done(state === "ready" ? "ready" : document.querySelector("#message").textContent);
};
ready();
"""
CLICK = """
const errors = [];
window.addEventListener("error", (event) => errors.push(event.message));
for (const button of document.querySelectorAll("#live button")) button.click();
for (const range of document.querySelectorAll("#live input[type=range]")) {
    range.value = range.max;
    range.dispatchEvent(new Event("input", { bubbles: true }));
}
return [document.querySelector("#live").dataset.state, errors];
"""


class Marionette:
    """A connection to a Firefox."""

    def __init__(self, port):
        self.socket, self.number = socket.create_connection(("127.0.0.1", port), SLOW), 0
        self.receive()  # its greeting

    def receive(self):
        """The next message."""
        length = b""
        while (one := self.socket.recv(1)) != b":":
            length += one
        message = b""
        while len(message) < int(length):
            message += self.socket.recv(int(length) - len(message))
        return json.loads(message)

    def __call__(self, command, **parameters):
        """Run a command; an AssertionError if Firefox reports an error."""
        self.number += 1
        message = json.dumps([0, self.number, command, parameters]).encode()
        self.socket.sendall(b"%d:%b" % (len(message), message))
        _, _, error, result = self.receive()
        assert error is None, error
        return result


@pytest.fixture(scope="module")
def firefox(tmp_path_factory):
    """A headless Firefox with a profile of its own."""
    if not FIREFOX:
        pytest.skip("no firefox on the PATH: install it (Debian: apt-get install firefox-esr)")
    profile = tmp_path_factory.mktemp("profile")
    (profile / "user.js").write_text('user_pref("marionette.port", 0);\n')  # 0: any free one
    command = [FIREFOX, "--headless", "--marionette", "--profile", profile]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    told = profile / "MarionetteActivePort"
    for _ in range(10 * SLOW):
        if told.exists() and told.read_text():
            break
        time.sleep(0.1)
    marionette = Marionette(int(told.read_text()))
    marionette("WebDriver:NewSession")
    yield marionette
    process.terminate()
    process.wait(SLOW)


@pytest.mark.parametrize("name", ["dream", "latent", "nat", "evolution", "speeds"])
def test_a_page_works_in_firefox(firefox, live_pages, name):
    firefox("WebDriver:Navigate", url=(live_pages / f"{name}.html").as_uri())
    found = firefox("WebDriver:ExecuteAsyncScript", script=WATCH, args=[])
    assert found["value"] == "ready"
    found = firefox("WebDriver:ExecuteScript", script=CLICK, args=[])
    assert found["value"] == ["ready", []]
