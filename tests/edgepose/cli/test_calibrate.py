"""`edgepose calibrate` from recordings and from a serial line with native packets."""

from __future__ import annotations

import json
import math
import os
import pty
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from edgepose import calibration as cal
from edgepose import rotations as rot
from edgepose.cli.calibration_verdict import next_command
from edgepose.cli.commands.calibrate import calibrate
from edgepose.config import SourceConfig
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.base import recording_from_samples
from edgepose.formats.recordings.csv import write_csv
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.raw_capture import times_header, times_path, times_row
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import ImuSample, Recording, SensorData
from edgepose.placements import BONES, PLACEMENTS
from edgepose_export.synthesis.heading_routine import ASIDE_DEG, exercises
from firmware_protocols import native, native_packet
from firmware_protocols.registry import PROTOCOLS
from firmware_protocols.sample import Sample
from tests.support import processes
from tests.support.ports import Port, Sender
from tests.support.walkers import HEADINGS, walker

REAL = Path(__file__).parents[2] / "data" / "imu" / "six-sites-3s.npz"

# A wearer who faces `FACING` in the pelvis sensor's inertial frame; the other sensors' headings are off.
FACING = math.radians(70)
R_TI = cal.body_from_inertial(np.tile([1.0, 0, 0, 0], (6, 1)), "heading:70")
ERRORS = np.array([0.5, -1.0, 2.0, -2.5, 0.1, 0.0])
R_BS = rot.rotvec_to_matrix(np.random.default_rng(3).normal(0.0, 1.0, (6, 3)))
R_BS[5] = rot.rotation_about_axis("y", math.pi)  # Z of the pelvis sensor points to the back


def worn(bones: np.ndarray, errors: np.ndarray = ERRORS) -> np.ndarray:
    """Quaternions (6, 4) that the sensors send with the bones at (6, 3, 3)."""
    return rot.quat_multiply(rot.quat_about_z(-errors), rot.matrix_to_quat(R_TI.T @ bones @ R_BS))


def lying() -> np.ndarray:
    return rot.quat_multiply(rot.quat_about_z(-ERRORS), np.array([0.6, 0.8, 0.0, 0.0]))


def forces(quats: np.ndarray) -> np.ndarray:
    return rot.quat_rotate(rot.quat_conjugate(quats), [0.0, 0.0, 9.81])


def write_recording(path: Path, quats_at: Callable[[float], np.ndarray], seconds: float = 3.0) -> Path:
    samples = []
    for t in np.arange(10.0, 10.0 + seconds, 0.02):
        quats = quats_at(t)
        for i, (q, f) in enumerate(zip(quats, forces(quats), strict=True)):
            samples.append(ImuSample(i, float(t), tuple(q), tuple(f)))
    write_csv(path, recording_from_samples(samples))
    return path


def run(*arguments: object) -> Result:
    return CliRunner().invoke(calibrate, [str(a) for a in arguments])


def error_of(result: Result) -> str:
    assert isinstance(result.exception, EdgeposeError), result
    return str(result.exception)


def assert_recovers(calibration: cal.Calibration, errors: np.ndarray, tolerance_deg: float) -> None:
    """Bones in some other posture come out right, in a body frame that faces forward."""
    bones = rot.rotvec_to_matrix(np.random.default_rng(8).normal(0.0, 0.8, (6, 3)))
    r_tb, _ = cal.apply_calibration(calibration, worn(bones, errors), np.zeros((6, 3)))
    assert np.degrees(rot.geodesic_angle(r_tb, bones)).max() < tolerance_deg


# --- recordings ---------------------------------------------------------------------------------------------


def test_a_real_recording(tmp_path: Path) -> None:
    out = tmp_path / "calib.json"
    result = run("--file", REAL, "--out", out, "--hold", 2.5, "--body-frame", "heading:0")
    assert result.exit_code == 0, result
    assert "hold from 40.00 to 42.50 s, the first of the stillest parts." in result.output
    assert f"Wrote {out}." in result.output
    assert result.stderr == ""
    for name in PLACEMENTS:
        assert name in result.stdout
    calibration = cal.load_calibration(out)
    assert calibration.residual_deg.max() < 0.5
    assert calibration.metadata["from_s"] == pytest.approx(40.0)
    assert calibration.metadata["warnings"] == []
    datetime_part, _, zone = calibration.created.partition("+")
    assert len(datetime_part) == 19
    assert zone == "00:00"


