"""Whole files of every kind that edgepose reads, and the commands that read them."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import can
import numpy as np
from fuzz_process import Ended
from fuzz_training_seeds import training_seeds

from edgepose.formats.poses.registry import READERS as POSE_READERS
from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.raw_capture import times_header, times_row
from edgepose.formats.recordings.registry import READERS
from edgepose.imu import Recording, SensorData
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array, quat_multiply, quat_rotate, rotvec_to_quat
from edgepose.skeleton import PARENTS, default_body, forward_kinematics
from edgepose.sources.can_log import write_log
from edgepose.sources.replay import CAN_LOGS
from firmware_protocols.base import Protocol
from firmware_protocols.registry import PROTOCOLS
from firmware_protocols.sample import Sample
from tests.edgepose.formats.test_formats import FRAMES, RATE, writer

DATA = Path(__file__).parents[1] / "tests" / "data"

UNREADABLE = (".mf4",)
"""Endings of CAN logs that need a package which is not among those of the tests."""

Run = Callable[[list[str], Path], Ended]


class Kind(NamedTuple):
    """A kind of file.

    Attributes:
        name: for `--only`, and for messages.
        seed: a whole file or folder of the kind.
        commands: words of the commands that read it; {file} is the damaged one, {out} a folder for outputs,
            {seeds} the folder of the whole files.
        inside: the name of {file} if the seed is the folder around it.
    """

    name: str
    seed: Path
    commands: tuple[str, ...]
    inside: str | None = None


CONVERT = ("convert {file} --to npz --out {out}", "convert {file} --to csv --out {out}")
RECORDING = (
    *CONVERT,
    *(
        "check --file {file}",
        "check --file {file} --json",
        "check --file {file} --calibration {seeds}/calibration.json",
    ),
    "convert {file} --to csv --filter kalman --out {out}",
    "calibrate --file {file} --from 0 --hold 0.6 --body-frame heading:0 --out {out}/calibration.json",
    "record {out}/recording.csv --file {file}",
    "run --file {file} --calibration {seeds}/calibration.json --model rnn --csv {out}/p.csv "
    "--npz {out}/p.npz",
    "solve {file} --calibration {seeds}/calibration.json --method sop --csv {out}/p.csv --bvh {out}/p.bvh",
)
POSES = (
    *CONVERT,
    *("convert {file} --to bvh --out {out}", "report {file} --out {out}/report.html"),
)
MOTION = ("synthesize {file} --out {out}", "synthesize {file} --out {out} --hold 1 --mounting 1")
CAPTURE = (
    *(
        "convert {file} --to npz --out {out}",
        "check --file {file} --json",
        "record {out}/r.csv --file {file}",
    ),
    "run --file {file} --calibration {seeds}/calibration.json --model rnn --csv {out}/p.csv",
)

# --- a wearer -----------------------------------------------------------------------------------------------


def make_recording() -> Recording:
    """Six sensors that rest and then turn; specific force and rates are those of the rotation."""
    time_s = np.arange(FRAMES) / RATE
    sensors = {}
    for number, name in enumerate(PLACEMENTS):
        axis = np.roll([0.2, 1.0, 0.5], number)
        angle = np.maximum(0.0, time_s - 0.8) * (1.0 + 0.1 * number)
        start = rotvec_to_quat(np.array([0.3 * number, 0.1, 0.2 * number]))
        quat = quat_multiply(start, rotvec_to_quat(angle[:, None] * axis))
        conjugate = quat * [1.0, -1.0, -1.0, -1.0]
        noise = np.random.default_rng(number).normal(scale=0.01, size=(FRAMES, 3))
        acc = quat_rotate(conjugate, np.array([0.0, 0.0, 9.81])) + noise
        gyr = np.gradient(angle, time_s)[:, None] * axis + 0.1 * noise
        mag = quat_rotate(conjugate, np.array([0.0, 20.0, -40.0])) + noise
        sensors[name] = SensorData(time_s, quat, acc, gyr, mag)
    return Recording(sensors, {})


def make_body() -> dict[str, Any]:
    """The arrays of an SMPL model of the default body."""
    joints = forward_kinematics(np.tile(np.eye(3), (24, 1, 1)), default_body().offsets)[1]
    ends = np.array([[0.0, joints[:, 1].min() - 0.05, 0.0], [0.0, joints[15, 1] + 0.2, 0.0]])
    regressor = np.concatenate([np.eye(24), np.zeros((24, 2))], axis=1)
    kintree = np.array([PARENTS, range(24)], np.int64).astype(np.uint32)
    return {"J_regressor": regressor, "v_template": np.concatenate([joints, ends]), "kintree_table": kintree}


def make_prior() -> dict[str, Array]:
    """The arrays of a prior over poses."""
    size = 69
    limits = np.full(size, 2.0)
    return {"mean": np.zeros(size), "covariance": np.eye(size), "lower": -limits, "upper": limits}


# --- wires --------------------------------------------------------------------------------------------------


def line_ids(protocol: Protocol) -> list[int]:
    """Return the ids that come out if sensors of the protocol's ids are encoded; 0 if they have no ids."""
    assert protocol.encoder is not None
    encode, decoder = protocol.encoder(), protocol.decoder()
    found: set[int] = set()
    for number in range(3 * len(protocol.ids)):
        sensor = protocol.ids[number % len(protocol.ids)]
        packet = encode(
            Sample(sensor, 10_000 * number, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 9.81), (0.0,) * 3), number
        )
        for words in [[packet]] if protocol.transport != "can" else [frame[:3] for frame in packet]:
            found |= {sample.sensor for sample in decoder.feed(*words)}
    return list(protocol.ids) if found == set(protocol.ids) and found else [0]


