"""Output as a stream of the Lab Streaming Layer, which laboratories record beside EEG, EMG or eye trackers.

Needs pylsl. Unlike all other outputs it answers anyone in the network who looks for streams.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.formats.poses.csv_columns import pose_columns
from edgepose.pose import PoseFrame, held_bits, place_values
from edgepose.rotations import quat_near
from edgepose.sinks.base import Sink, SinkContext
from edgepose.sinks.shared_numbers import quats
from edgepose.skeleton import JOINTS

Array = NDArray[np.float64]

BUFFER_S = 60
"""Seconds of poses that are kept for a receiver that reads too slowly; it misses those before."""

_TYPES = {"w": "OrientationA", "x": "OrientationB", "y": "OrientationC", "z": "OrientationD"}
_CONFIGURATIONS = ("lsl_api.cfg", "~/lsl_api/lsl_api.cfg", "/etc/lsl_api/lsl_api.cfg")


def channels(translation: bool, contacts: bool) -> list[tuple[str, str, str]]:
    """Return label, type and unit of each channel, as XDF recommends them for motion capture.

    Args:
        translation: there are channels for the position of the pelvis.
        contacts: there are channels for contacts.
    """
    found = []
    for label in pose_columns("quat", False, translation, contacts)[3:]:
        joint, _, axis = label.rpartition("_")
        if joint == "trans":
            found.append((label, f"Position{axis.upper()}", "meters"))
        elif joint in JOINTS:
            found.append((label, _TYPES[axis], "normalized"))
        else:
            found.append((label, "Confidence", "normalized"))
    return [*found, ("held", "Held", "bits"), ("filling", "Filling", "flag")]


class LslSink(Sink):
    """Offers poses as a stream; each has the time at which it was measured, on the clock of the receivers."""

    live = True

    def __init__(
        self,
        name: str,
        rate: float = 60.0,
        translation: bool = False,
        contacts: bool = False,
        clock: Callable[[], float] | None = None,
        model: str = "",
    ) -> None:
        """Open the stream.

        Args:
            name: name of the stream.
            rate: poses per second.
            translation: add the position of the pelvis, metres, which every pose must then have.
            contacts: add the probabilities of contact, which every pose must then have.
            clock: see `SinkContext`.
            model: the model that makes the poses, for the description of the stream.

        Raises:
            EdgeposeError: pylsl or its library is not installed, or the stream cannot be opened.
        """
        pylsl = _pylsl()
        self._translation, self._contacts, self._local_clock = translation, contacts, pylsl.local_clock
        self._ahead_s = None if clock is None else pylsl.local_clock() - clock()
        self._quats: Array = np.zeros((len(JOINTS), 4))
        described = channels(translation, contacts)
        source = f"edgepose {socket.gethostname()} {name}"  # a receiver finds it again after a restart
        info = pylsl.StreamInfo(name, "MoCap", len(described), rate, "float32", source)
        labels, types, units = map(list, zip(*described, strict=True))
        info.set_channel_labels(labels)
        info.set_channel_types(types)
        info.set_channel_units(units)
        acquisition = info.desc().append_child("acquisition")
        acquisition.append_child_value("manufacturer", "edgepose")
        acquisition.append_child_value("model", model)
        try:
            self._outlet: Any = pylsl.StreamOutlet(info, max_buffered=BUFFER_S)
        except Exception as error:  # the library raises various kinds
            raise EdgeposeError(f"cannot open the LSL stream {name!r}: {error}") from error

    def write(self, pose: PoseFrame) -> None:
        """Send a pose."""
        if self._ahead_s is None:  # a recording, which begins now
            self._ahead_s = self._local_clock() - pose.time_s
        # Receivers that interpolate the numbers would turn a joint round where signs change.
        self._quats = quat_near(quats(pose), self._quats)
        values = self._quats.ravel().tolist()
        values += place_values(pose, self._translation, self._contacts)
        self._outlet.push_sample(
            [*values, held_bits(pose.held), pose.warming_up], pose.time_s + self._ahead_s
        )

    def close(self) -> None:
        """Close the stream; a second call does nothing."""
        self._outlet = None  # which the library closes then


def _pylsl() -> Any:
    """Import pylsl, without the messages of its library unless the user has configured it.

    Raises:
        EdgeposeError: it is not installed, or comes without its library.
    """
    try:
        import pylsl
    except ImportError as error:
        raise EdgeposeError("--lsl needs pylsl: install it with pip install 'edgepose[lsl]'") from error
    except RuntimeError as error:
        raise EdgeposeError(
            "--lsl needs the library liblsl, which pylsl does not bring along on this machine: install it, "
            "and name it in the environment variable PYLSL_LIB"
        ) from error
    if "LSLAPICFG" not in os.environ and not any(
        Path(name).expanduser().exists() for name in _CONFIGURATIONS
    ):
        pylsl.set_config_content("[log]\nlevel = -2\n")
    return pylsl


def open_sink(target: str, context: SinkContext) -> Sink:
    """Open an `LslSink` of this name."""
    return LslSink(
        *(target, context.rate, context.translation, context.contacts),
        clock=context.clock,
        model=context.about.get("model", ""),
    )