def test_stdout_gets_the_calibration_and_nothing_else() -> None:
    result = run("--file", REAL, "--out", "-", "--hold", 1, "--from", 41)
    assert result.exit_code == 0, result
    assert json.loads(result.stdout)["metadata"]["from_s"] == 41.0
    assert "residual" in result.stderr
    assert "hold from 41.00 to 42.00 s.\n" in result.stderr


def test_a_start_since_the_first_sample() -> None:
    result = run("--file", REAL, "--out", "-", "--hold", 1, "--from", "+1.5")
    assert result.exit_code == 0, result
    assert json.loads(result.stdout)["metadata"]["from_s"] == pytest.approx(41.5)


@pytest.mark.parametrize("silent", [(10.0, 11.0), (10.8, 11.5), (11.9, 13.0)])
def test_a_hold_is_covered_by_the_samples_of_every_sensor(
    tmp_path: Path, silent: tuple[float, float]
) -> None:
    """A sensor that is silent at the beginning, in the middle or at the end of a hold was not held there."""
    path = write_recording(tmp_path / "pose.csv", lambda t: worn(cal.POSES["straight"]))
    rows = path.read_text().splitlines(keepends=True)
    path.write_text("".join(row for row in rows if not _from(row, "head", *silent)))
    message = error_of(run("--file", path, "--from", 10, "--hold", 2.5, "--out", tmp_path / "c.json"))
    assert re.fullmatch(
        r"silent during a part of the hold: head for (1\.0|0\.7|0\.6) s; check power and link, and hold "
        "again or choose another part of the recording",
        message,
    )
    assert not (tmp_path / "c.json").exists()


@pytest.mark.parametrize("start", ["11", "+1"])
def test_a_hold_in_which_all_sensors_are_silent(tmp_path: Path, start: str) -> None:
    """A gap in the recording is no hold, wherever the samples before and after it are."""
    path = write_recording(tmp_path / "pose.csv", lambda t: worn(cal.POSES["straight"]))
    rows = path.read_text().splitlines(keepends=True)
    path.write_text(
        "".join(row for row in rows if row[0] == "t" or not 11.8 <= float(row.split(",")[0]) < 12.9)
    )
    words = ("--file", path, "--out", tmp_path / "c.json", "--body-frame", "heading:70")
    message = error_of(run(*words, "--from", start, "--hold", 1.8))
    assert message.startswith(
        "silent during a part of the hold: left_forearm for 1.0 s, right_forearm for 1.0 s"
    )
    assert error_of(run(*words, "--from", 12, "--hold", 4)).startswith(
        f"{path}: it does not contain 4 s from 12 s"
    )
    assert run(*words, "--from", start, "--hold", 0.8).exit_code == 0


def _from(row: str, sensor: str, start_s: float, end_s: float) -> bool:
    time_s, name, *_ = row.split(",")
    return name == sensor and start_s <= float(time_s) < end_s


def test_a_raw_capture(tmp_path: Path) -> None:
    quats = worn(cal.POSES["straight"], np.zeros(6))
    file = tmp_path / "capture.bin"
    with file.open("wb") as stream:
        for seq in range(100):
            for i, (q, f) in enumerate(zip(quats.tolist(), forces(quats).tolist(), strict=True)):
                stream.write(native.encode(native_packet.Packet(i, seq, 20_000 * seq, tuple(q), tuple(f))))
    result = run("--file", file, "--hold", 1, "--out", tmp_path / "calib.json")
    assert result.exit_code == 0, result
    assert_recovers(cal.load_calibration(tmp_path / "calib.json"), np.zeros(6), 0.1)