def wire(protocol: Protocol, recording: Recording) -> Iterator[tuple[float, Any]]:
    """Yield time and packet (bytes, or CAN frames) of a recording's samples."""
    assert protocol.encoder is not None
    encode = protocol.encoder()
    ids = line_ids(protocol)
    count = dict.fromkeys(range(len(PLACEMENTS)), 0)
    for sample in iter_samples(recording):
        if sample.sensor < len(ids):
            quantities = [None if value is None else tuple(value) for value in sample[2:6]]
            packet = Sample(ids[sample.sensor], round(1e6 * sample.time_s), *quantities, 25.0)
            yield sample.time_s, encode(packet, count[sample.sensor])
            count[sample.sensor] += 1


def write_capture(path: Path, protocol: Protocol, recording: Recording) -> None:
    """Write a raw capture with arrival times."""
    end = 0
    content, times = b"", times_header({"protocol": protocol.name})
    for time_s, data in wire(protocol, recording):
        content += data
        end += len(data)
        times += times_row(1e9 + time_s, end)
    path.write_bytes(content)
    path.with_name(path.name + ".times").write_text(times)


def messages(protocol: Protocol, recording: Recording) -> Iterator[can.Message]:
    """Yield the frames of a CAN bus."""
    for time_s, frames in wire(protocol, recording):
        for identifier, data, extended, fd in frames:
            yield can.Message(
                timestamp=1e9 + time_s,
                arbitration_id=identifier,
                data=data,
                is_extended_id=extended,
                is_fd=fd,
                channel=0,
            )


def id_map(ids: list[int]) -> str:
    """Return a sensor map by id: of one sensor and five that are not there, if there is one id."""
    ids = ids if len(ids) == len(PLACEMENTS) else list(range(len(PLACEMENTS)))
    return "".join(f"{name} = {{ id = {number} }}\n" for name, number in zip(PLACEMENTS, ids, strict=True))


# --- all kinds ----------------------------------------------------------------------------------------------


def recording_kinds(folder: Path, recording: Recording) -> Iterator[Kind]:
    """Yield the kinds of recordings, each written in its format."""
    for name in READERS:
        yield Kind(name, writer(name)(folder / name, recording), RECORDING)


