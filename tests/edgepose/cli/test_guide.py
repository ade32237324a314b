"""The guide of `edgepose calibrate`: big words on a terminal, and the page for a phone in a real browser."""

from __future__ import annotations

import contextlib
import http.client
import json
import re
import socket
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from edgepose.calibration import headings_from_steps
from edgepose.cli.guide.big_words import big_word
from edgepose.cli.guide.guide import Guide, end_stage, start_stage
from edgepose.cli.guide.phone_page import PhonePage, address_in_network
from edgepose.cli.guide.stage import COUNTDOWN, HOLD, MOVE, Stage
from edgepose.cli.guide.terminal_page import page_lines
from edgepose.cli.prompts import _INSTRUCTIONS, _MOVES, _STEPS, record_steps
from edgepose.errors import DeviceError
from edgepose.imu import ImuSample
from edgepose.sources import Batch
from tests.support import processes
from tests.support.browser import Browser, needs_browser, until
from tests.support.datagrams import free_address
from tests.support.processes import ROOT, simulated
from tests.support.walkers import HEADINGS, walker

CLIP = ROOT / "tools" / "data" / "09_12.bvh"
STAGES = [
    *(Stage(HOLD, "HOLD", f"Hold still. {text}", pose, 4.0) for pose, text in _INSTRUCTIONS.items()),
    *(Stage(MOVE, word, "Lift it", figure, 4.0) for word, figure in _MOVES.values()),
    Stage(MOVE, "STEPS", _STEPS, "step", 8.0),
    Stage(COUNTDOWN, "", "Stand", "straight", 10.0),
]


def test_a_big_word():
    assert big_word("hi 1", 30, 5) == [
        "██  ██  ██████    ██",
        "██  ██    ██    ████",
        "██████    ██      ██",
        "██  ██    ██      ██",
        "██  ██  ██████  ██████",
    ]
    assert len(big_word("10", 80, 12)) == 10
    assert big_word("RIGHT", 20, 20) == ["RIGHT"]


@pytest.mark.parametrize(("columns", "rows"), [(80, 24), (40, 24), (20, 10), (200, 60)])
@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: f"{stage.word} {stage.figure}")
def test_the_page_fits_the_terminal(stage, columns, rows):
    lines = page_lines(stage, 1.2, ["a long note " * 20] * 5, columns, rows)
    assert max(map(len, lines)) <= columns
    assert ("Ctrl-C ends it" in lines[0]) == (columns >= 40)
    if columns >= 80:
        few = page_lines(stage, 1.2, ["All six sensors report."], columns, rows)
        assert len(few) < rows
        assert sum("█" in line for line in few) >= 10


def batches_of(*walks: dict[str, object]) -> Iterator[Batch]:
    """Samples of one wearer who walks several times, at ten batches a second."""
    begin_s = 0.0
    for options in walks:
        sensors = walker(stand_s=(3.6, 5.0), **options)
        for k in range(0, len(sensors[0].time_s), 6):
            rows = [(i, s, j) for i, s in enumerate(sensors) for j in range(k, min(k + 6, len(s.time_s)))]
            times = begin_s + sensors[0].time_s
            samples = [ImuSample(i, float(times[j]), tuple(s.quat[j]), tuple(s.acc[j])) for i, s, j in rows]
            yield Batch(float(times[k]), samples)
        begin_s += float(sensors[0].time_s[-1])


def test_steps_are_guided_and_repeated(capsys):
    upright = np.stack([sensor.quat[0] for sensor in walker()])
    with Guide() as guide:
        reset = record_steps(
            batches_of({"distance_m": 0.1}, {}),
            10.0,
            guide,
            lambda moving: headings_from_steps(moving, upright),
        )
    assert np.degrees(np.abs(np.angle(np.exp(1j * (reset.offset + HEADINGS))))).max() < 1.5
    lines = capsys.readouterr().out.splitlines()
    walk = "Take two or three steps straight ahead, stop with arms hanging, and stand still"
    assert lines[0] == f"Stand still until the steps begin. {walk}."
    assert lines[1:3] == [f"In 3 s: Stand still. Then: {walk}.", f"{walk} (8 s)."]
    assert "too short" in lines[3]
    assert lines[3].endswith("Trying again.")


@contextlib.contextmanager
def served() -> Iterator[PhonePage]:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(DeviceError, match=f"cannot serve a page at 127.0.0.1:{port}: "):
            PhonePage("127.0.0.1", port)
    with PhonePage("127.0.0.1", port) as page:
        yield page


