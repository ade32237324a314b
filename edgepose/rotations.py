"""Rotation arithmetic on numpy arrays with any leading dimensions.

Quaternions are w, x, y, z. `R_AB` maps vectors from frame B to frame A: `v_A = R_AB @ v_B`. Angles are
radians.
"""

from __future__ import annotations

import math
from math import cos, sin, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def _unit(v: Array) -> Array:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


# --- quaternions --------------------------------------------------------------------------------------------


def quat_multiply(p: ArrayLike, q: ArrayLike) -> Array:
    """Hamilton product (..., 4): the rotation q followed by p."""
    pw, px, py, pz = np.moveaxis(np.asarray(p, float), -1, 0)
    qw, qx, qy, qz = np.moveaxis(np.asarray(q, float), -1, 0)
    return np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def quat_conjugate(q: ArrayLike) -> Array:
    """Inverse of unit quaternions (..., 4)."""
    return np.asarray(q, float) * np.array([1.0, -1.0, -1.0, -1.0])


def quat_rotate(q: ArrayLike, v: ArrayLike) -> Array:
    """Rotate vectors (..., 3) by unit quaternions (..., 4)."""
    q, v = np.asarray(q, float), np.asarray(v, float)
    u = q[..., 1:]
    t = 2.0 * np.cross(u, v)
    return v + q[..., :1] * t + np.cross(u, t)


