"""Recordings of Xsens MVN, exported as MVNX: XML with one element for each frame.

`<subject frameRate>` has `<sensors>`, each a `<sensor label>`, then `<frames>`. Frames of the type "normal"
are the recording; the others are poses of the calibration. A frame has its `time` in milliseconds and lists
of numbers of all sensors in the order of the labels: `sensorOrientation` (quaternions w x y z, sensor to
global), `sensorFreeAcceleration` (without gravity, global frame, m/s^2), or in old versions
`sensorAcceleration` (with gravity, sensor frame) and `sensorAngularVelocity` (rad/s), and
`sensorMagneticField` (1 is about the earth's field). In the global frame Z is up, and X points north or to
where the wearer looked during calibration.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from functools import partial
from itertools import chain
from math import isfinite
from pathlib import Path
from typing import Any
from xml.parsers import expat

from edgepose.errors import EdgeposeError, FileFormatError
from edgepose.formats.recordings.base import RecordingFormat, recording_from_samples
from edgepose.imu import GRAVITY, ImuSample, Recording
from firmware_protocols.rotation import rotate_back
from firmware_protocols.sample import unit_quaternion

LABELS = (
    "LeftForeArm", "RightForeArm", "LeftLowerLeg", "RightLowerLeg", "Head", "Pelvis", "T8",
    "LeftShoulder", "RightShoulder", "LeftUpperArm", "RightUpperArm", "LeftHand", "RightHand",
    "LeftUpperLeg", "RightUpperLeg", "LeftFoot", "RightFoot",
)  # fmt: skip
"""MVN's names of SENSORS, in their order; that on the breastbone is called T8."""

_WIDTHS = {
    "sensorOrientation": 4,
    "sensorFreeAcceleration": 3,
    "sensorAcceleration": 3,
    "sensorAngularVelocity": 3,
    "sensorMagneticField": 3,
}
_EXTRAS = ("sensorAngularVelocity", "sensorMagneticField")  # a frame is usable without them
_METADATA = {
    "frame": "Z up",
    "units": "s, m/s^2, rad/s; mag in units of the earth's field",
    "source": "MVNX",
}
_CHUNK = 1 << 16
_LONGEST = 1 << 20  # bytes of one tag or list of numbers; MVN writes fewer than 4000
_DEEPEST = 50  # nested elements; MVN writes 6
_MOST_SENSORS = 100


def read_mvnx(path: Path) -> Recording:
    """Read a recording of the sensors, as far as the file has them.

    Raises:
        FileFormatError: it cannot be read, is not MVNX, or has none of the sensors.
    """
    frames = _Frames(path)
    problems: list[str] = []
    recording = recording_from_samples(_samples(path, frames, problems), name=str(path), salvage=True)
    problems += [recording.damage] if recording.damage else []
    metadata = {"rate": f"{frames.rate:g}", **_METADATA}
    return recording._replace(metadata=metadata, damage="; ".join(problems) or None)


def _samples(path: Path, frames: _Frames, problems: list[str]) -> Iterator[ImuSample]:
    """Yield the samples of all frames; add problems of the file to `problems`."""
    try:
        with path.open("rb") as file:
            for chunk in chain(iter(partial(file.read, _CHUNK), b""), [b""]):
                broken = frames.feed(chunk)
                yield from frames.take()
                if broken:
                    break
    except OSError as error:
        raise FileFormatError(f"{path}: cannot read it: {error.strerror or error}") from None
    if not frames.count:
        why = broken or "of the type normal"
        raise FileFormatError(f"{path}: no frame of an MVNX recording ({why}); export it from MVN again")
    if frames.bad == frames.count:
        raise FileFormatError(
            f"{path}: no frame has complete lists of its sensors' numbers; export sensorOrientation and "
            "sensorFreeAcceleration too"
        )
    if broken:
        problems.append(
            f"{path}: breaks off ({broken}), the {frames.count} frames before are good; copy the file again"
        )
    if frames.bad:
        problems.append(f"{path}: {frames.bad} bad frames left out")
    for name, count in frames.bad_lists.items():
        problems.append(f"{path}: {count} incomplete {name} left out")


