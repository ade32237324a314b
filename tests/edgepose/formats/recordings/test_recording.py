import contextlib
import io
import sys
import zipfile
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.base import SampleTable, iter_samples, recording_from_samples
from edgepose.formats.recordings.csv import COLUMNS, csv_header, csv_row, write_csv
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import missing_sensors, read_recording, salvage_recording
from edgepose.imu import ImuSample
from edgepose.placements import PLACEMENTS

REAL = Path(__file__).parents[3] / "data" / "imu" / "six-sites-3s.npz"


def rig(n=3, **changes):
    values = {"quat": (1.0, 0.0, 0.0, 0.0), "acc": (0.0, 0.0, 9.81), "gyr": (0.1, 0.2, 0.3), **changes}
    return [ImuSample(s, 0.01 * i, **values) for i in range(n) for s in range(6)]


def text(rows, metadata=None):
    return csv_header(metadata or {}) + "".join(map(csv_row, rows))


def write(path, content):
    path.write_text(content, encoding="utf-8", newline="")
    return path


def same(a, b, tolerance=0.0):
    assert list(a.sensors) == list(b.sensors) == list(PLACEMENTS)
    for name in PLACEMENTS:
        for x, y in zip(a.sensors[name], b.sensors[name], strict=True):
            assert (x is None) == (y is None)
            if x is not None:
                np.testing.assert_allclose(x, y, rtol=0, atol=tolerance)


def error(path):
    with pytest.raises(EdgeposeError) as info:
        read_recording(path)
    message = str(info.value)
    assert str(path) in message
    assert "\n" not in message
    return message


def test_real_recording():
    recording = read_recording(REAL)
    pelvis = recording.sensors["pelvis"]
    assert pelvis.time_s.shape == (300,)
    assert pelvis.quat.shape == (300, 4)
    assert pelvis.mag is None
    assert recording.damage is None
    rows = list(iter_samples(recording))
    assert len(rows) == 1800
    assert [r.sensor for r in rows[:6]] == list(range(6))
    assert all(a.time_s <= b.time_s for a, b in pairwise(rows))
    np.testing.assert_allclose(np.linalg.norm(pelvis.acc, axis=1).mean(), 9.9, atol=0.3)


def test_real_recording_round_trips(tmp_path):
    recording = read_recording(REAL)._replace(metadata={"rate": "100", "frame": "ENU", "units": "SI"})
    for write_it, name in ((write_csv, "a.csv"), (write_npz, "a.npz")):
        write_it(tmp_path / name, recording)
        again = read_recording(tmp_path / name)
        same(recording, again, 1e-6)
        assert again.metadata == recording.metadata


numbers = st.floats(-300, 300, width=32)
vectors = st.one_of(st.none(), st.tuples(numbers, numbers, numbers))


@given(
    st.lists(
        st.tuples(st.integers(0, 5), st.integers(0, 2000), vectors, vectors, st.booleans()), max_size=20
    ),
)
@settings(max_examples=40, deadline=None)
def test_any_samples_round_trip(tmp_path_factory, drawn):
    path = tmp_path_factory.mktemp("r")
    rows = rig(1, mag=None)
    times = [0] * 6
    for sensor, step, acc, mag, oriented in drawn:
        times[sensor] += step
        rows.append(
            ImuSample(
                sensor, times[sensor] * 1e-3, (0.6, 0.0, -0.8, 0.0) if oriented else None, acc, None, mag
            )
        )
    recording = recording_from_samples(rows, {"rate": "50"})
    write_csv(path / "a.csv", recording)
    write_npz(path / "a.npz", recording)
    for again in (read_recording(path / "a.csv"), read_recording(path / "a.npz")):
        same(recording, again, 1e-6)
        kept = [
            (s.sensor, s.quat is None, s.acc is None, s.gyr is None, s.mag is None)
            for s in iter_samples(again)
        ]
        wanted = [(s.sensor, s.quat is None, s.acc is None, s.gyr is None, s.mag is None) for s in rows]
        assert sorted(kept) == sorted(wanted)