def integrate_rotvec(q: tuple[float, ...], x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Rotate unit quaternion q (4,) by an axis-angle vector in its own frame, radians.

    Uses plain floats: in loops over single samples, arrays take twenty times longer.
    """
    angle = sqrt(x * x + y * y + z * z)
    half = sin(0.5 * angle) / angle if angle > 1e-9 else 0.5
    a, b, c, d = cos(0.5 * angle), half * x, half * y, half * z
    w, i, j, k = q
    return (
        w * a - i * b - j * c - k * d,
        w * b + i * a + j * d - k * c,
        w * c - i * d + j * a + k * b,
        w * d + i * c - j * b + k * a,
    )


def quat_continuous(q: ArrayLike) -> Array:
    """Flip signs of quaternions (T, ..., 4) so that successive ones are close; rotations stay the same."""
    q = np.asarray(q, float)
    flips = np.cumprod(np.where(np.sum(q[1:] * q[:-1], axis=-1, keepdims=True) < 0, -1.0, 1.0), axis=0)
    return np.concatenate([q[:1], q[1:] * flips])


def quat_near(q: ArrayLike, others: ArrayLike) -> Array:
    """Flip signs of quaternions (..., 4) so that they are close to others; rotations stay the same."""
    q, others = np.asarray(q, float), np.asarray(others, float)
    return np.where((q * others).sum(axis=-1, keepdims=True) < 0.0, -q, q)


def slerp(q0: ArrayLike, q1: ArrayLike, t: ArrayLike) -> Array:
    """Interpolate on the sphere from q0 (..., 4) at t = 0 to q1 at t = 1, along the shorter arc.

    t broadcasts over (...).
    """
    q0 = np.asarray(q0, float)
    return quat_multiply(
        q0,
        rotvec_to_quat(
            quat_to_rotvec(quat_multiply(quat_conjugate(q0), q1)) * np.asarray(t, float)[..., None]
        ),
    )


def mean_rotation(quats: ArrayLike) -> Array:
    """Mean unit quaternion (4,) of (N, 4): eigenvector of the sum of outer products (Markley 2007)."""
    q = np.asarray(quats, float)
    mean: Array = np.linalg.eigh(q.T @ q)[1][:, -1]
    return mean if mean[0] >= 0 else -mean


def angle_between_quats(a: Array, b: Array) -> Array:
    """Angles (...) between unit quaternions (..., 4), from 0 to pi."""
    return np.asarray(2.0 * np.arccos(np.minimum(np.abs(np.sum(a * b, axis=-1)), 1.0)))


def yaw_of_quat(q: ArrayLike) -> Array:
    """Angle (...) of the rotation about Z, up, in unit quaternions (..., 4) (swing-twist decomposition)."""
    q = np.asarray(q, float)
    return 2.0 * np.arctan2(q[..., 3], q[..., 0])


def tilt_of_quat(q: ArrayLike) -> Array:
    """Angle (...), from 0 to pi, by which unit quaternions (..., 4) tilt Z, up."""
    q = np.asarray(q, float)
    tilt: Array = 2.0 * np.arctan2(np.hypot(q[..., 1], q[..., 2]), np.hypot(q[..., 0], q[..., 3]))
    return tilt


def yaw_of_matrix(r: ArrayLike) -> Array:
    """Angle (...), radians, of the rotation about Y, up in T, in rotation matrices (..., 3, 3)."""
    r = np.asarray(r, float)
    angle: Array = np.arctan2(r[..., 0, 2] - r[..., 2, 0], r[..., 0, 0] + r[..., 2, 2])
    return angle


def quat_about_z(angle: ArrayLike) -> Array:
    """Unit quaternions (..., 4) of rotations about Z."""
    half = np.asarray(angle, float) / 2.0
    zero = np.zeros_like(half)
    return np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1)


def wrapped(angle: ArrayLike) -> Array:
    """Angles (...) from -pi to pi that differ from the given ones by whole turns."""
    result: Array = np.arctan2(np.sin(angle), np.cos(angle))
    return result


# --- conversions --------------------------------------------------------------------------------------------


def quat_to_matrix(q: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    c = np.moveaxis(np.asarray(q, float), -1, 0)
    w, x, y, z = c
    x2, y2, z2 = x + x, y + y, z + z
    wx, wy, wz = w * x2, w * y2, w * z2
    xx, xy, xz = x * x2, x * y2, x * z2
    yy, yz, zz = y * y2, y * z2, z * z2
    result = np.empty((*c.shape[1:], 3, 3))
    result[..., 0, 0], result[..., 0, 1], result[..., 0, 2] = 1.0 - (yy + zz), xy - wz, xz + wy
    result[..., 1, 0], result[..., 1, 1], result[..., 1, 2] = xy + wz, 1.0 - (xx + zz), yz - wx
    result[..., 2, 0], result[..., 2, 1], result[..., 2, 2] = xz - wy, yz + wx, 1.0 - (xx + yy)
    return result


def _four_outer(r: Array) -> Array:
    """4 q q^T (..., 4, 4) of the quaternions q of rotations (..., 3, 3)."""
    m = {(i, j): r[..., i, j] for i in range(3) for j in range(3)}
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    return np.stack(
        [
            np.stack([1 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]], -1),
            np.stack([m[2, 1] - m[1, 2], 1 + 2 * m[0, 0] - trace, m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]], -1),
            np.stack([m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], 1 + 2 * m[1, 1] - trace, m[1, 2] + m[2, 1]], -1),
            np.stack([m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1 + 2 * m[2, 2] - trace], -1),
        ],
        axis=-2,
    )


# `_four_outer` as a matrix product, in half the time: apart from the ones on its diagonal it is linear.
_ONES = np.eye(4).ravel()
_BY_ENTRY = _four_outer(np.eye(9).reshape(9, 3, 3)).reshape(9, 16) - _ONES


def matrix_to_quat(r: ArrayLike) -> Array:
    """Unit quaternions (..., 4), w >= 0, of rotations (..., 3, 3); stable everywhere (Shepperd 1978)."""
    r = np.asarray(r, float)
    outer = r.reshape(-1, 9) @ _BY_ENTRY
    outer += _ONES
    # The row with the largest diagonal has the least rounding error.
    best = outer[:, ::5].argmax(1)
    q: Array = outer.reshape(-1, 4, 4)[np.arange(len(best)), best]
    # Of norm 1, and with a first number that is not negative.
    q /= np.where(q[:, :1] < 0, -1.0, 1.0) * np.sqrt(np.einsum("ij,ij->i", q, q))[:, None]
    return q.reshape(*r.shape[:-2], 4)


def rotvec_to_quat(v: ArrayLike) -> Array:
    """Unit quaternions (..., 4) of axis-angle vectors (..., 3), radians."""
    v = np.asarray(v, float)
    angle = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * v], axis=-1)


def quat_to_rotvec(q: ArrayLike) -> Array:
    """Axis-angle vectors (..., 3) of unit quaternions (..., 4); angles from 0 to pi."""
    q = np.asarray(q, float)
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    small = sine < 1e-12
    return q[..., 1:] * np.where(small, 2.0, angle / np.where(small, 1.0, sine))


def rotvec_to_matrix(v: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of axis-angle vectors (..., 3)."""
    return quat_to_matrix(rotvec_to_quat(v))


def matrix_to_rotvec(r: ArrayLike) -> Array:
    """Axis-angle vectors (..., 3) of rotation matrices (..., 3, 3)."""
    return quat_to_rotvec(matrix_to_quat(r))


def rotation_about_axis(axis: str, angle: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) about one coordinate axis, "x", "y" or "z"."""
    direction = np.zeros(3)
    direction["xyz".index(axis)] = 1.0
    return rotvec_to_matrix(np.asarray(angle, float)[..., None] * direction)


Z_UP_TO_T = rotation_about_axis("x", -np.pi / 2)
"""Rotation from a world frame with Z up, such as that of AMASS, to the body frame T with Y up."""


def euler_to_matrix(angles: ArrayLike, order: str) -> Array:
    """Rotation matrices (..., 3, 3) of Euler angles (..., len(order)); order "zyx" is Rz Ry Rx."""
    angles = np.asarray(angles, float)
    result = rotation_about_axis(order[0], angles[..., 0])
    for i, axis in enumerate(order[1:], start=1):
        result = result @ rotation_about_axis(axis, angles[..., i])
    return result


def matrix_to_euler_zxy(r: ArrayLike) -> Array:
    """Angles (..., 3) about z, x, y, radians, of rotation matrices (..., 3, 3) = Rz Rx Ry; |x| <= pi/2."""
    r = np.asarray(r, float)
    z = np.arctan2(-r[..., 0, 1], r[..., 1, 1])
    c, s = np.cos(z), np.sin(z)
    # Rx Ry remains after removing z. Taking x and y from it instead of from R stays exact near x = +-pi/2,
    # where z alone is ill-defined.
    x = np.arctan2(r[..., 2, 1], c * r[..., 1, 1] - s * r[..., 0, 1])
    y = np.arctan2(c * r[..., 0, 2] + s * r[..., 1, 2], c * r[..., 0, 0] + s * r[..., 1, 0])
    return np.stack([z, x, y], axis=-1)


# --- matrices -----------------------------------------------------------------------------------------------


def transpose(r: Array) -> Array:
    """Inverse of rotation matrices (..., 3, 3)."""
    return np.swapaxes(r, -1, -2)


def geodesic_angle(a: ArrayLike, b: ArrayLike) -> Array:
    """Geodesic distance (...) between rotation matrices (..., 3, 3), from 0 to pi."""
    # The chord ||A - B||_F = 2 sqrt(2) sin(angle / 2) keeps its precision at small angles, where arccos of
    # the trace does not.
    chord = np.linalg.norm(np.asarray(a, float) - np.asarray(b, float), axis=(-2, -1))
    return 2.0 * np.arcsin(np.clip(chord / np.sqrt(8.0), 0.0, 1.0))


def nearest_rotation(m: ArrayLike) -> Array:
    """Nearest rotation matrices (..., 3, 3), determinant +1, to any matrices in the Frobenius norm (SVD)."""
    u, _, vt = np.linalg.svd(np.asarray(m, float))
    u[..., :, -1] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt


def minimal_rotation(a: ArrayLike, b: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) with the smallest angle that rotate directions a (..., 3) to b.

    Raises:
        ValueError: a and b point in opposite directions, so that the smallest rotation is not unique.
    """
    a, b = _unit(np.asarray(a, float)), _unit(np.asarray(b, float))
    w = 1.0 + np.sum(a * b, axis=-1, keepdims=True)
    if np.any(w < 1e-9):
        raise ValueError("directions are opposite: the smallest rotation between them is not unique")
    return quat_to_matrix(_unit(np.concatenate([w, np.cross(a, b)], axis=-1)))


# --- derivatives --------------------------------------------------------------------------------------------


def cross_matrix(v: ArrayLike) -> Array:
    """Matrices (..., 3, 3) of the map w -> v x w, for vectors v (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(v, float), -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def left_jacobian(v: ArrayLike) -> Array:
    """Matrices J (..., 3, 3) with exp(v + d) = exp(J d) exp(v) for small d; axis-angle vectors v (..., 3)."""
    v = np.asarray(v, float)
    square = np.sum(v * v, axis=-1)[..., None, None]
    angle = np.sqrt(square)
    small = angle < 1e-3  # the quotients lose digits there; two terms of each series suffice
    safe = np.where(small, 1.0, square)
    a = np.where(small, 0.5 - square / 24.0, (1.0 - np.cos(angle)) / safe)
    b = np.where(small, 1.0 / 6.0 - square / 120.0, (1.0 - np.sinc(angle / np.pi)) / safe)
    k = cross_matrix(v)
    return np.eye(3) + a * k + b * (k @ k)


def inverse_left_jacobian(v: ArrayLike) -> Array:
    """Inverse (..., 3, 3) of `left_jacobian`, for angles below 2 pi."""
    v = np.asarray(v, float)
    square = np.sum(v * v, axis=-1)[..., None, None]
    half = 0.5 * np.sqrt(square)
    small = half < 5e-3
    safe = np.where(small, 1.0, half)
    # 1 - half / tan(half), over the angle squared
    b = np.where(
        small, 1.0 / 12.0 + square / 720.0, (1.0 - safe / np.tan(safe)) / np.where(small, 1.0, square)
    )
    k = cross_matrix(v)
    return np.eye(3) - 0.5 * k + b * (k @ k)


def tilt_deg(v: Array) -> float:
    """Angle between a vector (3,) in I and the vertical, degrees."""
    return math.degrees(math.atan2(math.hypot(v[0], v[1]), v[2]))