def pose_kinds(folder: Path, recording: Path, run: Run) -> Iterator[Kind]:
    """Yield the kinds of poses: as `run` writes them, and in the one format that is only read."""
    words = f"run --file {recording} --calibration {folder}/calibration.json --model rnn --std".split()
    outputs = [
        word for ending in ("csv", "npz", "bvh") for word in (f"--{ending}", f"{folder}/poses.{ending}")
    ]
    made(run([*words, *outputs], folder))
    made(run([*words, "--csv", f"{folder}/matrix.csv", "--rotations", "matrix"], folder))
    truth = {
        "gt": np.zeros((FRAMES, 72)),
        "imu_ori": np.tile(np.eye(3), (FRAMES, 17, 1, 1)),
        "imu_acc": np.zeros((FRAMES, 17, 3)),
    }
    (folder / "poses.pkl").write_bytes(pickle.dumps(truth, 2))
    suffixes = {"csv": ".csv", "npz": ".npz", "bvh": ".bvh", "dip": ".pkl"}
    for name in POSE_READERS:
        yield Kind(f"poses-{name}", folder / f"poses{suffixes[name]}", POSES)
    yield Kind("poses-matrix", folder / "matrix.csv", POSES)


def wire_kinds(folder: Path, recording: Recording) -> Iterator[Kind]:
    """Yield captures and logs of all protocols, and logs of all kinds."""
    for name, protocol in PROTOCOLS.items():
        if protocol.in_datagrams:  # no file holds datagrams
            continue
        (folder / f"{name}.toml").write_text(id_map(line_ids(protocol)))
        sensors = f" --sensors {{seeds}}/{name}.toml"
        more = f"{sensors} --protocol {name}"
        if protocol.transport != "can":
            inside = folder / name
            inside.mkdir()
            write_capture(inside / "walk.bin", protocol, recording)
            yield Kind(name, inside, (*(words + more for words in CAPTURE), CAPTURE[1] + sensors), "walk.bin")
        else:
            write_log(folder / f"{name}.log", messages(protocol, recording))
            yield Kind(name, folder / f"{name}.log", tuple(words + more for words in CAPTURE))
    for ending in (*CAN_LOGS, ".csv", ".asc.gz", ".log.gz"):
        if ending not in UNREADABLE:
            path = folder / f"log{ending}"
            write_log(path, messages(PROTOCOLS["native-can"], recording))
            yield Kind(f"log{ending}", path, CAPTURE)
    for path in sorted((DATA / "protocols").glob("*.bin")):
        more = " --sensors {seeds}/witmotion.toml"
        yield Kind(path.stem, path, (CAPTURE[1] + more, CAPTURE[0] + more))


RIG = """file = "recordings/npz.npz"
calibration = "calibration.json"
name = "anna"
csv = "../out/p.csv"
npz = "../out/p.npz"
rotations = "quat"
height = 1.8
filter = "none"
overwrite = true
"""

FIELDS = ("sensor", "time", "w", "x", "y", "z", "ax", "ay", "az")
GROUPS = " ".join(rf"(?P<{name}>\S+)" for name in FIELDS)
PATTERN = f"""regex = '^IMU{GROUPS}$'
frame = "NED"
units = {{ acc = "-g", time = "ms" }}
wrap_us = 4294967296
"""

COLUMNS = """header = "t;id;qw;qx;qy;qz;ax;ay;az"
separator = ";"
units = { acc = 0.01, time = "s" }

[columns]
time = "t"
sensor = ["id", "no"]
w = "qw"
x = "qx"
y = "qy"
z = "qz"
ax = "ax"
ay = "ay"
az = "az"
"""


def text_lines(recording: Recording) -> tuple[str, str]:
    """Return a recording as lines for PATTERN, and as lines for COLUMNS."""
    lines, rows = [], ["t;id;qw;qx;qy;qz;ax;ay;az"]
    for sample in iter_samples(recording):
        quat, acc = ([f"{value:.5f}" for value in values] for values in (sample.quat, sample.acc))
        lines.append(" ".join([f"IMU{sample.sensor} {1000 * sample.time_s:.0f}", *quat, *acc]))
        rows.append(";".join([f"{sample.time_s:.4f}", str(sample.sensor), *quat, *acc]))
    return "\n".join(lines) + "\n", "\n".join(rows) + "\n"


