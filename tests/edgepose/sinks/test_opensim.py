"""Files for OpenSim, moved through the axes of its published full-body models.

OpenSim 4.6 itself (PyPI's wheel has 72 MB) read the files of this test once, see docs/reference/outputs.md.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgepose.formats.opensim import BODIES, TO_OPENSIM
from edgepose.pose import PoseFrame
from edgepose.sinks.opensim import MotSink, StoSink
from edgepose.skeleton import JOINTS, default_body, forward_kinematics

X, Y, Z = np.eye(3)
COUNT = 40
RIGID = ("ankle", "foot", "wrist", "hand")

# Joints of Rajagopal's model as its file has them, with a knee that does not slide: parent, child, and the
# coordinates with their axes. Those of the left side are mirrored. The elbow and the forearm are simplified.
CHAIN = [
    ("ground", "pelvis", [("pelvis_tilt", Z), ("pelvis_list", X), ("pelvis_rotation", Y)]),
    ("pelvis", "torso", [("lumbar_extension", Z), ("lumbar_bending", X), ("lumbar_rotation", Y)]),
]
for side, out in (("r", 1.0), ("l", -1.0)):
    CHAIN += [
        (
            "pelvis",
            f"femur_{side}",
            [("hip_flexion", Z), ("hip_adduction", out * X), ("hip_rotation", out * Y)],
        ),
        (f"femur_{side}", f"tibia_{side}", [("knee_angle", -Z)]),
        (f"tibia_{side}", f"calcn_{side}", [("ankle_angle", Z), ("subtalar_angle", out * X)]),
        ("torso", f"humerus_{side}", [("arm_flex", Z), ("arm_add", out * X), ("arm_rot", out * Y)]),
        (f"humerus_{side}", f"radius_{side}", [("elbow_flex", Z), ("pro_sup", out * Y)]),
    ]


def read(path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """The header and the columns of a file, of which each cell may hold several numbers."""
    head, _, table = path.read_text().partition("endheader\n")
    names, *rows = (line.split("\t") for line in table.splitlines())
    cells = [[[float(number) for number in cell.split(",")] for cell in row] for row in rows]
    columns = {name: np.array([row[i] for row in cells]) for i, name in enumerate(names)}
    pairs = (line.split("=") for line in head.splitlines() if "=" in line)
    return {key: value.strip() for key, value in pairs}, columns


def motion() -> np.ndarray:
    """Local rotations (T, 24, 3, 3) of a wearer who moves everything that the models can move."""
    rng = np.random.default_rng(1)
    angles = np.cumsum(rng.normal(0.0, 0.03, (COUNT, 24, 3)), axis=0)
    angles[:, [JOINTS.index(f"{side}_{joint}") for side in ("left", "right") for joint in RIGID]] = 0.0
    rotations = Rotation.from_rotvec(angles.reshape(-1, 3)).as_matrix().reshape(COUNT, 24, 3, 3)
    bend = np.linspace(0.0, 1.8, COUNT)[:, None]
    for side, out in (("left", 1.0), ("right", -1.0)):
        knee, shoulder, elbow = (JOINTS.index(f"{side}_{name}") for name in ("knee", "shoulder", "elbow"))
        rotations[:, knee] = Rotation.from_rotvec(bend * X).as_matrix()
        rotations[:, shoulder] = Rotation.from_rotvec(-1.2 * out * Z).as_matrix() @ rotations[:, shoulder]
        turned = Rotation.from_rotvec(0.5 * out * np.sin(6.0 * bend) * X)
        rotations[:, elbow] = (Rotation.from_rotvec(-out * bend * Y) * turned).as_matrix()
    return rotations


def write(path: Path, rotations: np.ndarray, translation: np.ndarray | None = None, **settings: str) -> Path:
    sink = StoSink(path) if path.suffix == ".sto" else MotSink(path, **settings)
    with sink:
        for i, local in enumerate(rotations):
            place = None if translation is None else translation[i]
            sink.write(PoseFrame(i, 1.7e9 + i / 60.0, local, np.zeros(24, np.float32), place))
    return path


def test_the_models_take_the_poses(tmp_path):
    rotations = motion()
    path = np.stack([0.1 * np.arange(COUNT), np.full(COUNT, 0.9), 0.02 * np.arange(COUNT)], axis=1)
    head, angles = read(write(tmp_path / "a.mot", rotations, path))
    assert head == {"version": "1", "nRows": str(COUNT), "nColumns": str(len(angles)), "inDegrees": "yes"}
    np.testing.assert_allclose(angles["time"][:, 0], np.arange(COUNT) / 60.0, atol=1e-6)
    frames = {"ground": Rotation.identity(COUNT)}
    for parent, body, axes in CHAIN:
        turn = frames[parent]
        for name, axis in axes:
            column = angles[name if body in ("pelvis", "torso") else f"{name}_{body[-1]}"]
            turn = turn * Rotation.from_rotvec(np.radians(column) * axis)
        frames[body] = turn
    head, quats = read(write(tmp_path / "a.sto", rotations))
    assert (head["DataRate"], head["DataType"]) == ("60.000000", "Quaternion")
    assert list(quats) == ["time", *(f"{body}_imu" for body in BODIES)]
    for body in BODIES:
        measured = Rotation.from_quat(quats[f"{body}_imu"], scalar_first=True)
        assert np.degrees((frames[body].inv() * measured).magnitude()).max() < 1e-3, body
    # The hip joints of the model are those of the wearer.
    joints = forward_kinematics(rotations, default_body().offsets, path)[1]
    hips = joints[:, [JOINTS.index("left_hip"), JOINTS.index("right_hip")]].mean(axis=1) @ TO_OPENSIM.T
    origin = np.stack([angles[f"pelvis_t{axis}"][:, 0] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(origin + frames["pelvis"].apply([-0.056276, -0.07849, 0.0]), hips, atol=2e-6)


ARMS = {"left_shoulder": -90 * Z, "right_shoulder": 90 * Z}  # hang


@pytest.mark.parametrize(
    ("turns", "wanted"),
    [
        (ARMS, {"pro_sup_l": 90, "pro_sup_r": 90}),
        ({}, {"arm_add_l": -90, "arm_add_r": -90, "pro_sup_l": 90, "pro_sup_r": 90}),
        (ARMS | {"left_knee": 80 * X, "right_knee": 40 * X}, {"knee_angle_l": 80, "knee_angle_r": 40}),
        (ARMS | {"left_hip": -30 * X}, {"hip_flexion_l": 30}),
        (ARMS | {"left_hip": 20 * Z, "right_hip": 10 * Z}, {"hip_adduction_l": -20, "hip_adduction_r": 10}),
        (ARMS | {"left_hip": -15 * Y, "right_hip": 15 * Y}, {"hip_rotation_l": 15, "hip_rotation_r": 15}),
        (ARMS | {"pelvis": 25 * X}, {"pelvis_tilt": -25}),
        (ARMS | {"pelvis": 90 * Y}, {"pelvis_rotation": 90}),
        (ARMS | {"spine3": 20 * X}, {"lumbar_extension": -20}),
        (ARMS | {"spine1": 12 * Z}, {"lumbar_bending": 12}),
        (ARMS | {"left_elbow": -100 * Y}, {"elbow_flex_l": 100}),
        (ARMS | {"right_elbow": 100 * Y}, {"elbow_flex_r": 100}),
        (ARMS | {"right_elbow": 30 * X}, {"pro_sup_r": 120}),
        (ARMS | {"left_ankle": -10 * X}, {"ankle_angle_l": 10}),
    ],
)
def test_signs(tmp_path, turns, wanted):
    """Flexion, adduction, internal rotation, dorsiflexion and pronation are positive on either side."""
    local = np.tile(np.eye(3), (1, 24, 1, 1))
    for name, vector in turns.items():
        local[0, JOINTS.index(name)] = Rotation.from_rotvec(vector, degrees=True).as_matrix()
    _, angles = read(write(tmp_path / "a.mot", local))
    found = {name: round(float(values[0, 0]), 3) for name, values in angles.items()}
    places = ("time", "pelvis_tx", "pelvis_ty", "pelvis_tz")
    usual = {"pro_sup_l": 90, "pro_sup_r": 90}
    assert {name: value for name, value in found.items() if value and name not in places} == usual | wanted
    _, angles = read(write(tmp_path / "b.mot", local, model="gait2392"))
    assert angles["knee_angle_l"][0, 0] == pytest.approx(-wanted.get("knee_angle_l", 0.0))


def test_raised_arms_do_not_jump(tmp_path):
    """Beyond the height of the shoulders the angles go on instead of turning by 180 degrees."""
    local = np.tile(np.eye(3), (60, 24, 1, 1))
    shoulder = JOINTS.index("left_shoulder")
    local[:, shoulder] = Rotation.from_rotvec(np.radians(np.linspace(-90, 30, 60))[:, None] * Z).as_matrix()
    local[:, JOINTS.index("right_shoulder")] = Rotation.from_rotvec(np.pi / 2 * Z).as_matrix()
    local[:, 0] = Rotation.from_rotvec(np.linspace(0.0, 9.0, 60)[:, None] * Y).as_matrix()
    _, angles = read(write(tmp_path / "a.mot", local))
    np.testing.assert_allclose(angles["arm_add_l"][:, 0], np.linspace(0, -120, 60), atol=1e-3)
    assert max(np.abs(np.diff(values[:, 0])).max() for values in angles.values()) < 9.0
    assert angles["pelvis_rotation"][-1, 0] == pytest.approx(np.degrees(9.0))


def test_an_arm_that_has_swung_round_hangs_as_before(tmp_path):
    local = np.tile(np.eye(3), (73, 24, 1, 1))
    swung = Rotation.from_rotvec(np.linspace(0.0, -2.0 * np.pi, 73)[:, None] * X)
    for name, vector in ARMS.items():
        hanging = Rotation.from_rotvec(vector, degrees=True)
        local[:, JOINTS.index(name)] = (swung * hanging).as_matrix()
    _, angles = read(write(tmp_path / "a.mot", local))
    flexion = angles["arm_flex_r"][:, 0]
    assert flexion[50] == pytest.approx(250.0)
    assert abs(flexion[-1]) < 1e-3
    assert np.sum(np.abs(np.diff(flexion)) > 6.0) == 1
