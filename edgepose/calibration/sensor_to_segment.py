"""The calibration: bone offsets from a known pose (DIP eq. 7), and bones from oriented frames."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgepose import rotations as rot
from edgepose.calibration.added import NO_SENSORS, AddedSensors
from edgepose.calibration.body_frame import body_from_inertial
from edgepose.calibration.checks import HoldSummary
from edgepose.errors import CalibrationError
from edgepose.imu import GRAVITY
from edgepose.placements import PLACEMENTS, SITES
from edgepose.rotations import Array
from edgepose.skeleton import JOINTS

_IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def _arms(angle: float) -> Array:
    """Return R_TB0 (6, 3, 3) with the left forearm rotated by `angle` about Z, the right by the opposite."""
    bones = np.tile(np.eye(3), (len(PLACEMENTS), 1, 1))
    for name, signed in (("left_forearm", angle), ("right_forearm", -angle)):
        bones[PLACEMENTS.index(name)] = rot.rotation_about_axis("z", signed)
    return bones


POSES: Mapping[str, Array] = {"straight": _arms(-math.pi / 2), "t-pose": _arms(0.0)}
"""R_TB0 (6, 3, 3) of the poses to hold: `straight` is the N-pose, arms hanging, palms to the thighs."""


def held_bone(pose: str, name: str) -> Array:
    """Return R_TB0 (3, 3) of a sensor's bone in a calibration pose: arms are rotated like their forearms."""
    joint = JOINTS[SITES[name]]
    arm = joint.endswith(("shoulder", "elbow", "wrist", "hand"))
    placement = f"{joint.partition('_')[0]}_forearm" if arm else "pelvis"
    bone: Array = POSES[pose][PLACEMENTS.index(placement)]
    return bone


class CalibratedSensor(NamedTuple):
    """What a calibration knows of one sensor; see `Calibration`."""

    heading_offset: float
    bone_from_sensor: Array
    residual_deg: float


@dataclass(frozen=True, eq=False)
class Calibration:
    """Everything needed to turn an oriented frame into bones in the body frame.

    Attributes:
        body_from_inertial: (4,) quaternion of R_TI.
        heading_offset: (6,) rotation about Z from each sensor's inertial frame to the common one, rad.
        bone_from_sensor: (6, 4) quaternions of R_BS, the mounting of each sensor on its bone.
        residual_deg: (6,) RMS angle of each sensor about its mean over the hold, degrees.
        pose: key of POSES that was held.
        body_frame: method by which R_TI was found: `head`, `SENSOR:AXIS` or `heading:DEG`.
        created: ISO 8601 time.
        metadata: further facts (source, window, ...), JSON values.
        filter: filter that computed the orientations, one of `edgepose.imu.FILTERS`.
        north: whether all headings count from one north; if not, they change whenever a filter restarts.
        height_m: the wearer's height, metres; None if unknown.
        added: the sensors besides the six.
        without: those of the six that the rig lacks; their values in the arrays mean nothing.
    """

    body_from_inertial: Array
    heading_offset: Array
    bone_from_sensor: Array
    residual_deg: Array
    pose: str
    body_frame: str
    created: str
    metadata: Mapping[str, Any]
    filter: str = "none"
    north: bool = True
    height_m: float | None = None
    added: AddedSensors = NO_SENSORS
    without: Sequence[str] = ()

    @property
    def sensors(self) -> dict[str, CalibratedSensor]:
        """All sensors of the rig by name, in the order of SENSORS."""
        added = self.added
        rows = zip(self.heading_offset, self.bone_from_sensor, self.residual_deg, strict=True)
        more = zip(added.heading_offset, added.bone_from_sensor, added.residual_deg, strict=True)
        names = [*PLACEMENTS, *added.names]
        return {
            name: CalibratedSensor(float(heading), mount, float(residual))
            for name, (heading, mount, residual) in zip(names, chain(rows, more), strict=True)
            if name not in self.without
        }

    @property
    def names(self) -> list[str]:
        """Names of the sensors of the rig, in the order of SENSORS."""
        return list(self.sensors)

    @cached_property
    def missing(self) -> NDArray[np.bool_]:
        """Which of the six sensors the rig lacks, (6,)."""
        return np.array([name in self.without for name in PLACEMENTS])

    @property
    def compares_headings(self) -> bool:
        """Whether headings can be compared: without a common north, those that were reset drift."""
        return self.north and not np.any(self.heading_offset)

    @cached_property
    def _maps(self) -> tuple[Array, Array, Array]:
        """Maps from q q^T to R_TB (6, 16, 9) and from force rows in I to T (6, 3, 3); gravity in T (3,)."""
        r_ti = rot.quat_to_matrix(self.body_from_inertial)
        left = r_ti @ rot.quat_to_matrix(rot.quat_about_z(self.heading_offset))
        right = rot.transpose(rot.quat_to_matrix(self.bone_from_sensor))
        bones = np.einsum("sab,ijbc,scd->sijad", left, _quadratic_form(), right)
        return bones.reshape(-1, 16, 9), rot.transpose(left), r_ti @ np.array([0.0, 0.0, -GRAVITY])

    @cached_property
    def _added_maps(self) -> tuple[Array, Array]:
        """R_TI with the heading of each added sensor, and its inverse R_BS, (A, 3, 3) both."""
        headings = rot.quat_to_matrix(rot.quat_about_z(self.added.heading_offset))
        left = rot.quat_to_matrix(self.body_from_inertial) @ headings
        return left, rot.transpose(rot.quat_to_matrix(self.added.bone_from_sensor))


