"""A headless Firefox for tests of the live pages, driven over its own protocol."""

import json
import re
import subprocess
import time

import pytest


class Firefox:
    """The Firefox on the PATH, by WebDriver BiDi: Playwright drives only one of its own."""

    def __init__(self, path, profile):
        websocket = pytest.importorskip("websocket", reason="pip install -r environment.txt")
        command = [path, "--headless", "--no-remote", "--profile", str(profile)]
        self.process = subprocess.Popen(
            [*command, "--remote-debugging-port=0"], stderr=subprocess.PIPE, text=True
        )
        told = (re.search(r"listening on (ws://\S+)", line) for line in self.process.stderr)
        self.socket = websocket.create_connection(
            next(filter(None, told))[1] + "/session", timeout=60, suppress_origin=True
        )
        self.number = 0
        self.call("session.new", capabilities={})
        # On a busy machine Firefox opens its start page late, and in the first tab.
        self.tab = self.call("browsingContext.create", type="tab")["context"]

    def call(self, method, **parameters):
        """One command; returns its result."""
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "method": method, "params": parameters}))
        while (answer := json.loads(self.socket.recv())).get("id") != self.number:
            pass
        assert answer["type"] == "success", answer
        return answer["result"]

    def open(self, address):
        """Open a page. On a busy machine a new tab's blank page comes late, and in its place."""
        deadline = time.monotonic() + 60
        while True:
            self.call("browsingContext.navigate", context=self.tab, url=address, wait="complete")
            if (found := self.evaluate("() => location.href")) == address:
                return
            assert time.monotonic() < deadline, found

    def reload(self):
        """Open the page again, as its reader does: Firefox keeps what the controls say."""
        self.call("browsingContext.reload", context=self.tab, wait="complete")

    def evaluate(self, function, argument=None):
        """The value of a function, or of the promise that it returns, in the page."""
        script = f"Promise.resolve(({function})({json.dumps(argument)})).then(JSON.stringify)"
        target = {"context": self.tab}
        found = self.call("script.evaluate", expression=script, target=target, awaitPromise=True)
        assert found["type"] == "success", found
        return json.loads(found["result"].get("value", "null"))

    def close(self):
        """End it."""
        self.socket.close()
        self.process.terminate()
        self.process.wait(20)
