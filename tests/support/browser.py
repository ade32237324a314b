"""A browser that shows pages of programs under test."""

from __future__ import annotations

import base64
import io
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from websockets.sync.client import connect

CHROMIUM = next(filter(None, map(shutil.which, ("chromium-headless-shell", "chromium", "chrome"))), None)
needs_browser = pytest.mark.skipif(
    CHROMIUM is None, reason="no browser: install Debian's chromium-headless-shell"
)


def until(asked: Callable[[], object], what: str, seconds: float = 60.0) -> None:
    """Returns once the answer is true."""
    end = time.monotonic() + seconds
    while not asked():
        assert time.monotonic() < end, what
        time.sleep(0.05)


class Browser:
    """A page of a headless Chromium, spoken to by its own protocol."""

    def __init__(self, folder: Path, size: str = "800,500") -> None:
        command = [CHROMIUM, "--no-sandbox", "--headless", "--enable-unsafe-swiftshader", "--disable-gpu"]
        command += ["--remote-debugging-port=0", f"--window-size={size}", f"--user-data-dir={folder}"]
        # In a group of its own, which ends with this program however that ends: Debian's command is a script,
        # and the browser does not end with it.
        self.process = subprocess.Popen(
            ["sh", "-c", '"$@" & read closed; kill -9 0', "sh", *command, "about:blank"],
            stdin=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        self._count = 0
        try:
            self.socket = connect(self._page(folder / "DevToolsActivePort"), max_size=None)
        except BaseException:
            self._end()
            raise

    def _page(self, told: Path) -> str:
        """The address of the page's debugger, which the browser tells in a file."""
        until(lambda: told.exists() and "\n" in told.read_text(), "the browser")
        port = told.read_text().splitlines()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            page = next(target for target in json.load(answer) if target["type"] == "page")
        return str(page["webSocketDebuggerUrl"])

    def call(self, method: str, **words: object) -> dict:
        self._count += 1
        self.socket.send(json.dumps({"id": self._count, "method": method, "params": words}))
        while (answer := json.loads(self.socket.recv(timeout=60))).get("id") != self._count:
            pass
        return answer["result"]

    def run(self, script: str) -> object:
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def text(self) -> str:
        return str(self.run("document.body.innerText"))

    def image(self) -> np.ndarray:
        data = base64.b64decode(self.call("Page.captureScreenshot")["data"])
        return matplotlib.image.imread(io.BytesIO(data))[..., :3]

    def close(self) -> None:
        self.socket.close()
        self._end()

    def _end(self) -> None:
        self.process.stdin.close()
        self.process.wait()