def test_a_heading_reset_from_a_recording(tmp_path: Path) -> None:
    # Its name is none of the ways.
    flat = write_recording(tmp_path / "mounting-flat.csv", lambda t: lying())
    pose = write_recording(tmp_path / "pose.csv", lambda t: worn(cal.POSES["t-pose"]))
    out = tmp_path / "calib.json"
    result = run("--file", pose, "--heading-reset", flat, "--pose", "t-pose", "--hold", 1, "--out", out)
    assert result.exit_code == 0, result
    calibration = cal.load_calibration(out)
    np.testing.assert_allclose(calibration.heading_offset, ERRORS, atol=1e-6)
    assert_recovers(calibration, ERRORS, 0.01)
    assert max(calibration.metadata["heading_reset"]["error_deg"].values()) < 0.01


def test_a_moved_recording_says_who_and_what_to_do(tmp_path: Path) -> None:
    def waving(t: float) -> np.ndarray:
        bones = cal.POSES["straight"].copy()
        bones[0] = rot.rotation_about_axis("x", math.sin(6 * t)) @ bones[0]
        return worn(bones)

    file = write_recording(tmp_path / "wave.csv", waving)
    message = error_of(run("--file", file, "--hold", 2, "--out", tmp_path / "calib.json"))
    assert message.startswith("moved during the hold: left_forearm ")
    assert message.endswith("; choose a still part with --from, or record again")
    assert not (tmp_path / "calib.json").exists()


def test_warnings_go_to_stderr_and_into_the_file(tmp_path: Path) -> None:
    file = write_recording(tmp_path / "pose.csv", lambda t: worn(cal.POSES["straight"]))
    text = file.read_text().splitlines()
    rows = [line.split(",") for line in text]
    scaled = [
        [*row[:6], *(f"{float(a) / 9.80665:.6f}" for a in row[6:9]), *row[9:]] if row[1] == "head" else row
        for row in rows
    ]
    file.write_text("".join(",".join(row) + "\n" for row in scaled))
    result = run("--file", file, "--hold", 2, "--out", tmp_path / "calib.json")
    assert result.exit_code == 0, result
    assert result.stderr == "warning: head: it reads 1 at rest, which is in g: send m/s², 9.81 at rest\n"
    assert len(cal.load_calibration(tmp_path / "calib.json").metadata["warnings"]) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--from", 42], "it does not contain 4 s from 42 s on; it lasts from 40.00 to 42.9"),
        (["--from", 10, "--hold", 1], "it does not contain 1 s from 10 s"),
        (["--from", "+2.5", "--hold", 1], "it does not contain 1 s from 42.5 s on; it lasts from 40.00"),
        (["--hold", 60], "no 60 s in which all six sensors reported: they overlap for 3.0 s"),
        (
            ["--heading-reset", REAL, "--hold", 2],
            "not lying like the pelvis sensor: left_lower_leg (20 deg), ",
        ),
        (["--hold", 2, "--body-frame", "pelvis:x"], "body frame pelvis:x: this axis is"),
        (["--hold", 2, "--body-frame", "head"], "body frame head: the head sensor's Y axis points"),
        (["--out", "no/such/folder/calib.json"], "no folder no/such/folder; make it first"),
    ],
)
def test_recordings_that_do_not_do(arguments: list[object], message: str) -> None:
    assert message in error_of(run("--file", REAL, *arguments))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give one source"),
        (["--file", REAL, "--port", "x"], "give one source"),
        (["--file", REAL, "--body-frame", "north"], "body frame 'north' is none of"),
        (["--file", REAL, "--pose", "sitting"], "'sitting' is not one of 'straight', 't-pose'"),
        (["--file", REAL, "--heading-reset", "live"], "--heading-reset live needs --port"),
        (["--port", "x", "--from", 3], "--from needs a recording"),
        (["--port", "x", "--heading-reset", "motion", "--motion", "1:2"], "--motion needs a recording"),
        (["--file", REAL, "--motion", "1:2"], "--motion needs --heading-reset motion or steps"),
        (["--file", REAL, "--heading-reset", "motion", "--motion", "2:1"], "'2:1' is not FROM:TO"),
        (
            ["--file", REAL, "--heading-reset", "motion", "--motion", "nan:1"],
            "'nan' is not a time in seconds",
        ),
        (["--file", REAL, "--heading-reset", "motion", "--pose", "t-pose"], "starts with hanging arms"),
        (["--file", REAL, "--heading-reset", "steps", "--pose", "t-pose"], "steps starts with hanging arms"),
        (["--file", REAL, "--no-mag"], "--no-mag is for a --filter"),
        (["--file", REAL, "--heading-reset", "mounting:up"], "an axis is x, y or z"),
        (["--file", REAL, "--heading-reset", "pose"], "pose: no such file; without a file it is live, mot"),
        (["--file", REAL, "--heading-reset", "steps:z"], "steps:z: no such file; did you mean 'steps'?"),
        (["--file", REAL, "--jobs", 2], "--jobs is for recordings named as IN"),
        (["--file", REAL, "--filter", "madgwick"], "'madgwick' is not one of 'none', 'kalman', 'vqf'"),
        (["--file", REAL, "--hold", -1], "-1"),
        (["--file", REAL, "--hold", "nan"], "'nan' is not a number"),
    ],
)
def test_wrong_use(arguments: list[object], message: str) -> None:
    result = run(*arguments)
    assert result.exit_code == 2
    assert message in result.output


