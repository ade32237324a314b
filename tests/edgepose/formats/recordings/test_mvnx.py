"""Recordings of Xsens MVN, written here in the layout of its exports."""

from __future__ import annotations

import re
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgepose.calibration import GRAVITY
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.mvnx import LABELS, read_mvnx
from edgepose.formats.recordings.registry import read_recording, salvage_recording
from edgepose.imu import Recording, SensorData
from edgepose.placements import SENSORS as ALL
from edgepose.rotations import quat_rotate

REAL = Path(__file__).parents[3] / "data" / "imu" / "six-sites-3s.npz"
SENSORS = (
    "Pelvis",
    "T8",
    "Head",
    "RightForeArm",
    "RightHand",
    "LeftForeArm",
    "RightLowerLeg",
    "LeftLowerLeg",
)
FRAMES = 40
NAMES = [name for name, label in zip(ALL, LABELS, strict=True) if label in SENSORS]


def numbers(values: list[np.ndarray]) -> str:
    return " ".join(f"{value:.6f}" for row in values for value in row)


def lists(recording: Recording, i: int, version: int) -> str:
    """What a frame says of all sensors."""
    rows = []
    for label in SENSORS:
        data = recording.sensors[ALL[LABELS.index(label)]]
        rows.append({"quat": data.quat[i], "acc": data.acc[i], "gyr": data.gyr[i]})
    result = f"<sensorOrientation>{numbers([row['quat'] for row in rows])}</sensorOrientation>\n"
    result += f"<sensorMagneticField>{numbers([[0.25, -0.5, 1.0]] * len(rows))}</sensorMagneticField>\n"
    if version == 4:
        free = [quat_rotate(row["quat"], row["acc"]) - [0, 0, GRAVITY] for row in rows]
        return result + f"<sensorFreeAcceleration>{numbers(free)}</sensorFreeAcceleration>\n"
    result += f"<sensorAcceleration>{numbers([row['acc'] for row in rows])}</sensorAcceleration>\n"
    gyr = numbers([row["gyr"] for row in rows])
    return result + f"<sensorAngularVelocity>{gyr}</sensorAngularVelocity>\n"


def write(path: Path, version: int = 4, rate: int = 60) -> Recording:
    """A second of a real recording as MVN exports it, with more sensors, which lie on a table."""
    recording = read_recording(REAL)
    count = len(recording.sensors["head"].time_s)
    rows = (np.tile(row, (count, 1)) for row in ([1.0, 0, 0, 0], [0, 0, GRAVITY], [0.0, 0, 0]))
    lying = SensorData(recording.sensors["head"].time_s, *rows)
    recording = recording._replace(sensors=dict.fromkeys(ALL, lying) | recording.sensors)
    segments = " ".join(["1 0 0 0"] * 23)
    frames = "".join(
        f'<frame time="{1000 * i // rate}" index="{i}" tc="12:00:00:00" ms="1700000000000" type="normal">\n'
        f"<orientation>{segments}</orientation>\n{lists(recording, i, version)}</frame>\n"
        for i in range(FRAMES)
    )
    still = (
        f'<frame time="0" index="" tc="" ms="0" type="{{}}"><orientation>{segments}</orientation></frame>\n'
    )
    path.write_text(
        f'<?xml version="1.0" encoding="UTF-8"?>\n<mvnx version="{version}">\n<mvn build="1"/>\n'
        f'<comment/>\n<subject label="Suit" frameRate="{rate}" segmentCount="23">\n'
        '<segments><segment label="Pelvis" id="1"><points/></segment></segments>\n'
        f"<sensors>{''.join(f'<sensor label={chr(34)}{label}{chr(34)}/>' for label in SENSORS)}</sensors>\n"
        f'<frames segmentCount="23" sensorCount="{len(SENSORS)}" jointCount="22">\n'
        f"{''.join(map(still.format, ('identity', 'tpose', 'tpose-isb')))}{frames}</frames>\n</subject>\n"
        '<securityCode code="0"/>\n</mvnx>\n'
    )
    return recording