def test_sensors_at_different_rates(tmp_path):
    rows = [
        ImuSample(s, i / (50 + 10 * s), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 9.81))
        for s in range(6)
        for i in range(20)
    ]
    recording = recording_from_samples(rows)
    write_npz(tmp_path / "a.npz", recording)
    same(recording, read_recording(tmp_path / "a.npz"), 1e-6)
    merged = list(iter_samples(recording))
    assert len(merged) == 120
    assert all(a.time_s <= b.time_s for a, b in pairwise(merged))


def test_metadata_line_ends_and_quotes(tmp_path):
    content = "\ufeff" + text(rig(), {"rate": "100", "note": "a: b"}).replace("\n", "\r\n").replace(
        "head", '"head"'
    )
    recording = read_recording(write(tmp_path / "a.csv", content))
    assert recording.metadata == {"rate": "100", "note": "a: b"}
    assert len(recording.sensors["head"].time_s) == 3


def test_stdin(monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.StringIO(text(rig())))
    assert len(list(iter_samples(read_recording("-")))) == 18


def test_quaternions_are_normalised(tmp_path):
    recording = read_recording(write(tmp_path / "a.csv", text(rig(quat=(0.57, 0.0, 0.0, 0.76)))))
    np.testing.assert_allclose(recording.sensors["pelvis"].quat, [[0.6, 0, 0, 0.8]] * 3)


# --- damage -------------------------------------------------------------------------------------------------


def test_csv_cut_anywhere_in_its_last_row_keeps_the_rest(tmp_path):
    whole = text(rig(mag=(10.0, 20.0, -31.25)))
    last = whole[:-1].rindex("\n") + 1
    for end in range(last + 1, len(whole)):
        recording = read_recording(write(tmp_path / "a.csv", whole[:end]))
        assert len(list(iter_samples(recording))) == 17
        assert f"{tmp_path / 'a.csv'}: row 19 is cut off" in recording.damage
        assert "\n" not in recording.damage
    assert read_recording(write(tmp_path / "a.csv", whole[:last])).damage is None


def test_a_missing_line_end_alone_is_no_damage(tmp_path):
    recording = read_recording(write(tmp_path / "a.csv", text(rig())[:-1]))
    assert recording.damage is None
    assert len(list(iter_samples(recording))) == 18


def test_truncated_npz(tmp_path):
    data = REAL.read_bytes()
    for size in (0, 10, 1000, len(data) // 2, len(data) - 1):
        (tmp_path / "a.npz").write_bytes(data[:size])
        assert "NPZ" in error(tmp_path / "a.npz")


@given(st.integers(0, 41_000), st.integers(1, 255))
@settings(max_examples=60, deadline=None)
def test_damaged_npz_is_an_error_or_still_a_recording(tmp_path_factory, place, change):
    data = bytearray(REAL.read_bytes())
    data[place] ^= change
    path = tmp_path_factory.mktemp("r") / "a.npz"
    path.write_bytes(data)
    with contextlib.suppress(EdgeposeError):
        read_recording(path)


# --- salvage ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        (",head,", ",hat,", "row 6 names an unknown sensor 'hat'"),
        ("9.81", "abc", "row 2 has a value that is not a number"),
        ("9.81", "nan", "row 2 (left_forearm) has a number that is NaN or absurd"),
        ("9.81", "", "row 2 (left_forearm) has only a part of acc"),
        ("9.81", "9" * 9000, "row 2 has 9 columns"),
        ("9.81", "\0" * 10, "row 2"),
        ("0.010000,pelvis", "0.030000,pelvis", "row 19 (pelvis) goes back in time"),
        ("0.010000,pelvis", "nan,pelvis", "row 13 (pelvis) has no time"),
        (",1,0,0,0,", ",0,0,0,0,", "row 2 (left_forearm) has a quaternion that is not of unit length"),
    ],
)
def test_a_bad_row_alone_is_left_out(tmp_path, old, new, problem):
    recording = salvage_recording(write(tmp_path / "a.csv", text(rig()).replace(old, new, 1)))
    assert len(list(iter_samples(recording))) == 17
    assert f"{tmp_path / 'a.csv'}: " in recording.damage
    assert " bad rows left out, the first: " + problem in recording.damage
    assert "\n" not in recording.damage