def test_errors_are_one_line_and_torch_is_not_imported(tmp_path: Path) -> None:
    code = (
        "import sys, edgepose.cli.commands.calibrate; assert 'torch' not in sys.modules; edgepose.cli.main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "calibrate", "--file", str(REAL), "--from", "99"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=60,
    )
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "it does not contain 4 s from 99 s" in done.stderr
    assert list(tmp_path.iterdir()) == []


# --- live ---------------------------------------------------------------------------------------------------


class Wearer(Sender):
    """Six sensors at 100 Hz on a line; what they measure can be changed while they send."""

    def __init__(self) -> None:
        (self.line,) = ports = (Port(),)
        super().__init__(*ports)
        self.port = self.line.name
        self.quats_at: Callable[[float], np.ndarray] = lambda t: worn(cal.POSES["straight"])
        self.silent: set[int] = set()

    def send(self, k: int) -> None:
        now = self.elapsed_s
        quats = self.quats_at(now)
        data = b""
        for i, (q, f) in enumerate(zip(quats.tolist(), forces(quats).tolist(), strict=True)):
            if i not in self.silent:
                data += native.encode(
                    native_packet.Packet(i, k & 0xFFFF, int(now * 1e6), tuple(q), tuple(f), (0.0, 0.0, 0.0))
                )
        self.line.write(data)


@pytest.fixture
def wearer() -> Iterator[Wearer]:
    with Wearer() as thread:
        yield thread


def test_live_hold(wearer: Wearer, tmp_path: Path) -> None:
    no_errors = np.zeros(6)
    wearer.quats_at = lambda t: worn(cal.POSES["straight"], no_errors)
    out = tmp_path / "calib.json"
    result = run("--port", wearer.port, "--hold", 1.1, "--countdown", 0.1, "--out", out)
    assert result.exit_code == 0, result
    said = (
        "All six sensors report.",
        "Stand straight: ",
        "starts in 1 s",
        "Hold still for 1.1 s.",
        "1 of 1.1 s",
    )
    assert [line for line in said if line not in result.output] == []
    assert_recovers(cal.load_calibration(out), no_errors, 0.1)