def same(found: Recording, wanted: Recording, version: int, rate: int = 60) -> None:
    assert list(found.sensors) == NAMES
    for name, data in found.sensors.items():
        np.testing.assert_allclose(data.time_s, np.arange(FRAMES) / rate, atol=1e-9)
        np.testing.assert_allclose(data.quat, wanted.sensors[name].quat[:FRAMES], atol=2e-6)
        np.testing.assert_allclose(data.acc, wanted.sensors[name].acc[:FRAMES], atol=5e-5)
        assert (data.mag == [0.25, -0.5, 1.0]).all()
        if version == 4:
            assert data.gyr is None
        else:
            np.testing.assert_allclose(data.gyr, wanted.sensors[name].gyr[:FRAMES], atol=1e-6)


@pytest.mark.parametrize(("version", "rate"), [(4, 60), (4, 240), (3, 120)])
def test_six_sensors_of_both_versions(tmp_path, version, rate):
    wanted = write(tmp_path / "walk.mvnx", version, rate)
    found = read_mvnx(tmp_path / "walk.mvnx")
    assert found.damage is None
    assert found.metadata["rate"] == str(rate)
    same(found, wanted, version, rate)


def test_by_the_command(command, tmp_path):
    folder = tmp_path / "in"
    (folder / "deep").mkdir(parents=True)
    wanted = write(folder / "deep" / "walk.MVNX")
    write(folder / "cut.mvnx")
    text = (folder / "cut.mvnx").read_text()
    (folder / "cut.mvnx").write_text(text[: len(text) // 2])
    result = command("convert", folder, "--to", "npz", "--out", tmp_path / "out", "--jobs", 2)
    assert result.returncode == 1
    assert re.search(r"walk\.MVNX +320 +0\.7  ok\n", result.stdout)
    assert re.search(r"cut\.mvnx +\d+ +0\.3  damaged\n", result.stdout)
    assert re.search(r"cut\.mvnx: damaged: breaks off \(.*: line \d+, column", result.stderr)
    found = read_recording(tmp_path / "out" / "deep" / "walk.npz")
    # Quantities are in single precision there.
    for name, data in found.sensors.items():
        np.testing.assert_allclose(data.acc, wanted.sensors[name].acc[:FRAMES], atol=5e-5)
    assert 10 < len(read_recording(tmp_path / "out" / "cut.npz").sensors["head"].time_s) < FRAMES


def test_bad_frames_cost_only_themselves(tmp_path):
    path = tmp_path / "walk.mvnx"
    wanted = write(path)
    parts = path.read_text().split("</frame>")
    for at, old, new in (
        (5, "<sensorOrientation>", "<sensorOrientation>nonsense "),
        (7, "0.250000 -0.500000", "0.250000"),
        (9, re.search(r'time="\d+"', parts[9])[0], 'time="soon"'),
        (11, re.search(r'time="\d+"', parts[11])[0], 'time="inf"'),
    ):
        assert old in parts[at]
        parts[at] = parts[at].replace(old, new, 1)
    # One sensor's quaternion: that sensor alone has no sample of this frame.
    head = 4 * SENSORS.index("Head")
    begin = parts[20].index("<sensorOrientation>") + len("<sensorOrientation>")
    words = parts[20][begin:].split(" ")
    words[head] = "7.0"
    parts[20] = parts[20][:begin] + " ".join(words)
    path.write_text("</frame>".join(parts))
    found = read_mvnx(path)
    assert f"{path}: 3 bad frames left out; {path}: 1 incomplete sensorMagneticField" in found.damage
    assert f"{path}: 1 bad rows left out" in found.damage
    assert "(head) has a quaternion that is not of unit length" in found.damage
    assert {name: len(data.time_s) for name, data in found.sensors.items()} == {
        name: FRAMES - 4 if name == "head" else FRAMES - 3 for name in NAMES
    }
    assert [np.isnan(data.mag[:, 0]).sum() for data in found.sensors.values()] == [1] * len(NAMES)
    assert len(wanted.sensors["head"].time_s) > FRAMES


@pytest.mark.parametrize("there", ["nan nan nan", "nan", "0.250000"])
def test_a_magnetometer_that_measures_nothing(tmp_path, there):
    path = tmp_path / "walk.mvnx"
    wanted = write(path)
    path.write_text(path.read_text().replace("0.250000 -0.500000 1.000000", there))
    found = read_mvnx(path)
    whole = there.count("nan") == 3
    says = None if whole else f"{path}: {FRAMES} incomplete sensorMagneticField left out"
    assert found.damage == says
    for name, data in found.sensors.items():
        assert data.mag is None
        np.testing.assert_allclose(data.acc, wanted.sensors[name].acc[:FRAMES], atol=5e-5)


def test_frames_before_a_second_subject_are_good(tmp_path):
    path = tmp_path / "walk.mvnx"
    write(path)
    path.write_text(path.read_text().replace("</subject>", '</subject><subject frameRate="0"></subject>'))
    found = read_mvnx(path)
    assert (
        "breaks off (the frame rate '0' of its subject is not possible), the 40 frames before" in found.damage
    )
    assert [len(data.time_s) for data in found.sensors.values()] == [FRAMES] * len(NAMES)


def test_a_lost_frame_is_a_gap(tmp_path):
    path = tmp_path / "walk.mvnx"
    write(path)
    parts = path.read_text().split("</frame>")
    del parts[10:13]
    path.write_text("</frame>".join(parts))
    times = read_mvnx(path).sensors["pelvis"].time_s
    np.testing.assert_allclose(np.sort(np.diff(times))[-2:], [1 / 60, 4 / 60], atol=1e-9)


def test_fewer_sensors(tmp_path):
    path = tmp_path / "walk.mvnx"
    write(path)
    path.write_text(path.read_text().replace('"LeftForeArm"', '"Prop1"'))
    assert list(read_mvnx(path).sensors) == [name for name in NAMES if name != "left_forearm"]


LAUGHS = '<!DOCTYPE mvnx [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>\n<mvnx'
OUTSIDE = '<!DOCTYPE mvnx [<!ENTITY a SYSTEM "file:///etc/passwd">]>\n<mvnx'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<mvnx", LAUGHS, "it declares a document type"),
        ("<mvnx", OUTSIDE, "it declares a document type"),
        ("<mvnx", '<mvnx a="' + "x" * 3_000_000 + '"', "a tag of more than 1048576 bytes"),
        ("<sensorOrientation>", "<sensorOrientation>" + "1 " * 600_000, "a list has more than 1048576 char"),
        ("<comment/>", "<a>" * 100, "elements are nested too deeply"),
        ("<comment/>", "<sensor/>" * 200, "has more than 100 sensors"),
        ('frameRate="60"', "", "the frame rate '' of its subject is not possible"),
        ('frameRate="60"', 'frameRate="nan"', "the frame rate 'nan' of its subject is not possible"),
        ("<subject", "<object", "no subject with a frame rate|mismatched tag"),
        ("<sensor label", "<tracker label", r"has no sensor called LeftForeArm, .* \(it has none\)"),
        ('type="normal"', 'type="npose"', r"no frame of an MVNX recording \(of the type normal\)"),
        ("<?xml", "nonsense", r"no frame of an MVNX recording \(syntax error: line 1, column 0\)"),
        ('encoding="UTF-8"', 'encoding="EBCDIC-42"', "no frame of an MVNX recording"),
        ("sensorCount", "sensorcount", None),
    ],
)
def test_other_files(tmp_path, old, new, message):
    path = tmp_path / "walk.mvnx"
    write(path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    if message is None:
        assert read_mvnx(path).damage is None
        return
    with pytest.raises(EdgeposeError, match=message) as info:
        read_mvnx(path)
    assert str(info.value).startswith(str(path))
    assert "\n" not in str(info.value)


@pytest.mark.parametrize("encoding", ["shift_jis", "utf-7", "utf-32", "idna", "undefined"])
def test_odd_encodings(tmp_path, encoding):
    path = tmp_path / "walk.mvnx"
    write(path)
    path.write_text(path.read_text().replace('encoding="UTF-8"', f'encoding="{encoding}"'))
    with pytest.raises(EdgeposeError, match="no frame of an MVNX recording"):
        read_mvnx(path)


def test_frames_without_sensor_data(tmp_path):
    path = tmp_path / "walk.mvnx"
    write(path)
    path.write_text(re.sub(r"<sensor[A-Z]\w+>[^<]*</sensor\w+>", "", path.read_text()))
    with pytest.raises(EdgeposeError, match=r"no frame has complete lists .* export sensorOrientation and"):
        read_mvnx(path)
    with pytest.raises(EdgeposeError, match=r"none\.mvnx: cannot read it: No such file"):
        read_mvnx(tmp_path / "none.mvnx")


def test_memory_does_not_grow_with_what_is_not_kept(tmp_path):
    """Calibration frames and lists of segments of any number."""
    path = tmp_path / "walk.mvnx"
    write(path)
    text = path.read_text()
    still = text[text.index("<frame ") : text.index("</frame>") + len("</frame>\n")]
    path.write_text(text.replace(still, still * 20_000, 1))
    assert path.stat().st_size > 5_000_000
    tracemalloc.start()
    read_mvnx(path)
    assert tracemalloc.get_traced_memory()[1] < 2_000_000
    tracemalloc.stop()


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_any_damage_is_told_in_one_line(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("m") / "walk.mvnx"
    write(path)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 5))):
        at = data.draw(st.integers(0, len(content) - 1))
        piece = data.draw(st.binary(max_size=4))
        content[at : at + data.draw(st.integers(0, 50))] = piece
    path.write_bytes(content)
    problem = None
    try:
        found = read_mvnx(path)
    except EdgeposeError as error:
        found, problem = Recording({}, {}), str(error)
    assert "\n" not in (problem or found.damage or "")
    for sensor in found.sensors.values():
        assert np.isfinite(sensor.time_s).all()
        assert (np.diff(sensor.time_s) >= 0).all()


