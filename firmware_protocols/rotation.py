"""Conversions between representations of rotations; quaternions are w, x, y, z, sensor to inertial."""

from __future__ import annotations

from math import atan2, cos, hypot, pi, remainder, sin, sqrt, tau

from firmware_protocols.sample import Quaternion, Vector3, unit_quaternion

_MAX_ANGLE = 7.0  # slightly more than a full turn, radians


def from_yaw_pitch_roll(yaw: float, pitch: float, roll: float) -> Quaternion:
    """Return the quaternion of Rz(yaw) Ry(pitch) Rx(roll), radians."""
    cy, sy = cos(yaw / 2), sin(yaw / 2)
    cp, sp = cos(pitch / 2), sin(pitch / 2)
    cr, sr = cos(roll / 2), sin(roll / 2)
    return (
        cy * cp * cr + sy * sp * sr,
        cy * cp * sr - sy * sp * cr,
        cy * sp * cr + sy * cp * sr,
        sy * cp * cr - cy * sp * sr,
    )


def from_angles(yaw: float, pitch: float, roll: float) -> Quaternion | None:
    """Do the same as `from_yaw_pitch_roll`, but return None for NaN and for angles that no device sends."""
    if not abs(yaw) <= _MAX_ANGLE or not abs(pitch) <= _MAX_ANGLE or not abs(roll) <= _MAX_ANGLE:
        return None
    return from_yaw_pitch_roll(yaw, pitch, roll)


def to_yaw_pitch_roll(quat: Quaternion) -> Vector3:
    """Return yaw, pitch and roll of a quaternion: pitch from -pi/2 to pi/2, the others from -pi to pi."""
    w, x, y, z = quat
    # Half the sum and half the difference of yaw and roll. With x vertical, one of them is arbitrary and
    # cancels.
    half_sum, half_difference = atan2(z + x, w - y), atan2(z - x, w + y)
    return (
        remainder(half_sum + half_difference, tau),
        pi / 2 - 2 * atan2(hypot(w - y, z + x), hypot(w + y, z - x)),
        remainder(half_sum - half_difference, tau),
    )


def from_matrix(m: tuple[float, ...], tolerance: float = 0.1) -> Quaternion | None:
    """Return the quaternion of a rotation matrix, given row by row; None if it is not a rotation.

    Its rows have to be orthonormal, within the tolerance, and right-handed.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = m
    errors = (
        xx * xx + xy * xy + xz * xz - 1,
        yx * yx + yy * yy + yz * yz - 1,
        zx * zx + zy * zy + zz * zz - 1,
        xx * yx + xy * yy + xz * yz,
        yx * zx + yy * zy + yz * zz,
        zx * xx + zy * xy + zz * xz,
    )
    det = xx * (yy * zz - yz * zy) - xy * (yx * zz - yz * zx) + xz * (yx * zy - yy * zx)
    if not all(-tolerance <= value <= tolerance for value in errors) or not det > 0:  # NaN compares false
        return None
    # The largest of the four (each is 4 times a square) is at least 1: no division by small numbers.
    squares = (1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz)
    largest = max(squares)
    s = 2 * sqrt(largest)
    if largest == squares[0]:
        quat = (s / 4, (zy - yz) / s, (xz - zx) / s, (yx - xy) / s)
    elif largest == squares[1]:
        quat = ((zy - yz) / s, s / 4, (xy + yx) / s, (xz + zx) / s)
    elif largest == squares[2]:
        quat = ((xz - zx) / s, (xy + yx) / s, s / 4, (yz + zy) / s)
    else:
        quat = ((yx - xy) / s, (xz + zx) / s, (yz + zy) / s, s / 4)
    return unit_quaternion(*quat)


def rotate(quat: Quaternion, v: Vector3) -> Vector3:
    """Return a vector of the sensor frame in the inertial frame."""
    w, x, y, z = quat
    a, b, c = v
    # v + 2 u x (u x v + w v) with u the vector part
    p, q, r = y * c - z * b + w * a, z * a - x * c + w * b, x * b - y * a + w * c
    return (a + 2 * (y * r - z * q), b + 2 * (z * p - x * r), c + 2 * (x * q - y * p))


def rotate_back(quat: Quaternion, v: Vector3) -> Vector3:
    """Return a vector of the inertial frame in the sensor frame."""
    w, x, y, z = quat
    return rotate((w, -x, -y, -z), v)
