"""`edgepose check` as its users run it: on files, on a live rig, and as a page on a real terminal."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import pty
import re
import signal
import struct
import sys
import termios
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from edgepose.formats.recordings.csv import write_csv
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import read_recording
from edgepose.placements import PLACEMENTS
from edgepose.sources import open_source
from tests.support import processes, terminals
from tests.support.ports import Port
from tests.support.processes import ROOT, simulated
from tests.support.terminals import on_a_terminal, rest_of

REAL = Path(__file__).parents[2] / "data" / "imu" / "six-sites-3s.npz"
CLIP = ROOT / "tools" / "data" / "09_12.bvh"


@contextlib.contextmanager
def rig(*flags: object) -> Iterator[str]:
    """Name of a port on which six simulated sensors send a real recording, then its last sample."""
    with simulated(REAL, *flags) as (_, port):
        yield port


@contextlib.contextmanager
def silent_port() -> Iterator[str]:
    """Name of a port on which nothing comes."""
    with Port() as port:
        yield port.name


def table(text: str) -> dict[str, list[str]]:
    """Cells of each sensor's row; the last ones are the finding."""
    return {line.split()[0]: line.split()[1:] for line in text.splitlines() if line.startswith(PLACEMENTS)}


def rows(text: str) -> dict[str, list[str]]:
    """Cells of each sensor's row in the table, advice left out."""
    return table("\n".join(line for line in text.splitlines() if ": " not in line))


# --- files --------------------------------------------------------------------------------------------------


def test_a_good_recording(command):
    result = command("check", "--file", REAL)
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    assert "6 of 6 sensors fine; packets 1800 good, 0 lost" in result.stdout.splitlines()[0]
    found = rows(result.stdout)
    assert list(found) == list(PLACEMENTS)
    assert {cells[-1] for cells in found.values()} == {"ok"}
    assert found["head"][0] == "100.0"
    assert "\033" not in result.stdout


def test_a_recording_without_a_sensor_and_with_one_in_g(command, tmp_path):
    recording = read_recording(REAL)
    sensors = dict(recording.sensors)
    del sensors["head"]
    sensors["pelvis"] = sensors["pelvis"]._replace(acc=sensors["pelvis"].acc / 9.81)
    write_npz(tmp_path / "walk.npz", recording._replace(sensors=sensors))
    result = command("check", "--file", tmp_path / "walk.npz")
    assert result.returncode == 3
    assert result.stderr == ""
    found = rows(result.stdout)
    assert found["head"][-2:] == ["no", "packets"]
    assert found["pelvis"][-1] == "unit"
    assert re.search(r"^head: no packet came from it", result.stdout, re.MULTILINE)
    assert re.search(r"^pelvis: it reads 1.0\d+ at rest, which is in g", result.stdout, re.MULTILINE)
    assert result.stdout.startswith("3 s: 4 of 6 sensors fine")


def test_a_damaged_recording(command, tmp_path):
    file = tmp_path / "walk.csv"
    write_csv(file, read_recording(REAL))
    file.write_text(file.read_text().replace(",head,", ",head,x", 1))
    result = command("check", "--file", file, "--json")
    assert result.returncode == 1, result.stdout
    assert json.loads(result.stdout)["problems"] == 0
    (warning,) = json.loads(result.stdout)["warnings"]
    assert "not a number" in warning
    assert f"warning: {warning}\n" == result.stderr


def test_json(command):
    result = command("check", "--file", REAL, "--json", "--seconds", 2)
    document = json.loads(result.stdout)
    assert result.returncode == 0
    assert document["source"] == str(REAL)
    assert document["problems"] == 0
    assert document["seconds"] == pytest.approx(2.0, abs=0.02)
    assert document["packets"] == pytest.approx(1200, abs=12)
    assert [sensor["placement"] for sensor in document["sensors"]] == list(PLACEMENTS)
    for sensor in document["sensors"]:
        assert sensor["finding"] == "ok"
        assert sensor["problem"] is False
        assert sensor["tilt_deg"] < 1.0
        assert sensor["clock_ppm"] is None
        assert sensor["orientation"] is True


def test_with_a_calibration(command, wearer):
    words = ("check", "--file", wearer.recording, "--seconds", 4, "--calibration", wearer.calibration)
    result = command(*words, "--json")
    assert result.returncode == 0, result.stdout
    for sensor in json.loads(result.stdout)["sensors"]:
        assert sensor["heading_on"] == "body"
        assert abs(sensor["heading_deg"]) < 3.0
        assert sensor["pose_tilt_deg"] < 3.0