def asked(port: int, method: str, path: str, **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    with contextlib.closing(connection):
        connection.putrequest(method, path, skip_host=True)
        for name, value in ({"Host": f"127.0.0.1:{port}"} | headers).items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        return answer.status, answer.read()


def test_the_page_takes_its_own_buttons_and_nothing_else():
    with served() as page:
        page.show(start_stage("Press start", "straight"), 0.0, ["<b>note"])
        state = json.loads(asked(page.port, "GET", "/state")[1])
        assert (state["word"], state["buttons"], state["notes"]) == ("START", ["start"], ["<b>note"])
        assert asked(page.port, "GET", "/../pyproject.toml")[0] == 404
        assert asked(page.port, "POST", "/repeat")[0] == 404  # not shown now
        assert asked(page.port, "POST", "/start", Origin="http://evil.example")[0] == 403
        assert asked(page.port, "GET", "/state", Host="evil.example")[0] == 403  # a name bent to this address
        assert asked(page.port, "GET", "/state", Host="[")[0] == 403
        assert asked(page.port, "POST", "/start", Origin="http://[")[0] == 403
        assert asked(page.port, "PUT", "/start")[0] == 501
        assert page.pressed() is None
        assert asked(page.port, "POST", "/start", Origin=f"http://127.0.0.1:{page.port}")[0] == 204
        assert asked(page.port, "POST", "/start")[0] == 204
        assert page.pressed() == "start"
        assert page.pressed() is None
        page.show(end_stage("GOOD", "done", "straight"), 0.0, [])
        assert json.loads(asked(page.port, "GET", "/state")[1])["buttons"] == ["repeat", "finish"]


def test_the_page_is_found_by_the_name_that_was_given():
    host, port = free_address().split(":")
    with PhonePage("0X7F.1", int(port)) as page:  # browsers write names in small letters
        assert page.is_local
        assert asked(page.port, "GET", "/state", Host=f"0x7f.1:{port}")[0] == 200
    with PhonePage("0.0.0.0", int(port)) as page:  # the same port at once, as when a calibration is repeated
        assert not page.is_local
        assert page.url == f"http://{address_in_network() or '0.0.0.0'}:{port}/"
        assert asked(page.port, "GET", "/state", Host=f"{host}:{port}")[0] == 200


def test_many_silent_connections_do_not_stop_the_page():
    with served() as page, contextlib.ExitStack() as stack:
        page.show(start_stage("Press start", "straight"), 0.0, [])
        for _ in range(40):
            stack.enter_context(socket.create_connection(("127.0.0.1", page.port)))
        until(lambda: _answers(page.port), "the page")


def _answers(port: int, method: str = "GET", path: str = "/state") -> bool:
    try:
        return asked(port, method, path)[0] < 300
    except (OSError, http.client.HTTPException):
        return False


@needs_browser
def test_a_calibration_on_a_phone(tmp_path):
    """Start, a repetition, and the end, by the buttons of the page at a phone's size."""
    out = tmp_path / "calib.json"
    with (
        simulated(CLIP, "--mounting", 7, "--stand") as (_, port),
        contextlib.closing(Browser(tmp_path / "chromium", "390,844")) as browser,
    ):
        address = free_address()
        words = ("--port", port, "--protocol", "native", "--body-frame", "heading:0", "--out", out)
        words += ("--page", address, "--hold", 1, "--countdown", 1)
        process = processes.Popen(
            [sys.executable, "-m", "edgepose", "calibrate", *map(str, words)],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        try:
            until(lambda: _listens(address), "the page")
            browser.call("Page.navigate", url=f"http://{address}/")
            until(lambda: "START" in browser.text(), "the start button")
            assert browser.run("document.documentElement.scrollWidth <= innerWidth") is True
            for button, end in (("start", "GOOD"), ("repeat", "START"), ("start", "GOOD")):
                browser.run(f"document.querySelector('button.{button}').click()")
                until(lambda end=end: end in browser.text(), end)
            assert "The calibration is good." in browser.text()
            assert browser.run("sound.state") is not None
            browser.run("document.querySelector('button.finish').click()")
            text = process.communicate(timeout=60)[0]
        finally:
            process.kill()
            process.wait()
    assert process.returncode == 0, text
    assert f"Page for the wearer: http://{address}/" in text
    assert text.count(f"Wrote {out}.") == 2
    assert json.loads(out.read_text())["pose"] == "straight"


def test_standard_output_gets_the_last_of_several_calibrations():
    address = free_address()
    page_port = int(address.partition(":")[2])
    words = ("--protocol", "native", "--body-frame", "heading:0", "--out", "-", "--page", address)
    with simulated(CLIP, "--mounting", 7, "--stand") as (_, port):
        process = processes.start(
            *("calibrate", "--port", port, *words, "--hold", 0.5, "--countdown", 0),
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        )  # fmt: skip
        try:
            for button in ("start", "repeat", "start", "finish"):
                until(lambda path=f"/{button}": _answers(page_port, "POST", path), button)
            out, errors = process.communicate(timeout=60)
        finally:
            process.kill()
            process.wait()
    assert process.returncode == 0, errors
    assert errors.count("The calibration is good.") == 2
    assert json.loads(out)["pose"] == "straight"


@needs_browser
def test_the_buttons_come_back_with_the_network(tmp_path):
    host, port = free_address().split(":")
    with contextlib.closing(Browser(tmp_path / "chromium", "390,844")) as browser:
        for attempt in range(2):
            with PhonePage(host, int(port)) as page:
                page.show(start_stage("Press start", "straight"), 0.0, [])
                if attempt == 0:
                    browser.call("Page.navigate", url=page.url)
                until(lambda: browser.run("document.querySelectorAll('button').length") == 1, "the button")
            until(lambda: "edgepose has ended" in browser.text(), "the end")


def _listens(address: str) -> bool:
    host, port = address.split(":")
    try:
        socket.create_connection((host, int(port))).close()
    except OSError:
        return False
    return True


def test_a_page_needs_live_sensors(command, tmp_path):
    result = command("calibrate", "--file", "walk.npz", "--page")
    assert result.returncode == 2
    assert re.search(r"--page guides a wearer in front of live sensors", result.stderr)
