"""Writes the DBC files of firmware_protocols, for tools that decode CAN traffic.

python tools/make_dbc.py            # into firmware_protocols/dbc
python tools/make_dbc.py FOLDER
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from firmware_protocols import native_can
from firmware_protocols.native_packet import ACC_SCALE, GYR_SCALE, MAG_SCALE, QUAT_SCALE

DEST = Path(__file__).parents[1] / "firmware_protocols" / "dbc"


class Signal(NamedTuple):
    """An integer of one, two or four bytes in a message.

    Attributes:
        name: name of the signal.
        at: index of its first byte.
        size: number of bytes.
        factor: value of one step.
        unit: unit of the value.
        signed: whether it is in two's complement.
    """

    name: str
    at: int
    size: int = 2
    factor: float = 1
    unit: str = ""
    signed: bool = True


class Message(NamedTuple):
    """A message with an identifier of 11 bits."""

    can_id: int
    name: str
    length: int
    signals: list[Signal]
    comment: str = ""


def vector(name: str, factor: float, unit: str, axes: Sequence[str] = "xyz") -> list[Signal]:
    """Return signals for consecutive int16 from byte 0 on."""
    return [Signal(f"{name}_{axis}", 2 * i, 2, factor, unit) for i, axis in enumerate(axes)]


def number(value: float) -> str:
    """Format a decimal that reads back as the same value."""
    return repr(value) if value != int(value) else str(int(value))


def dbc(about: str, messages: list[Message], big_endian: bool) -> str:
    """Return the text of a DBC file."""
    lines = ['VERSION ""', "", "NS_ :", "", "BS_:", "", "BU_:", ""]
    comments = [f'CM_ "{about}";']
    for message in messages:
        lines.append(f"BO_ {message.can_id} {message.name}: {message.length} Vector__XXX")
        for s in message.signals:
            # Big-endian signals are placed by their highest bit, little-endian ones by their lowest.
            start, order = (8 * s.at + 7, 0) if big_endian else (8 * s.at, 1)
            sign, bits = ("-" if s.signed else "+"), 8 * s.size
            low = -(1 << (bits - 1)) if s.signed else 0
            high = low + (1 << bits) - 1
            lines.append(
                f" SG_ {s.name} : {start}|{bits}@{order}{sign} ({number(s.factor)},0) "
                f'[{number(low * s.factor)}|{number(high * s.factor)}] "{s.unit}" Vector__XXX'
            )
        lines.append("")
        if message.comment:
            comments.append(f'CM_ BO_ {message.can_id} "{message.comment}";')
    return "\n".join([*lines, *comments, ""])


def native() -> str:
    """Return the DBC file of native packets on CAN 2.0, with the default base."""
    time = Signal("time", 6, 2, native_can.TICK_US, "us", signed=False)
    messages = [
        Message(
            native_can.SYNC_ID, "SYNC", 4, [Signal("time", 0, 4, 1, "us", signed=False)], "Time of a node"
        )
    ]
    kinds = [
        (native_can.ACC, "ACC", [*vector("acc", 1 / ACC_SCALE, "m/s^2"), time], "Opens a sample"),
        (native_can.QUAT, "QUAT", vector("quat", 1 / QUAT_SCALE, "", "wxyz"), "Closes a sample"),
        (native_can.GYR, "GYR", [*vector("gyr", 1 / GYR_SCALE, "rad/s"), time], ""),
        (native_can.MAG, "MAG", [*vector("mag", 1 / MAG_SCALE, "uT"), time], ""),
    ]
    for kind, name, signals, comment in kinds:
        for sensor in range(native_can.SENSORS):
            can_id = native_can.can_id(kind, sensor)
            messages.append(Message(can_id, f"{name}_{sensor}", 8, signals, comment))
    return dbc(
        "Native packets of edgepose on CAN 2.0, base 0x400. CAN FD packets are not in here.", messages, False
    )


def mti600() -> str:
    """Return the DBC file of an Xsens MTi-600 with its default identifiers."""

    def whole(name: str, size: int, factor: float = 1, unit: str = "") -> list[Signal]:
        return [Signal(name, 0, size, factor, unit, signed=False)]

    exponent = Signal("dv_exponent", 6, 1, 1, "", signed=False)
    messages = [
        Message(0x001, "ERROR", 1, whole("error", 1)),
        Message(0x005, "SAMPLE_TIME", 4, whole("time", 4, 100, "us"), "Some texts give 1 us for a step"),
        Message(0x006, "GROUP_COUNTER", 2, whole("count", 2)),
        Message(0x011, "STATUS", 4, whole("status", 4)),
        Message(0x021, "QUATERNION", 8, vector("quat", 1 / 32767, "", "wxyz"), "Sensor to local frame"),
        Message(0x022, "EULER", 6, vector("euler", 2**-7, "deg", ["roll", "pitch", "yaw"])),
        Message(0x031, "DELTA_V", 7, [*vector("dv", 1, ""), exponent], "Raw: the exponent sets the step"),
        Message(0x032, "RATE_OF_TURN", 6, vector("gyr", 2**-9, "rad/s")),
        Message(0x033, "DELTA_Q", 8, vector("dq", 1 / 32767, "", "wxyz")),
        Message(0x034, "ACCELERATION", 6, vector("acc", 2**-8, "m/s^2")),
        Message(0x035, "FREE_ACCELERATION", 6, vector("free_acc", 2**-8, "m/s^2"), "Local frame, no gravity"),
        Message(0x041, "MAGNETIC_FIELD", 6, vector("mag", 2**-10, "")),
        Message(0x051, "TEMPERATURE", 2, [Signal("temperature", 0, 2, 2**-8, "degC")]),
        Message(0x052, "PRESSURE", 4, whole("pressure", 4, 2**-15, "Pa")),
    ]
    about = (
        "Xsens MTi-600, default identifiers, which every device can change. Made from public descriptions; "
        "the byte order (big-endian here) has not been checked on a device."
    )
    return dbc(about, messages, True)


def main(folder: Path) -> None:
    """Write both files."""
    (folder / "native.dbc").write_text(native(), encoding="ascii", newline="\n")
    (folder / "mti600.dbc").write_text(mti600(), encoding="ascii", newline="\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else DEST)