def test_the_first_bad_row_is_named(tmp_path):
    """Sensors are checked one after the other, whatever the order of their rows."""
    lines = text(rig()).splitlines(keepends=True)
    for row in (7, 2):  # pelvis, left_forearm
        lines[row - 1] = lines[row - 1].replace("9.81", "nan")
    lines[4] = "noise\n"
    recording = salvage_recording(write(tmp_path / "a.csv", "".join(lines)))
    assert ": 3 bad rows left out, the first: row 2 (left_forearm) has" in recording.damage


def test_zeros_at_the_end_after_a_power_cut(tmp_path):
    recording = salvage_recording(write(tmp_path / "a.csv", text(rig()) + "\0" * 10_000))
    assert len(list(iter_samples(recording))) == 18
    assert "row 20" in recording.damage


def test_salvage_takes_any_sensors(tmp_path):
    rows = [sample for sample in rig() if sample.sensor in (2, 5)]
    recording = salvage_recording(write(tmp_path / "a.csv", text(rows)))
    assert list(recording.sensors) == ["left_lower_leg", "pelvis"]
    assert missing_sensors(recording) == ["left_forearm", "right_forearm", "right_lower_leg", "head"]
    assert recording.damage is None


def test_salvage_of_what_is_no_recording(tmp_path):
    with pytest.raises(EdgeposeError, match="columns"):
        salvage_recording(write(tmp_path / "a.csv", "frame,time_s\n1,2\n"))


def test_salvage_of_samples_and_arrays(tmp_path):
    rows = rig()
    rows[7] = rows[7]._replace(acc=(0.0, 0.0, 1e30))
    with pytest.raises(EdgeposeError, match="absurd"):
        recording_from_samples(rows)
    recording = recording_from_samples(rows, name="port", salvage=True)
    assert len(list(iter_samples(recording))) == 17
    assert recording.damage.startswith("port: 1 bad rows left out, the first: row 8 (right_forearm)")
    with np.load(REAL) as file:
        values = file["head_acc"].copy()
    values[3] = np.nan
    recording = salvage_recording(npz(tmp_path / "a.npz", head_acc=values))
    assert len(list(iter_samples(recording))) == 1799
    assert "row 3 (head)" in recording.damage


def test_metadata_cannot_start_a_row(tmp_path):
    recording = recording_from_samples(rig(), {"note": "a\n0,head", "x\r": "b"})
    write_csv(tmp_path / "a.csv", recording)
    assert read_recording(tmp_path / "a.csv").metadata == {"note": "a 0,head", "x": "b"}