def test_sensors_that_measure_nothing_that_is_read(tmp_path):
    """Free acceleration without the orientation that turns it into the sensor's frame."""
    path = tmp_path / "a.mvnx"
    path.write_text(
        '<mvnx version="4"><subject frameRate="60"><sensors><sensor label="Pelvis"/></sensors><frames>'
        + "".join(
            f'<frame time="{17 * i}" type="normal">'
            "<sensorFreeAcceleration>0 0 1</sensorFreeAcceleration></frame>"
            for i in range(30)
        )
        + "</frames></subject></mvnx>"
    )
    with pytest.raises(EdgeposeError, match="neither orientations nor accelerations that can be"):
        salvage_recording(path)


def write_recording(path: Path, recording: Recording) -> Path:
    frames = len(recording.sensors["head"].time_s)
    data = recording.sensors.values()
    rows = []
    for i in range(frames):
        quats = " ".join(cell for d in data for cell in _cells(*d.quat[i]))
        free = " ".join(
            cell for d in data for cell in _cells(*(quat_rotate(d.quat[i], d.acc[i]) - [0.0, 0.0, GRAVITY]))
        )
        rows.append(
            f'<frame time="{1000 * i // 60}" type="normal"><sensorOrientation>{quats}</sensorOrientation>'
            f"<sensorFreeAcceleration>{free}</sensorFreeAcceleration></frame>\n"
        )
    sensors = "".join(f'<sensor label="{label}"/>' for label in LABELS[: len(data)])
    path = path.with_suffix(".mvnx")
    path.write_text(
        f'<mvnx version="4"><subject frameRate="60"><sensors>{sensors}</sensors>\n'
        f"<frames>{''.join(rows)}</frames></subject></mvnx>\n"
    )
    return path


def _cells(*values: float) -> list[str]:
    return [f"{value:.7f}" for value in values]
