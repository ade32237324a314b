"""Draws poses in a browser: those of a BVH file with three.js, or a file of poses in edgepose's own view.

    npm install --prefix three three@0.187
    python tools/draw_browser.py three sitter.bvh --modules three/node_modules --at 25 --at 50 \
        --look 0.4,0.6,0.9 --from 4.4,1.3,1.9 --out three-sitting.png
    python tools/draw_browser.py view walker.csv --at 10 --out view-path.png

Needs Debian's chromium-headless-shell. The first one prints the heights of the pelvis and of the lowest joint
of the feet, metres.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import json
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from tests.support.browser import Browser, until  # noqa: E402

PAGE = ROOT / "tools" / "draw_three.html"
PLAY = "[...document.querySelectorAll('input[type=checkbox]')].find(box => !box.id.startsWith('mantine'))"
"""The box `play` of the view."""
TIME = "document.querySelector('input[inputmode=decimal]')"
"""The number beside the time line."""


def free_port() -> int:
    """Return a TCP port that no program uses."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return int(listening.getsockname()[1])


@contextlib.contextmanager
def page(width: int, height: int) -> Iterator[Browser]:
    """Yield a browser with a page of this size."""
    with tempfile.TemporaryDirectory() as folder, contextlib.closing(Browser(Path(folder))) as browser:
        browser.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        yield browser


@contextlib.contextmanager
def server(command: list[str], folder: Path | None = None) -> Iterator[None]:
    """Run a Python program that serves a page."""
    process = subprocess.Popen(
        [sys.executable, "-m", *command],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield
    finally:
        process.terminate()
        process.wait()


def save(browser: Browser, out: Path) -> None:
    """Write the picture of the page."""
    out.write_bytes(base64.b64decode(browser.call("Page.captureScreenshot")["data"]))


def three(given: argparse.Namespace) -> None:
    """Draw poses of a BVH file with three.js."""
    port = free_port()
    query = f"at={','.join(map(str, given.at))}&look={given.look}&from={given.camera}"
    with tempfile.TemporaryDirectory() as name, page(700, 370) as browser:
        folder = Path(name)
        shutil.copy(given.poses, folder / "motion.bvh")
        shutil.copy(PAGE, folder)
        (folder / "node_modules").symlink_to(given.modules.resolve())
        with server(["http.server", str(port), "--bind", "127.0.0.1"], folder):
            time.sleep(1.0)
            browser.call("Page.navigate", url=f"http://127.0.0.1:{port}/{PAGE.name}?{query}")
            until(lambda: browser.run("window.result"), "three.js", 300)
            result = json.loads(str(browser.run("window.result")))
            save(browser, given.out)
    print(f"three.js r{result['revision']}")
    for pose in result["poses"]:
        print(f"at {pose['second']:g} s: pelvis {pose['pelvis']:.3f}, feet {pose['feet']:.3f} m")


def view(given: argparse.Namespace) -> None:
    """Draw a pose of a file in the view, stopped at this time."""
    port = free_port()

    def shown_s() -> float:
        shown = re.search(r"pose (\d+) of", browser.text())
        return int(shown[1]) / 60.0 if shown else -1.0

    command = ["edgepose", "view", str(given.poses), "--page-port", str(port)]
    with page(1000, 480) as browser, server(command):
        time.sleep(4.0)
        browser.call("Page.navigate", url=f"http://127.0.0.1:{port}")
        until(lambda: "poses/s" in browser.text(), "the view", 120)
        browser.run(f"{PLAY}.click()")
        until(lambda: not browser.run(f"{PLAY}.checked"), "the pause")
        time.sleep(3.0)
        browser.run(f"{TIME}.focus(); {TIME}.select()")
        browser.call("Input.insertText", text=f"{given.at[0]:g}")
        browser.run(f"{TIME}.blur()")
        until(lambda: abs(shown_s() - given.at[0]) < 0.1, "the time")
        browser.run("document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())")
        time.sleep(6.0)
        save(browser, given.out)
        print(f"at {shown_s():.2f} s")


def main() -> None:
    """Draw a picture."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(required=True)
    for run in (three, view):
        command = commands.add_parser(run.__name__, help=run.__doc__)
        command.set_defaults(run=run)
        command.add_argument("poses", type=Path)
        command.add_argument(
            "--at", type=float, action="append", required=True, help="seconds since the start"
        )
        command.add_argument("--out", type=Path, required=True)
        if run is three:
            command.add_argument("--modules", type=Path, required=True, help="node_modules with three")
            command.add_argument("--look", required=True, metavar="X,Y,Z", help="point in the middle, metres")
            command.add_argument(
                "--from", dest="camera", required=True, metavar="X,Y,Z", help="camera, metres"
            )
    given = parser.parse_args()
    given.run(given)


if __name__ == "__main__":
    main()