# --- hostile files ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("time_s,sensor", "time,sensor", ["row 1", "columns", COLUMNS]),
        (",head,", ",hat,", ["row 6", "'hat'", "left_forearm"]),
        ("9.81", "abc", ["row 2", "abc", "number"]),
        ("9.81", "nan", ["row 2", "NaN"]),
        ("9.81", "inf", ["row 2", "NaN"]),
        ("9.81", "1e30", ["row 2", "absurd"]),
        ("9.81", "", ["row 2", "part of acc"]),
        ("9.81", "9.81,1", ["row 2", "16 columns"]),
        ("0.000000,", "nan,", ["row 2", "time"]),
        (",1,0,0,0,", ",1.2,0,0,0,", ["row 2", "left_forearm", "unit length"]),
        (",1,0,0,0,", ",0,0,0,0,", ["row 2", "unit length"]),
        ("0.020000,pelvis", "0.005000,pelvis", ["row 19", "pelvis", "back in time"]),
        ("9.81", '"9.81', ["row 2", "number"]),
        ("9.81", "9" * 5000, ["row 2", "longer"]),
    ],
)
def test_bad_csv(tmp_path, old, new, parts):
    message = error(write(tmp_path / "a.csv", text(rig()).replace(old, new, 1)))
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    "content", [b"", b"\xff\xfe\x00\x80" * 100, b"\0" * 10_000, b"# a: b\n", b"frame,time_s\n1,2\n"]
)
def test_no_csv_at_all(tmp_path, content):
    path = tmp_path / "a.csv"
    path.write_bytes(content)
    error(path)


def test_missing_sensors(tmp_path):
    rows = [r for r in rig() if r.sensor not in (1, 5)]
    assert "right_forearm, pelvis" in error(write(tmp_path / "a.csv", text(rows)))
    assert "no samples" in error(write(tmp_path / "b.csv", text([])))


def test_files_that_cannot_be_opened(tmp_path):
    assert "No such file" in error(tmp_path / "none.csv")
    assert "No such file" in error(tmp_path / "none.npz")
    assert "directory" in error(tmp_path)


def npz(path, **changes):
    with np.load(REAL) as file:
        arrays = {k: file[k] for k in file.files}
    arrays.update(changes)
    np.savez_compressed(path, **{k: v for k, v in arrays.items() if v is not None})
    return path


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"t": None}, "no times"),
        ({"t": np.arange(300.0)[::-1]}, "back in time"),
        ({"t": np.arange(299.0)}, "(299, 4)"),
        ({"t": np.arange(300.0)[:, None, None] * np.ones((1, 2, 1))}, "'t'"),
        ({"pelvis_acc": np.full((300, 3), np.nan)}, "row 0 (pelvis)"),
        ({"pelvis_acc": np.ones((300, 4))}, "'pelvis_acc'"),
        ({"pelvis_acc": np.full((300, 3), "a")}, "'pelvis_acc'"),
        ({"head_quat": np.ones((300, 4))}, "(head) has a quaternion"),
        ({"hat_acc": np.ones((300, 3))}, "'hat_acc'"),
        ({"metadata": np.ones(3)}, "'metadata'"),
        ({"head_quat": None, "head_acc": None, "head_gyr": None}, "no samples of head"),
    ],
)
def test_bad_npz(tmp_path, changes, part):
    assert part in error(npz(tmp_path / "a.npz", **changes))


def test_npz_with_pickles_is_refused(tmp_path):
    assert "pickle" in error(npz(tmp_path / "a.npz", head_acc=np.array([{}, []], dtype=object)))


def test_decompression_bomb_is_not_unpacked(tmp_path):
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("t.npy", "w") as member:
        for _ in range(300):
            member.write(bytes(1 << 20))
    assert path.stat().st_size < 1 << 20
    assert "300 MB" in error(path)


def test_array_header_that_promises_too_much(tmp_path):
    path = tmp_path / "a.npz"
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**13,)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("t.npy", header.getvalue())
    error(path)


def test_a_sensor_that_was_restarted(tmp_path):
    """Its rows after that cannot be dated; sorting them would mix the two halves."""
    recording = read_recording(REAL)
    head = recording.sensors["head"]
    time_s = head.time_s.copy()
    time_s[200:] -= 1.9
    recording.sensors["head"] = head._replace(time_s=time_s)
    write_npz(tmp_path / "a.npz", recording)
    with pytest.raises(
        EdgeposeError, match=r"row 200 \(head\) goes back in time by more than a second: its clock"
    ):
        read_recording(tmp_path / "a.npz")
    salvaged = read_recording(tmp_path / "a.npz", salvage=True)
    assert salvaged.damage.startswith(f"{tmp_path / 'a.npz'}: ")
    assert 200 <= len(salvaged.sensors["head"].time_s) < len(time_s)
    assert len(salvaged.sensors["pelvis"].time_s) == len(time_s)


