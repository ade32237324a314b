"""Choice of the magnetic fields that are good enough to take a heading from."""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, degrees, hypot, tan

from edgepose.orientation.settings import FilterSettings


class _Field:
    """Averaged strength and dip of a field."""

    def __init__(self, norm: float, dip: float) -> None:
        self.norm, self.dip = norm, dip
        self.time_s = 0.0

    def follow(self, norm: float, dip: float, duration_s: float, longest_s: float) -> None:
        self.time_s += duration_s
        share = duration_s / min(self.time_s, longest_s)
        self.norm += share * (norm - self.norm)
        self.dip += share * (dip - self.dip)


class MagneticReference:
    """Learns the usual field, detects disturbances, and adopts a new field as the usual one if it lasts.

    Attributes:
        disturbed: whether the field of the last block is not the usual one.
        adopted: whether the usual field was replaced in the last block.
    """

    def __init__(self, settings: FilterSettings) -> None:
        """Start with no field seen."""
        self.disturbed = self.adopted = False
        self._settings = settings
        self._usual: _Field | None = None
        self._other = _Field(0.0, 0.0)
        self._good_s = settings.mag_good_s
        self._rejected_s = 0.0
        self._settled = False

    def heading(
        self, field: Sequence[float], duration_s: float, rate: float, tilt_var: float
    ) -> tuple[float, float] | None:
        """Return the heading error, rad, shown by a block's mean field, and its variance; None if not usable.

        Args:
            field: rotated to the inertial frame by the current orientation.
            duration_s: since the last field.
            rate: mean magnitude of the rotation, rad/s.
            tilt_var: variance of the current tilt about one axis, rad^2.
        """
        s = self._settings
        x, y, z = field
        level = hypot(x, y)
        norm, dip = hypot(level, z), atan2(-z, level)
        usual = self._usual
        # At first the tilt, and with it the dip, may be too wrong to tell one field from another.
        self._settled |= usual is not None and usual.time_s >= s.mag_first_s
        if usual is None or not (self._settled or self._is_like(usual, norm, dip)):
            usual = self._usual = _Field(norm, dip)
        if self._is_like(usual, norm, dip):
            self._good_s += duration_s
            self.disturbed = self._good_s < s.mag_good_s
            if not self.disturbed:
                usual.follow(norm, dip, duration_s, s.mag_reference_s)
        else:
            self._good_s, self.disturbed = 0.0, True
        usual = self._usual = self._follow_other(usual, norm, dip, duration_s, rate)
        if self.disturbed:
            self._rejected_s = min(self._rejected_s + duration_s, s.mag_reject_s)
            if self._rejected_s < s.mag_reject_s:
                return None
        else:
            self._rejected_s = max(self._rejected_s - duration_s, 0.0)
        soft = 1.0
        if self._settled:
            percent = 100.0 * (norm / usual.norm - 1.0)
            soft += s.mag_soft * (percent**2 + degrees(dip - usual.dip) ** 2)
        # Field errors are correlated for a long time, so many fields tell little more than one.
        repeats = max(1.0, s.mag_time / duration_s)
        return atan2(x, y), s.mag_heading**2 * repeats * soft + tilt_var * tan(dip) ** 2

    def _follow_other(self, usual: _Field, norm: float, dip: float, duration_s: float, rate: float) -> _Field:
        """Follow the current field, which becomes the usual one if it lasts; return the usual one."""
        s = self._settings
        if not self._is_like(self._other, norm, dip):
            self._other = _Field(norm, dip)
        elif rate >= s.mag_new_rate:
            # Only while turning: a sensor that lies beside a magnet sees the same field for ever.
            self._other.follow(norm, dip, duration_s, s.mag_reference_s)
        self.adopted = self.disturbed and self._other.time_s >= s.mag_new_s
        if self.adopted:
            usual, self._other = self._other, _Field(norm, dip)
            self._good_s, self.disturbed, self._rejected_s = s.mag_good_s, False, 0.0
        return usual

    def _is_like(self, field: _Field, norm: float, dip: float) -> bool:
        s = self._settings
        return abs(norm - field.norm) < s.mag_norm * field.norm and abs(dip - field.dip) < s.mag_dip