class _Frames:
    """Incremental parser from the bytes of a file to samples; only a part of the file is in memory.

    Attributes:
        rate: frames a second.
        count: number of frames so far.
        bad: number of frames left out.
        bad_lists: number of lists left out, by name, in frames that are usable without them.
    """

    def __init__(self, path: Path) -> None:
        self.rate = 0.0
        self.count = self.bad = 0
        self.bad_lists: Counter[str] = Counter()
        self._path = path
        self._labels: list[str] = []
        self._depth = self._fed = self._length = 0
        self._time_ms: str | None = None  # of the open frame, if it belongs to the recording
        self._texts: dict[str, list[str]] = {}
        self._list: list[str] | None = None  # texts of the open list
        self._samples: list[ImuSample] = []
        self._parser = expat.ParserCreate()
        self._parser.StartDoctypeDeclHandler = self._refuse
        self._parser.StartElementHandler = self._start
        self._parser.CharacterDataHandler = self._text
        self._parser.EndElementHandler = self._end

    def feed(self, chunk: bytes) -> str | None:
        """Parse the next bytes (none at the end of the file); return the problem if parsing has to stop.

        Raises:
            FileFormatError: the file is not MVNX, and there is no frame yet.
        """
        self._fed += len(chunk)
        try:
            self._parser.Parse(chunk, not chunk)
            if self._fed - self._parser.CurrentByteIndex > _LONGEST:
                raise FileFormatError(
                    f"{self._path}: not an MVNX file: it has a tag of more than {_LONGEST} bytes"
                )
        except EdgeposeError as error:
            if not self.count:
                raise
            return str(error).removeprefix(f"{self._path}: ")
        except (expat.ExpatError, LookupError, ValueError) as error:  # the latter two: odd encodings
            return str(error)
        return None

    def take(self) -> list[ImuSample]:
        """Return the samples of the frames completed since the last call."""
        samples, self._samples = self._samples, []
        return samples

    def _refuse(self, *declared: object) -> None:
        # Entities could expand to any size or refer to other files; MVN declares none.
        raise FileFormatError(f"{self._path}: not an MVNX file: it declares a document type")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        if self._depth > _DEEPEST:
            raise FileFormatError(f"{self._path}: not an MVNX file: elements are nested too deeply")
        if name == "subject":
            self.rate = self._rate_of(attributes.get("frameRate", ""))
        elif name == "sensor":
            self._labels.append(attributes.get("label", ""))
            if len(self._labels) > _MOST_SENSORS:
                raise FileFormatError(f"{self._path}: has more than {_MOST_SENSORS} sensors")
        elif name == "frame" and attributes.get("type") == "normal":
            if not self.count:
                self._check()
            self._time_ms, self._texts = attributes.get("time", ""), {}
        elif name in _WIDTHS and self._time_ms is not None:
            self._list = self._texts[name] = []
            self._length = 0

    def _text(self, text: str) -> None:
        if self._list is not None:
            self._length += len(text)
            if self._length > _LONGEST:
                raise FileFormatError(
                    f"{self._path}: not an MVNX file: a list has more than {_LONGEST} characters"
                )
            self._list.append(text)

    def _end(self, name: str) -> None:
        self._depth -= 1
        if name in _WIDTHS:
            self._list = None
        elif name == "frame" and self._time_ms is not None:
            self.count += 1
            try:
                self._samples += self._frame(self._time_ms)
            except (ValueError, OverflowError):
                self.bad += 1
            self._time_ms = None

    def _rate_of(self, text: str) -> float:
        try:
            rate = float(text)
        except ValueError:
            rate = 0.0
        if not 0.1 < rate < 10_000.0:
            raise FileFormatError(
                f"{self._path}: the frame rate {text[:20]!r} of its subject is not possible"
            )
        return rate

    def _check(self) -> None:
        """Raise if the frame rate or the sensors are missing, which must come before the frames."""
        if not self.rate:
            raise FileFormatError(f"{self._path}: has frames, but no subject with a frame rate before them")
        if not any(label in self._labels for label in LABELS):
            found = ", ".join(self._labels)[:200] or "none"
            raise FileFormatError(f"{self._path}: has no sensor called {', '.join(LABELS)} (it has {found})")

    def _frame(self, time_ms: str) -> list[ImuSample]:
        """Return the samples of a frame.

        Raises:
            ValueError, OverflowError: there is no list, or one is incomplete.
        """
        lists: dict[str, list[float]] = {}
        for name, texts in self._texts.items():
            try:
                lists[name] = self._list_of(name, "".join(texts).split())
            except ValueError:
                if name not in _EXTRAS:
                    raise
                self.bad_lists[name] += 1
        if not lists:
            raise ValueError
        # Times are rounded to milliseconds; frames are evenly spaced.
        time_s = round(float(time_ms) * self.rate / 1000.0) / self.rate
        samples = []
        for sensor, label in enumerate(LABELS):
            if label in self._labels:
                at = self._labels.index(label)
                numbers = {
                    name: tuple(values[at * _WIDTHS[name] : (at + 1) * _WIDTHS[name]])
                    for name, values in lists.items()
                }
                samples.append(_sample(sensor, time_s, numbers))
        return samples

    def _list_of(self, name: str, words: list[str]) -> list[float]:
        """Return the numbers of a list; raise ValueError if it is incomplete."""
        if len(words) != _WIDTHS[name] * len(self._labels):
            raise ValueError
        return [float(word) for word in words]


def _sample(sensor: int, time_s: float, numbers: dict[str, Any]) -> ImuSample:
    """Build a sensor's sample from its numbers in a frame."""
    quat, free = numbers.get("sensorOrientation"), numbers.get("sensorFreeAcceleration")
    acc = numbers.get("sensorAcceleration")
    if quat is not None and free is not None:
        unit = unit_quaternion(*quat)  # without one, `recording_from_samples` leaves the sample out
        acc = unit and rotate_back(unit, (free[0], free[1], free[2] + GRAVITY))
    gyr, mag = (
        values if values is not None and all(map(isfinite, values)) else None  # NaN: not measured
        for values in map(numbers.get, _EXTRAS)
    )
    return ImuSample(sensor, time_s, quat, acc, gyr, mag)


FORMAT = RecordingFormat((".mvnx",), lambda path, options: read_mvnx(path))