# --- live ---------------------------------------------------------------------------------------------------


def test_a_live_rig_with_faults(command):
    with rig("--loss", 0.2, "--kill", "pelvis@0..") as port:
        result = command("check", "--port", port, "--seconds", 3, "--json")
    assert result.returncode == 3
    assert "Traceback" not in result.stderr
    found = {sensor["placement"]: sensor for sensor in json.loads(result.stdout)["sensors"]}
    assert found.pop("pelvis")["finding"] == "no packets"
    for sensor in found.values():
        assert sensor["finding"] == "loss"
        assert 8.0 < sensor["lost_percent"] < 35.0
        assert sensor["rate_hz"] == pytest.approx(100.0, rel=0.05)


def test_a_clock_that_drifts(command):
    with rig("--drift", 5000) as port:
        result = command("check", "--port", port, "--protocol", "native", "--seconds", 9.5, "--json")
    found = [sensor["clock_ppm"] for sensor in json.loads(result.stdout)["sensors"]]
    for i, ppm in enumerate(found):
        assert ppm == pytest.approx(5000 * (1 - i / 2.5), abs=400)


def test_a_port_on_which_nothing_comes(command):
    with silent_port() as port:
        result = command("check", "--port", port, "--protocol", "native", "--seconds", 0.5)
    assert result.returncode == 3
    assert result.stderr == ""
    assert [cells[-2:] for cells in rows(result.stdout).values()] == [["no", "packets"]] * 6


def test_a_silent_line_is_told_once_and_does_not_end_the_others(monkeypatch, caplog):
    monkeypatch.setattr("edgepose.sources.line_checks.SILENCE_S", 0.2)
    sensors = set()
    with rig() as port, silent_port() as other, open_source(port=f"{port},{other}", lenient=True) as source:
        for _, batch, *_ in source:
            sensors |= {sample.sensor for sample in batch}
            if sensors == set(range(6)) and caplog.records:
                break
        assert set(source.clocks) == sensors
    (warning,) = caplog.records
    assert f"{other}: no data for 0.2 s" in warning.getMessage()


# --- the page -----------------------------------------------------------------------------------------------


class Terminal:
    """A terminal of some size that a process has as its own, and what is on its screens."""

    def __init__(self, words: list[object], columns: int = 130, **environment: str) -> None:
        self.master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 30, columns, 0, 0))
        self._read = b""
        self.process = processes.Popen(
            [sys.executable, "-m", "edgepose", "check", *map(str, words)],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
            preexec_fn=terminals.take_terminal,
            env={k: v for k, v in os.environ.items() if k not in ("COLUMNS", "LINES", "NO_COLOR")}
            | {"TERM": "xterm"}
            | environment,
        )
        os.close(slave)

    @property
    def text(self) -> str:
        """What has been written so far."""
        return self._read.decode(errors="ignore")  # the last character may not be whole

    def until(self, pattern: str) -> None:
        """Reads on until something has been written."""
        while not re.search(pattern, self.text, re.DOTALL):
            self._read += os.read(self.master, 4096)

    def rest(self) -> int:
        """Reads to the end; the exit code."""
        self._read += rest_of(self.master)
        return self.process.wait()

    def press(self, keys: bytes) -> None:
        os.write(self.master, keys)

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self.master)


def plain(text: str) -> str:
    return re.sub(r"\033\[[?\d;]*[A-Za-z]", "", text).replace("\r", "")


@pytest.mark.parametrize("stop", ["Ctrl-C", "SIGTERM"])
def test_the_page_is_drawn_in_place_until_it_is_stopped(stop):
    with rig() as port, Terminal(["--port", port]) as terminal:
        terminal.until(r"(\033\[H.*){6}")
        terminal.until(r"pelvis +\d+\.\d [^\n]* \033\[3\dm")
        if stop == "Ctrl-C":
            terminal.press(b"\x03")
        else:
            terminal.process.send_signal(signal.SIGTERM)
        code = terminal.rest()
    before, _, after = terminal.text.partition("\033[?1049l")
    assert before.startswith("\033[?1049h\033[?25l")
    pages = before.split("\033[H")[1:]
    assert all(page.endswith("\033[J") for page in pages[:-1])
    title, headline, *_ = plain(pages[-1]).splitlines()
    assert title == f"edgepose check; Ctrl-C ends it  {port}"
    assert re.match(r"\d+ s: \d of 6 sensors fine; packets \d+ good", headline)
    # The table stays when the page has gone, and the cursor is back.
    assert before.endswith("\033[?25h")
    assert list(rows(plain(after))) == list(PLACEMENTS)
    assert code == (0 if "6 of 6 sensors fine" in after else 1)
    assert "Traceback" not in terminal.text