@pytest.mark.parametrize("block", [1, 7, 1000])
def test_rows_after_a_restart_are_left_out_even_if_they_pass_the_times_before_it(block):
    times = np.concatenate([0.01 * np.arange(200), 0.01 * np.arange(500)])
    table = SampleTable("a", salvage=True)
    for start in range(0, len(times), block):
        part = times[start : start + block]
        rows = np.column_stack([part, np.tile([1.0, 0, 0, 0, 0, 0, 9.81, 0, 0, 0, 0, 0, 0], (len(part), 1))])
        table.add_block("head", start + 1 + np.arange(len(part)), rows, np.zeros(len(part), dtype=int))
    assert table.sensors()["head"].time_s == pytest.approx(times[:200])
    assert table.damage().startswith("a: 500 bad rows left out, the first: row 201 (head) goes back")


def test_one_row_that_goes_back_is_no_restart(tmp_path):
    rows = [row._replace(time_s=row.time_s * 10) for row in rig(60)]
    spoilt = 6 * 40 + PLACEMENTS.index("head")
    rows[spoilt] = rows[spoilt]._replace(time_s=0.0)
    recording = salvage_recording(write(tmp_path / "a.csv", text(rows)))
    assert len(recording.sensors["head"].time_s) == 59
    assert recording.damage.startswith(f"{tmp_path / 'a.csv'}: 1 bad rows left out")


def semicolons(content):
    return "sep=;\n" + content.replace(",", ";").replace(".", ",")


def quoted(content):
    return "".join(",".join(f'"{cell}"' for cell in row.split(",")) + "\r\n" for row in content.splitlines())


@pytest.mark.parametrize(
    "save",
    [
        lambda content: content.encode("utf-16"),
        lambda content: semicolons(content).encode("utf-8-sig"),
        lambda content: quoted(content).encode(),
        lambda content: content.replace(",", "\t").encode(),
        lambda content: content.replace(",", ", ").encode(),
        lambda content: content.replace("\n", ",,\n").encode() + b",,,,,,,,,,,,,,,,\n",
        lambda content: content.replace("\n", "\r").encode(),
    ],
    ids=["UTF-16", "decimal commas", "quotes", "tabs", "blanks", "empty columns and rows", "CR"],
)
def test_recordings_that_other_programs_have_saved_again(tmp_path, save):
    rows = [row._replace(mag=(1.5, 2, 3) if row.sensor == 4 else None) for row in rig(4)]
    path = tmp_path / "a.csv"
    path.write_bytes(save(text(rows)))
    recording = read_recording(path)
    assert recording.damage is None
    same(recording, recording_from_samples(rows))


@pytest.mark.parametrize("between", ["", COLUMNS + "\n", "# place: gym, hall 2\n" + COLUMNS + "\n"])
def test_recordings_that_were_joined(tmp_path, between):
    rows = rig(6)
    recording = read_recording(write(tmp_path / "a.csv", text(rows[:18]) + between + text(rows[18:])))
    assert recording.damage is None
    same(recording, recording_from_samples(rows))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda rows: rows[::-1], "split the recording there, or sort the rows by time_s"),
        (
            lambda rows: [f"2023-10-29T02:00:{row}" for row in rows],
            r"row 2 has the time '2023-10-29T02:00:0.000000'; times are numbers of seconds",
        ),
    ],
)
def test_times_in_another_order_or_form(tmp_path, change, says):
    rows = [csv_row(row._replace(time_s=row.time_s * 100)) for row in rig(4)]
    assert says in error(write(tmp_path / "a.csv", COLUMNS + "\n" + "".join(change(rows))))
