"""Drive a headless Chromium through its DevTools protocol, over two pipes: no library, no port."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
LONGEST_S = 30.0
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run", "--disable-extensions")


def chromium() -> str | None:
    """Return the program, None where it is not installed."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Page:
    """A page in the browser.

    Attributes:
        messages: what was written to the console, and exceptions that nobody caught.
        requests: URLs that were asked for, without data URIs and the page itself.
    """

    def __init__(self, to_browser: int, from_browser: int) -> None:
        self._write, self._read, self._buffer, self._number = to_browser, from_browser, b"", 0
        self._session: str | None = None
        self._events: list[dict[str, Any]] = []
        self.messages: list[str] = []
        self.requests: list[str] = []
        target = self._call("Target.createTarget", {"url": "about:blank"})["targetId"]
        self._session = self._call("Target.attachToTarget", {"targetId": target, "flatten": True})["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **given: Any) -> dict[str, Any]:
        """Call a method of the protocol on this page."""
        return self._call(method, given)

    def open(self, path: Path, width: int = 1400, height: int = 900, *, dark: bool = False, script: bool = True) -> None:
        """Open a file, and wait until it is loaded."""
        self.messages.clear()
        self.requests.clear()
        self.call("Emulation.setScriptExecutionDisabled", value=not script)
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 640}
        self.call("Emulation.setDeviceMetricsOverride", **metrics)
        self.call("Emulation.setTouchEmulationEnabled", enabled=width < 640)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        self._events.clear()
        self.call("Page.navigate", url=path.absolute().as_uri())
        self._until(lambda: any(event["method"] == "Page.loadEventFired" for event in self._events))

    def run(self, expression: str) -> Any:
        """Return the value of an expression in JavaScript; a promise is awaited."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise AssertionError(f"{expression}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def wait_for(self, expression: str) -> None:
        """Wait until an expression is true."""
        self._until(lambda: bool(self.run(f"Boolean({expression})")))

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """Dispatch mousePressed, mouseMoved, mouseReleased or mouseWheel at a place of the window."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 5) -> None:
        """Drag with the left button."""
        held = {"button": "left", "buttons": 1, "clickCount": 1}
        self.mouse("mousePressed", *start, **held)
        for step in range(1, steps + 1):
            self.mouse("mouseMoved", *(a + (b - a) * step / steps for a, b in zip(start, end, strict=True)), **held)
        self.mouse("mouseReleased", *end, **held)

    def key(self, key: str) -> None:
        """Press and release a key."""
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key)

    def picture(self, path: Path, *, whole: bool = False) -> None:
        """Write what is seen as PNG; or the whole page."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", captureBeyondViewport=whole)["data"]))

    def _call(self, method: str, given: dict[str, Any]) -> dict[str, Any]:
        self._number += 1
        number, answers = self._number, list[dict[str, Any]]()
        message = {"id": number, "method": method, "params": given}
        session = {} if self._session is None else {"sessionId": self._session}
        data = json.dumps(message | session).encode() + b"\0"
        while data:
            data = data[os.write(self._write, data) :]
        self._until(lambda: bool(answers), lambda event: answers.append(event) if event.get("id") == number else None)
        if "error" in answers[0]:
            raise AssertionError(f"{method}: {answers[0]['error']}")
        return dict(answers[0]["result"])

    def _until(self, done: Callable[[], bool], look: Callable[[dict[str, Any]], object] = lambda _: None) -> None:
        """Receive messages until something holds."""
        last = time.monotonic() + LONGEST_S
        while not done():
            if time.monotonic() > last:
                raise TimeoutError(f"what was waited for did not come; messages of the page: {self.messages}")
            if not select.select([self._read], [], [], 0.1)[0]:
                continue
            self._buffer += os.read(self._read, 2**16)
            *whole, self._buffer = self._buffer.split(b"\0")
            for each in whole:
                event = json.loads(each)
                look(event)
                if "method" in event:
                    self._note(event)

    def _note(self, event: dict[str, Any]) -> None:
        self._events.append(event)
        match event["method"], event["params"]:
            case "Runtime.consoleAPICalled", given:
                self.messages.append(str(given["args"]))
            case "Runtime.exceptionThrown", given:
                self.messages.append(str(given["exceptionDetails"]))
            case "Log.entryAdded", given:
                self.messages.append(given["entry"]["text"])
            case "Network.requestWillBeSent", given:
                if not given["request"]["url"].startswith(("data:", "blob:")) and given.get("type") != "Document":
                    self.requests.append(given["request"]["url"])


@contextmanager
def browser(profile: Path) -> Iterator[Page]:
    """Start a browser, and end it after the block.

    Args:
        profile: a folder for what it keeps.
    """
    program = chromium()
    assert program is not None
    its_input, to_browser = os.pipe()
    from_browser, its_output = os.pipe()
    # The protocol wants the descriptors 3 and 4, which a shell arranges without a fork in this process of many threads.
    command = 'exec 3<&"$1" 4>&"$2"; shift 2; exec "$@"'
    arguments = [program, *FLAGS, "--remote-debugging-pipe", f"--user-data-dir={profile}", "about:blank"]
    process = subprocess.Popen(
        ["bash", "-c", command, "bash", str(its_input), str(its_output), *arguments],
        pass_fds=(its_input, its_output),
        stderr=subprocess.DEVNULL,
    )
    os.close(its_input)
    os.close(its_output)
    try:
        yield Page(to_browser, from_browser)
    finally:
        process.terminate()
        process.wait(LONGEST_S)
        os.close(to_browser)
        os.close(from_browser)