@pytest.mark.parametrize("columns", [40, 80, 200])
def test_lines_fit_into_the_terminal(columns):
    with rig() as port, Terminal(["--port", port, "--seconds", 3], columns) as terminal:
        terminal.rest()
    pages, _, final = terminal.text.partition("\033[?1049l")
    lines = plain(pages + final).splitlines()
    assert max(map(len, lines)) <= columns
    found = rows(plain(final))
    assert list(found) == list(PLACEMENTS)
    assert (len(found["head"]) > 7) == (columns > 60)


def test_no_colours_where_nobody_wants_them():
    with rig() as port, Terminal(["--port", port, "--seconds", 1.5], NO_COLOR="1") as terminal:
        terminal.rest()
    assert "\033[H" in terminal.text
    assert not re.search(r"\033\[\d*m", terminal.text)


def test_a_dumb_terminal_gets_the_table_alone():
    with Terminal(["--file", REAL], TERM="dumb") as terminal:
        assert terminal.rest() == 0, terminal.text[-2500:]
    assert "\033" not in terminal.text
    assert {cells[-1] for cells in rows(plain(terminal.text)).values()} == {"ok"}


def test_warnings_are_on_the_page_and_stay(tmp_path):
    with (
        silent_port() as port,
        Terminal(["--port", port, "--protocol", "native", "--seconds", 5.6]) as terminal,
    ):
        assert terminal.rest() == 3
    page, _, after = terminal.text.partition("\033[?1049l")
    assert f"{port}: no data for 5 s" in plain(page).replace("\n  ", " ")
    assert f"warning: {port}: no data for 5 s" in after


# --- wrong use ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        ("", 2, "give one source"),
        ("--port x --realtime", 2, "--realtime is for a --file: live sensors have their own pace"),
        ("--file REAL --baud 9600", 2, "--baud is for --port"),
        ("--port x --fd", 2, "--fd is for --can"),
        ("--file REAL --port x", 2, "give one source"),
        ("--file REAL --seconds 0", 2, "--seconds"),
        ("--file nowhere.npz", 1, "cannot read it"),
        ("--port /dev/ttyNOWHERE7", 1, "no such port"),
        ("--file REAL --calibration REAL", 1, "not valid JSON"),
    ],
)
def test_wrong_use(command, words, code, says):
    result = command("check", *words.replace("REAL", str(REAL)).split())
    assert result.returncode == code
    assert says in result.stderr
    assert "Traceback" not in result.stderr


def test_equal_findings_are_said_once_and_the_same_everywhere(command, tmp_path):
    """On a terminal and in a pipe, with the range of the numbers."""
    recording = read_recording(REAL)
    for i, (name, data) in enumerate(recording.sensors.items()):
        recording.sensors[name] = data._replace(gyr=data.gyr + np.radians(6.0 + i) * (i != 4))
    write_npz(tmp_path / "biased.npz", recording)
    words = ("check", "--file", tmp_path / "biased.npz")
    code, screen = on_a_terminal([sys.executable, "-m", "edgepose", *words])
    piped = command(*words)
    assert code == piped.returncode == 3
    (line,) = [line for line in piped.stdout.splitlines() if "deg/s at rest" in line]
    names = ", ".join(name for name in PLACEMENTS if name != "head")
    assert re.fullmatch(rf"{names}: its rate is 10\.\d to 19\.\d deg/s at rest: keep it still .*", line)
    assert line in " ".join(plain(screen.decode()).replace("\r", "").split())


def test_simulated_sensors_are_fine(command):
    """In motion, too: they have noise."""
    with simulated(CLIP, "--mounting", 7) as (_, port):
        result = command("check", "--port", port, "--seconds", 9, "--protocol", "native")
    assert "6 of 6 sensors fine" in result.stdout
    assert result.returncode == 0
