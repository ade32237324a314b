"""A sensor with known motion."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from edgepose import rotations as rot
from firmware_protocols.sample import STANDARD_G


class Simulated(NamedTuple):
    """What a sensor measures, and the truth."""

    time_s: np.ndarray
    gyr: np.ndarray
    acc: np.ndarray
    mag: np.ndarray
    quat: np.ndarray
    bias: np.ndarray

    @property
    def measured(self):
        return self[:4]

    def rows(self, chosen):
        return Simulated(*(column[chosen] for column in self[:5]), self.bias)


def simulate(times, seed=0, turn=2.0, speed=0.3, still=(), bias=0.5, push=None, noise=1.0):
    """Sums of sines for the rate (turn, rad/s) and the velocity (speed, m/s).

    No motion in the stretches `still`; `bias` in deg/s; push (from, to, m/s^2) is added along X. The field is
    20 uT to the north (Y) and 44 uT down. A rate or force is the mean since the sample before.
    """
    times = np.asarray(times, float)
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.2, 1.5, (6, 5)), rng.uniform(0, 2 * np.pi, (6, 5))
    size = rng.normal(size=(6, 5)) / np.sqrt(5)

    def waves(t, which):
        argument = 2 * np.pi * frequency[which, :, None] * t + phase[which, :, None]
        moving = np.ones_like(t)
        for start, end in still:
            moving *= 1 - np.clip(np.minimum((t - start) / 0.3 + 1, (end - t) / 0.3 + 1), 0, 1)
        return ((size[which, :, None] * np.sin(argument)).sum(1) * moving).T

    parts = 8
    grid = np.concatenate([times[:1], *np.linspace(times[:-1], times[1:], parts + 1)[1:].T])
    steps = turn * waves((grid[1:] + grid[:-1]) / 2, slice(0, 3)) * np.diff(grid)[:, None]
    quats = [tuple(rot.rotvec_to_quat([0.4, -0.8, 0.0]).tolist())]
    for step in steps.tolist():
        quats.append(rot.integrate_rotvec(quats[-1], *step))
    quat = np.array(quats)[::parts]
    velocity = speed * waves(times, slice(3, 6))
    if push:
        start, end, acceleration = push
        velocity[:, 0] += acceleration * np.clip(times - start, 0, end - start)
    dt = np.diff(times)[:, None]
    gyr = rot.quat_to_rotvec(rot.quat_multiply(rot.quat_conjugate(quat[:-1]), quat[1:])) / dt
    middle = quat[:-1] + quat[1:]
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    acc = rot.quat_rotate(rot.quat_conjugate(middle), np.diff(velocity, axis=0) / dt + [0, 0, STANDARD_G])
    mag = rot.quat_rotate(rot.quat_conjugate(quat[1:]), np.array([0.0, 20.0, -44.0]))
    offset = np.deg2rad(bias) * np.array([1.0, -0.7, 0.5])
    gyr += offset + noise * rng.normal(size=gyr.shape) * np.deg2rad(0.01) / np.sqrt(dt)
    acc += noise * rng.normal(size=acc.shape) * 0.002 / np.sqrt(dt)
    mag += noise * rng.normal(size=mag.shape) * 0.3
    return Simulated(times[1:], gyr, acc, mag, quat[1:], offset)


def angles(quat, truth):
    """Total angle and inclination, deg."""
    error = rot.quat_multiply(quat, rot.quat_conjugate(truth))
    total = 2 * np.arctan2(np.linalg.norm(error[:, 1:], axis=1), np.abs(error[:, 0]))
    inclination = 2 * np.arctan2(np.hypot(error[:, 1], error[:, 2]), np.hypot(error[:, 0], error[:, 3]))
    return np.rad2deg(total), np.rad2deg(inclination)


@pytest.fixture(scope="session", name="simulate")
def simulate_fixture():
    return simulate


@pytest.fixture(scope="session", name="angles")
def angles_fixture():
    return angles


@pytest.fixture(scope="session")
def worn():
    """40 s at 100 Hz, the first 4 s at rest."""
    return simulate(np.arange(0, 40, 0.01), seed=1, still=[(0, 4)])
