"""Headless Chromium for tests of web pages, driven over a pipe with Chromium's own DevTools protocol."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import pytest

EXECUTABLE = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_chromium = pytest.mark.skipif(EXECUTABLE is None, reason="no chromium on PATH: apt-get install chromium")

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--force-color-profile=srgb",
    "--hide-scrollbars",
    "--force-prefers-reduced-motion",  # or the viewer would turn its scene before a test looks at it
    "--remote-debugging-pipe",
)

LAUNCH = (
    "import os, sys; os.dup2(int(sys.argv[1]), 3); os.dup2(int(sys.argv[2]), 4); os.execv(sys.argv[3], sys.argv[3:])"
)
"""Chromium reads commands from descriptor 3 and answers on 4."""


class PageError(Exception):
    """A script in the page threw."""


class Page:
    """One tab."""

    def __init__(self, reader: int, writer: int) -> None:
        self._reader, self._writer, self._numbers, self._rest = reader, writer, count(1), b""
        self._session: str | None = None
        self.events: list[dict[str, Any]] = []
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **params: Any) -> dict[str, Any]:
        """The result of a command of the protocol; events meanwhile are kept in ``events``."""
        message = {"id": next(self._numbers), "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        data = json.dumps(message).encode() + b"\0"
        while data:
            data = data[os.write(self._writer, data) :]
        while True:
            answer = self._receive()
            if answer.get("id") == message["id"]:
                if "error" in answer:
                    raise PageError(answer["error"]["message"])
                return dict(answer["result"])
            self.events.append(answer)

    def _receive(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            part = os.read(self._reader, 1 << 20)
            if not part:
                raise PageError("chromium closed its pipe")
            self._rest += part
        data, self._rest = self._rest.split(b"\0", 1)
        return dict(json.loads(data))

    def open(self, url: str, width: int, height: int, ratio: float = 1, mobile: bool = False) -> None:
        """Load a page into a window of this size in css pixels and wait until its scripts have run."""
        size = {"width": width, "height": height, "deviceScaleFactor": ratio, "mobile": mobile}
        self.send("Emulation.setDeviceMetricsOverride", **size)
        self.send("Emulation.setTouchEmulationEnabled", enabled=mobile)
        self.send("Page.navigate", url=url)
        self.run(
            "new Promise(resolve => document.readyState === 'complete' ? resolve() : addEventListener('load', resolve))"
        )

    def run(self, expression: str) -> Any:
        """The value of a JavaScript expression, of the result of its promise if it is one."""
        result = self.send("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in result:
            details = result["exceptionDetails"]
            raise PageError(details.get("exception", {}).get("description", details["text"]))
        return result["result"].get("value")


@contextmanager
def chromium(profile: Path) -> Iterator[Page]:
    """A page of a Chromium of its own, with its profile in a folder."""
    import fcntl  # which Windows lacks

    assert EXECUTABLE is not None
    commands, writer = os.pipe()
    reader, answers = os.pipe()
    ends = [fcntl.fcntl(end, fcntl.F_DUPFD, 100) for end in (commands, answers)]  # not yet 3 or 4 themselves
    arguments = [sys.executable, "-ISc", LAUNCH, *map(str, ends), EXECUTABLE, *FLAGS, f"--user-data-dir={profile}"]
    process = subprocess.Popen(arguments, pass_fds=ends, stderr=subprocess.DEVNULL)
    for end in (commands, answers, *ends):
        os.close(end)
    try:
        yield Page(reader, writer)
    finally:
        os.close(writer)  # chromium ends when its pipe does
        os.close(reader)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
