"""A headless browser that tests drive through its debugging pipe; without one, they are skipped."""

import json
import os
import shutil
import subprocess
import sys
from contextlib import contextmanager

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome", "microsoft-edge")
#: Puts the ends of two pipes where the browser expects them, and becomes the browser.
LAUNCH = """
import fcntl, os, sys
ends = [fcntl.fcntl(int(x), fcntl.F_DUPFD, 10) for x in sys.argv[1:3]]
for end, place in zip(ends, (3, 4)):
    os.dup2(end, place)
os.execv(sys.argv[3], sys.argv[3:])
"""


def browser_command():
    """The browser's command; skips the test where there is none."""
    command = next(filter(None, map(shutil.which, BROWSERS)), None)
    if command is None:
        pytest.skip(f"no browser here ({', '.join(BROWSERS)})")
    return command


class Tab:
    """A page of a running browser: commands of the DevTools protocol, one after another."""

    def __init__(self, read, write):
        self.read, self.write, self.count, self.session = read, write, 0, None
        self.errors = []  # exceptions that no script has caught, and errors of the console

    def send(self, method, **parameters):
        """The result of a command; what happens meanwhile is looked at for errors."""
        self.count += 1
        message = {"id": self.count, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        self.write.write(json.dumps(message).encode() + b"\0")
        self.write.flush()
        while True:
            answer = self.receive()
            if answer.get("id") == self.count:
                assert "error" not in answer, answer
                return answer["result"]
            if answer.get("method") == "Runtime.exceptionThrown":
                self.errors.append(answer["params"]["exceptionDetails"])
            entry = answer.get("params", {}).get("entry", {})
            if entry.get("level") == "error":
                self.errors.append(entry)

    def receive(self):
        letters = bytearray()
        while (letter := self.read.read(1)) != b"\0":
            assert letter, "the browser has ended"
            letters += letter
        return json.loads(letters)

    def evaluate(self, expression):
        """The value of an expression in the page, awaited if it is a promise."""
        answer = self.send(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def drag(self, start, end, steps=5):
        """Press the mouse at one place, move, and let go at another; equal places: a click."""
        self.mouse("mousePressed", *start)
        for k in range(1, steps + 1):
            way = [a + k / steps * (b - a) for a, b in zip(start, end, strict=True)]
            self.mouse("mouseMoved", *way)
        self.mouse("mouseReleased", *end)
        self.settle()

    def mouse(self, kind, x, y):
        self.send(
            "Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1
        )

    def settle(self):
        """Wait until what has changed is drawn."""
        frame = "requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done, 50)))"
        self.evaluate(f"new Promise((done) => {frame})")


@contextmanager
def opened(path, folder, width):
    """A tab that shows a file in a window of this width."""
    command = browser_command()
    (to_read, to_write), (from_read, from_write) = os.pipe(), os.pipe()
    options = ("--headless", "--disable-gpu", "--no-sandbox", "--remote-debugging-pipe")
    own = f"--user-data-dir={folder / 'browser'}"
    ends = str(to_read), str(from_write)
    process = subprocess.Popen(
        [sys.executable, "-c", LAUNCH, *ends, command, *options, own],
        pass_fds=(to_read, from_write),
        stderr=subprocess.DEVNULL,
    )
    os.close(to_read)
    os.close(from_write)
    with os.fdopen(from_read, "rb") as read, os.fdopen(to_write, "wb") as write:
        tab = Tab(read, write)
        try:
            target = tab.send("Target.createTarget", url="about:blank")["targetId"]
            attached = tab.send("Target.attachToTarget", targetId=target, flatten=True)
            tab.session = attached["sessionId"]
            for domain in ("Page", "Runtime", "Log"):
                tab.send(f"{domain}.enable")
            tab.send(
                "Emulation.setDeviceMetricsOverride",
                width=width,
                height=800,
                deviceScaleFactor=1,
                mobile=False,
            )
            tab.send("Page.navigate", url=path.as_uri())
            yield tab
        finally:
            process.kill()
            process.wait()