def test_a_moved_hold_is_explained_and_repeated(
    wearer: Wearer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    swinging = True

    def quats(t: float) -> np.ndarray:
        bones = cal.POSES["straight"].copy()
        if swinging:
            bones[1] = rot.rotation_about_axis("x", math.sin(30 * t)) @ bones[1]
        return worn(bones)

    def check_and_stop(hold: cal.Hold) -> cal.HoldSummary:
        nonlocal swinging
        swinging = False
        return check(hold)

    check = cal.check_hold
    monkeypatch.setattr(cal, "check_hold", check_and_stop)
    wearer.quats_at = quats
    result = run("--port", wearer.port, "--hold", 0.4, "--countdown", 0, "--out", tmp_path / "calib.json")
    assert result.exit_code == 0, result
    assert "Not still: moved during the hold: right_forearm " in result.output


def test_after_three_repeats_it_gives_up(wearer: Wearer, tmp_path: Path) -> None:
    def quats(t: float) -> np.ndarray:
        return worn(rot.rotation_about_axis("x", math.sin(30 * t)) @ cal.POSES["straight"])

    wearer.quats_at = quats
    result = run("--port", wearer.port, "--hold", 0.4, "--countdown", 0, "--out", tmp_path / "calib.json")
    assert error_of(result).startswith("moved during the hold: left_forearm ")
    assert result.output.count("Trying again.") == 3
    assert result.output.count("Hold still for") == 4
    assert not (tmp_path / "calib.json").exists()


def test_missing_sensors_are_waited_for_and_then_named(
    wearer: Wearer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("edgepose.cli.prompts.ALL_REPORT_S", 1.1)
    wearer.silent = {1, 4}
    result = run("--port", wearer.port, "--out", tmp_path / "calib.json")
    assert "Waiting for right_forearm, head." in result.output
    assert error_of(result).startswith("nothing from right_forearm, head in 1 s: check power, link and id")
    assert error_of(result).endswith("; if the rig lacks them: --without right_forearm,head")


def test_headings_from_guided_motion(wearer: Wearer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The wearer does the exercises, at eight times their speed, as soon as the hold is over."""
    bones = exercises(100.0)[:, list(BONES)]
    monkeypatch.setattr(cal, "EXERCISE_S", cal.EXERCISE_S / 8)
    began_s: float | None = None
    now_s = 0.0

    def quats(t: float) -> np.ndarray:
        nonlocal now_s
        now_s = t
        row = 0 if began_s is None else int((t - began_s) * 800) % len(bones)
        return worn(bones[row])

    def check_and_begin(hold: cal.Hold) -> cal.HoldSummary:
        nonlocal began_s
        began_s = now_s
        return check(hold)

    check = cal.check_hold
    monkeypatch.setattr(cal, "check_hold", check_and_begin)
    wearer.quats_at = quats
    out = tmp_path / "calib.json"
    words = ("--port", wearer.port, "--hold", 1, "--countdown", 0, "--out", out)
    result = run(*words, "--heading-reset", "motion")
    assert result.exit_code == 0, result
    asked = [line for line in result.output.splitlines() if line.endswith("(0.5 s).")]
    assert [line.split(" ")[0] for line in asked[:5]] == ["Bow", "Lift", "Lift", "Lift", "Lift"]
    calibration = cal.load_calibration(out)
    assert calibration.body_frame == "heading:0"
    assert not calibration.north
    # To the frame in which the wearer faces X; forearms do not rise straight ahead.
    wanted = ERRORS - FACING + np.radians([-ASIDE_DEG, ASIDE_DEG, 0, 0, 0, 0])
    apart = np.degrees(np.angle(np.exp(1j * (calibration.heading_offset - wanted))))
    assert np.abs(apart).max() < 3.0


def test_a_wearer_who_does_not_do_the_exercises(
    wearer: Wearer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cal, "EXERCISE_S", 0.1)
    words = ("--port", wearer.port, "--hold", 1, "--countdown", 0, "--out", tmp_path / "calib.json")
    result = run(*words, "--heading-reset", "motion")
    assert error_of(result).startswith("no heading from this motion: left_forearm leaned by only 0 deg, ")
    assert result.output.count("Trying again.") == 3


def walk_file(path: Path, stand_s: tuple[float, float] = (4.0, 2.0), **wearer: float) -> Path:
    """A recording of sensors without a common north whose wearer stands, takes some steps, and stands."""
    sensors = {
        name: SensorData(s.time_s, s.quat, s.acc, None)
        for name, s in zip(PLACEMENTS, walker(stand_s=stand_s, **wearer), strict=True)
    }
    write_npz(path, Recording(sensors, {}))
    return path


def test_headings_from_steps_in_a_recording(tmp_path: Path) -> None:
    out = tmp_path / "calib.json"
    words = ("--hold", 2, "--from", 0.5, "--heading-reset", "steps", "--out", out)
    result = run("--file", walk_file(tmp_path / "walk.npz"), *words)
    assert result.exit_code == 0, result
    assert "The calibration is good." in result.output
    calibration = cal.load_calibration(out)
    assert (calibration.body_frame, calibration.north) == ("heading:0", False)
    assert calibration.metadata["heading_reset"]["source"] == "steps"
    apart = np.degrees(np.angle(np.exp(1j * (calibration.heading_offset + HEADINGS))))
    assert np.abs(apart).max() < 1.5
    # A recording that ends in the walk, and one that --motion cuts.
    walked = walk_file(tmp_path / "on.npz", (4.0, 0.0))
    result = run("--file", walked, *words, "--overwrite")
    assert "the wearer did not stand still after the steps: headings are less certain" in result.stderr
    result = run("--file", walk_file(tmp_path / "back.npz", distance_m=-1.4), *words, "--overwrite")
    assert error_of(result).startswith("no heading from these steps: the wearer walked backwards; ")
    result = run("--file", walked, *words, "--motion", "+5:+50", "--overwrite")
    assert "choose --motion within that" in error_of(result)


def test_straight_pose_and_then_t_pose(tmp_path: Path) -> None:
    """Without --body-frame, the raised arms show which way the wearer faces."""

    def quats(t: float) -> np.ndarray:
        raised = min(max(t - 12.0, 0.0), 1.0)
        bones = cal.POSES["straight"].copy()
        for i, side in enumerate((1.0, -1.0)):
            bones[i] = rot.rotation_about_axis("z", side * raised * math.pi / 2) @ bones[i]
        return worn(bones, np.zeros(6))

    file, out = write_recording(tmp_path / "both.csv", quats, 5.0), tmp_path / "calib.json"
    words = ("--hold", 1, "--from", 10.5, "--pose", "straight+t-pose", "--out", out)
    result = run("--file", file, *words)
    assert result.exit_code == 0, result
    assert "T-pose from 13.0" in result.output
    assert "The raised arms show that the wearer faces 70.0 deg, to within 0 deg." in result.output
    calibration = cal.load_calibration(out)
    assert (calibration.pose, calibration.body_frame) == ("straight", "heading:70.00")
    assert_recovers(calibration, np.zeros(6), 0.1)
    result = run("--file", file, *words, "--from", 13.5, "--overwrite")
    assert error_of(result).startswith("no T-pose of 1 s after the straight pose: the arms were not raised")


def test_headings_from_the_mounting_in_a_map(tmp_path: Path) -> None:
    file = write_recording(tmp_path / "pose.csv", lambda t: worn(cal.POSES["straight"]))
    found = cal.mounting(
        cal.calibrate(
            cal.check_hold(cal.hold_from_recording(read_recording(file))),
            pose="straight", body_frame="heading:70", created="", heading_offset=ERRORS,
        )
    )  # fmt: skip
    rows = zip(PLACEMENTS, range(6), found.values(), strict=True)
    rig = tmp_path / "rig.toml"
    rig.write_text("".join(f'{name} = {{ id = {i}, mounting = "{sits}" }}\n' for name, i, sits in rows))
    out = tmp_path / "calib.json"
    words = ("--file", file, "--sensors", rig, "--hold", 2, "--out", out, "--heading-reset")
    result = run(*words, "mounting")
    assert result.exit_code == 0, result
    assert result.stderr == ""
    calibration = cal.load_calibration(out)
    apart = np.degrees(np.angle(np.exp(1j * (calibration.heading_offset - ERRORS + FACING))))
    # Words know quarter turns only.
    assert np.abs(apart).max() < 46.0
    # The pelvis sensor sits as its words say.
    assert abs(apart[5]) < 0.1
    assert not calibration.north


def test_a_recording_at_its_own_pace_is_as_live(tmp_path: Path) -> None:
    arguments = ("--file", REAL, "--realtime", "--countdown", 0, "--out", tmp_path / "calib.json")
    assert run(*arguments, "--hold", 0.5).exit_code == 0
    assert cal.load_calibration(tmp_path / "calib.json").residual_deg.max() < 0.5


def test_a_source_that_ends_within_the_hold(tmp_path: Path) -> None:
    file = write_recording(tmp_path / "short.csv", lambda t: worn(cal.POSES["straight"]), 0.5)
    message = error_of(run("--file", file, "--realtime", "--countdown", 0, "--out", tmp_path / "calib.json"))
    assert message.startswith("the source ended before the hold was over")


def test_a_whole_session_on_a_terminal(wearer: Wearer, tmp_path: Path) -> None:
    wearer.quats_at = lambda t: lying()
    terminal, inside = pty.openpty()
    out = tmp_path / "calib.json"
    process = processes.Popen(
        [sys.executable, "-m", "edgepose", "calibrate", "--port", wearer.port, "--heading-reset", "live",
         "--hold", "0.4", "--countdown", "0", "--out", str(out)],
        stdin=inside, stdout=inside, stderr=inside, env={**os.environ, "TERM": "xterm"},
    )  # fmt: skip
    os.close(inside)
    screen = b""
    try:
        while True:
            try:
                piece = os.read(terminal, 4096)
            except OSError:  # Linux says so when the other side has closed
                break
            if not piece:
                break
            before, screen = screen, screen + piece
            if b"Press Enter" in screen and b"Press Enter" not in before:
                wearer.quats_at = lambda t: worn(cal.POSES["straight"])
                time.sleep(0.3)  # what was measured while lying has to be taken off the line
                os.write(terminal, b"\n")
        assert process.wait(timeout=120) == 0, screen.decode()
    finally:
        process.kill()
        process.wait()
        os.close(terminal)
    assert b"Lay all six sensors side by side" in screen
    assert b"\a" in screen
    assert "Hold still. Stand straight" in screen.decode()
    assert "█" in screen.decode()
    assert f"Next:\r\n  edgepose run --port {wearer.port} --calibration {out} --view\r\n" in screen.decode()
    calibration = cal.load_calibration(out)
    np.testing.assert_allclose(np.degrees(calibration.heading_offset), np.degrees(ERRORS), atol=0.1)
    assert_recovers(calibration, ERRORS, 0.1)


def test_the_next_command_names_lines_of_all_kinds() -> None:
    source = SourceConfig(port="/dev/ttyUSB0", can="can:can0", listen="0.0.0.0:7000", connect="10.0.0.2:7000")
    assert next_command(source, "my calib.json") == (
        "edgepose run --port /dev/ttyUSB0 --can can:can0 --listen 0.0.0.0:7000 --connect 10.0.0.2:7000 "
        "--calibration 'my calib.json' --view"
    )


def test_the_recording_is_not_written_over(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "walk.csv", lambda t: worn(np.tile(np.eye(3), (6, 1, 1))))
    before = path.read_bytes()
    result = run("--file", path, "--hold", 1, "--out", path)
    assert result.exit_code == 2
    assert f"--out would overwrite {path}, which is --file" in result.output
    assert path.read_bytes() == before


def test_movements_that_are_not_in_the_recording(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "walk.csv", lambda t: worn(np.tile(np.eye(3), (6, 1, 1))))
    words = ("--heading-reset", "motion", "--motion", "500:520", "--out", tmp_path / "c.json")
    assert "choose --motion within that" in error_of(run("--file", path, "--hold", 1, *words))


@pytest.mark.parametrize("words", [(), ("--heading-reset", "mounting:z")])
def test_devices_without_a_common_heading(tmp_path: Path, words: tuple[str, ...]) -> None:
    """They need a reset, although they send orientations."""
    rig = tmp_path / "walk.bin"
    encode = PROTOCOLS["haritorax"].encoder()
    wire, end = b"", []
    for k in range(300):
        for sensor in range(6):
            wire += encode(Sample(sensor, None, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 9.81), None), k)
        end.append(len(wire))
    rig.write_bytes(wire)
    noted = times_header({}) + "".join(times_row(1.7e9 + 0.01 * k, at) for k, at in enumerate(end))
    times_path(rig).write_text(noted)
    result = run("--file", rig, "--protocol", "haritorax", "--out", tmp_path / "c.json", *words)
    says = (
        "sensors of haritorax have no common heading: calibrate with --heading-reset steps, motion, live or "
        "mounting"
    )
    text = str(result.exception) + result.output
    assert (says in text) == (not words)