def _quadratic_form() -> Array:
    """Return the symmetric coefficients K (4, 4, 3, 3) with R(q) = sum of q_i q_j K_ij for unit q."""
    unit = np.eye(4)
    squares = rot.quat_to_matrix(unit)
    form = rot.quat_to_matrix((unit[:, None] + unit) / math.sqrt(2.0)) - (squares[:, None] + squares) / 2.0
    form[range(4), range(4)] = squares  # the line above is right only for pairs of different axes
    return form


def calibrate(
    summary: HoldSummary,
    *,
    pose: str,
    body_frame: str,
    created: str,
    heading_offset: ArrayLike | None = None,
    metadata: Mapping[str, Any] | None = None,
    filter: str = "none",
    north: bool = True,
    height_m: float | None = None,
) -> Calibration:
    """Compute the calibration (DIP 4.2, eq. 6 and 7) from a checked hold of a known pose.

    Args:
        summary: result of `check_hold`.
        pose: key of POSES that the wearer held.
        body_frame: see `body_from_inertial`.
        created: ISO 8601 time to store.
        heading_offset: (N,) of a `HeadingReset`, rad; None if all sensors share a north.
        metadata: JSON values to store.
        filter: filter that computed the orientations, one of `edgepose.imu.FILTERS`.
        north: whether all headings count from one north.
        height_m: the wearer's height, metres, if known.

    Raises:
        CalibrationError: no such pose, or the body frame needs a sensor that the rig lacks.
    """
    if pose not in POSES:
        raise CalibrationError(f"pose {pose!r} is none of: {', '.join(POSES)}")
    names = list(summary.names)
    offset = np.zeros(len(names)) if heading_offset is None else np.asarray(heading_offset, float)
    orientation = rot.quat_multiply(rot.quat_about_z(offset), summary.orientation)
    r_ti = body_from_inertial(orientation, body_frame, names)
    held = np.stack([held_bone(pose, name) for name in names])
    r_bs = rot.matrix_to_quat(rot.transpose(held) @ (r_ti @ rot.quat_to_matrix(orientation)))
    six = [names.index(name) if name in names else None for name in PLACEMENTS]
    added = [i for i, name in enumerate(names) if name not in PLACEMENTS]
    return Calibration(
        rot.matrix_to_quat(r_ti),
        np.array([0.0 if i is None else offset[i] for i in six]),
        np.stack([_IDENTITY if i is None else r_bs[i] for i in six]),
        np.array([0.0 if i is None else summary.spread_deg[i] for i in six]),
        pose,
        body_frame,
        created,
        dict(metadata or {}),
        filter,
        north,
        height_m,
        AddedSensors([names[i] for i in added], offset[added], r_bs[added], summary.spread_deg[added]),
        [name for name in PLACEMENTS if name not in names],
    )


def added_bones(calibration: Calibration, orientation: Array) -> Array:
    """Return R_TB (A, 3, 3) of the added sensors from quaternions (A, 4), as measured.

    Bones of sensors whose heading is unknown are NaN.
    """
    left, right = calibration._added_maps
    bones: Array = left @ rot.quat_to_matrix(orientation) @ right
    return bones


def apply_calibration(
    calibration: Calibration, orientation: ArrayLike, force: ArrayLike
) -> tuple[Array, Array]:
    """Compute bones and accelerations in the body frame (DIP 4.2, SIP eq. 13), for any leading dimensions.

    R_TB = R_TI R_IS inv(R_BS). DIP prints eq. 8 as R_BS R_TS, which would not reproduce R_TB0 at the
    calibration instant. a_T = R_TI (f_I + g_I), zero at rest.

    Args:
        calibration: of this rig.
        orientation: (..., 6, 4) unit quaternions, sensor to inertial, as measured: headings are reset here.
        force: (..., 6, 3) specific force, rotated to the inertial frame by the same quaternions, m/s^2.

    Returns:
        (..., 6, 3, 3) R_TB and (..., 6, 3) a_T, m/s^2.
    """
    bones, to_body, gravity = calibration._maps
    q, f = np.asarray(orientation, float), np.asarray(force, float)
    # A rotation matrix is quadratic in its quaternion, so all constant rotations fold into one product. That
    # takes a fifth of the time of a conversion followed by two products.
    squares = (q[..., :, None] * q[..., None, :]).reshape(*q.shape[:-1], 1, 16)
    r_tb = (squares @ bones).reshape(*q.shape[:-1], 3, 3)
    return r_tb, (f[..., None, :] @ to_body)[..., 0, :] + gravity