def settings_kinds(folder: Path, recording: Recording) -> Iterator[Kind]:
    """Yield calibrations, sensor maps, rigs and descriptions of text lines."""
    use = "--calibration {file} --csv {out}/p.csv"
    npz = "{seeds}/recordings/npz.npz"
    commands = (
        f"run --file {npz} --model rnn {use}",
        f"solve {npz} --method sop {use}",
        f"check --file {npz} --calibration {{file}}",
    )
    yield Kind("calibration", folder / "calibration.json", commands)
    for name, text in (("rig", RIG), ("pattern", PATTERN), ("columns", COLUMNS)):
        (folder / f"{name}.toml").write_text(text)
    yield Kind(
        "sensor-map",
        folder / "native.toml",
        ("check --file {seeds}/native/walk.bin --json --sensors {file}",),
    )
    rig = folder / "rigs"
    rig.mkdir()
    for name in ("recordings/npz.npz", "calibration.json", "rig.toml"):
        (rig / name).parent.mkdir(exist_ok=True)
        shutil.copy(folder / name, rig / name)
    yield Kind("rig", rig, ("run --rig {file} --model rnn",), "rig.toml")
    for name, text in zip(("pattern", "columns"), text_lines(recording), strict=True):
        (folder / f"{name}.bin").write_text(text)
        words = "check --file {seeds}/" + f"{name}.bin --json --protocol {{file}}"
        yield Kind(name, folder / f"{name}.toml", (words, words.replace(" --json", "")))
        words = f"check --file {{file}} --json --protocol {{seeds}}/{name}.toml"
        yield Kind(f"lines-{name}", folder / f"{name}.bin", (words,))


def other_kinds(folder: Path) -> Iterator[Kind]:
    """Yield bodies, priors, motion capture and model archives."""
    use = "{seeds}/recordings/npz.npz --calibration {seeds}/calibration.json --csv {out}/p.csv"
    solve = f"solve {use} --method sop"
    body = make_body()
    np.savez(folder / "body.npz", **body)
    (folder / "body.pkl").write_bytes(pickle.dumps(body, 2))
    synthesize = f"synthesize {DATA}/mocap/07_01.bvh --out {{out}} --body {{file}}"
    for ending in ("npz", "pkl"):
        yield Kind(f"body-{ending}", folder / f"body.{ending}", (f"{solve} --body {{file}}", synthesize))
    np.savez(folder / "prior.npz", about="made up", **make_prior())
    yield Kind("prior", folder / "prior.npz", (f"{solve} --prior {{file}}",))
    capture = folder / "amc"
    capture.mkdir()
    for name in ("07.asf", "07_01.amc"):
        shutil.copy(DATA / "mocap" / name, capture)
    yield Kind("amc", capture, MOTION, "07_01.amc")
    yield Kind("bvh", DATA / "mocap" / "07_01.bvh", MOTION)
    model = Path(__file__).parents[1] / "edgepose" / "inference" / "models" / "rnn.pt"
    yield Kind("model", model, ("models {file}", f"run --file {use} --model {{file}}"))


def make_kinds(folder: Path, run: Run) -> dict[str, Kind]:
    """Write a whole file of each kind into a folder; return the kinds by name."""
    recording = make_recording()
    recordings = folder / "recordings"
    recordings.mkdir()
    kinds = list(recording_kinds(recordings, recording))
    npz = recordings / "npz.npz"
    made(run(RECORDING[6].format(file=npz, out=folder, seeds=folder).split(), folder))
    kinds += pose_kinds(folder, npz, run)
    kinds += wire_kinds(folder, recording)
    kinds += settings_kinds(folder, recording)
    kinds += other_kinds(folder)
    kinds += [Kind(*seed) for seed in training_seeds(folder, run)]
    return {kind.name: kind for kind in kinds}


def made(ended: Ended) -> None:
    """Raise RuntimeError unless a command has done its work."""
    if ended.code:
        raise RuntimeError(ended.errors)


def counted(folder: Path) -> int | None:
    """Return the number of samples or poses in the only NPZ file of a folder; None if there is not one."""
    files = list(folder.rglob("*.npz"))
    if len(files) != 1:
        return None
    with np.load(files[0]) as arrays:
        if "poses" in arrays.files:
            return len(arrays["poses"])
        times = {key: len(arrays[key]) for key in arrays.files if key == "t" or key.endswith("_t")}
        quantities = {
            key.rpartition("_")[0] for key in arrays.files if key.endswith(("_quat", "_acc", "_gyr"))
        }
        return sum(times.get(f"{name}_t", times.get("t", 0)) for name in quantities)
