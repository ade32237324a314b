"""A simulated BlueZ with Bluetooth devices, on a D-Bus message bus of its own.

It serves the part of D-Bus and of `org.bluez` that bleak uses on Linux. Programs find it by the environment
variable DBUS_SYSTEM_BUS_ADDRESS, without a daemon, an adapter or root.
"""

from __future__ import annotations

import asyncio
import io
import struct
import tempfile
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from dbus_fast import Message, MessageFlag, MessageType, Variant
from dbus_fast._private.unmarshaller import Unmarshaller

ADAPTER = "/org/bluez/hci0"
BUS_NAME, PROPERTIES = "org.freedesktop.DBus", "org.freedesktop.DBus.Properties"
OBJECTS = "org.freedesktop.DBus.ObjectManager"
_UUID = "1517{}-4947-11e9-8646-d663bd873d93".format

ADVERTISE_S = 0.1
"""Time between two advertisements of a device, seconds."""

ABORT_S = 0.05
"""Time from the error about an aborted connection to its end, seconds."""

Interfaces = dict[str, dict[str, Any]]


class SimulatedDot:
    """A Movella DOT as the adapter sees it.

    Attributes:
        address: its Bluetooth address.
        path: its object on the bus.
        messages: what has been written to its control characteristic.
        in_range: whether the adapter sees it.
        connected: whether a program is connected to it.
        notifies: whether a program has subscribed to its long payloads.
        aborts: number of next connections that BlueZ gives up at once, as under radio interference.
    """

    def __init__(self, address: str, name: str = "Movella DOT", *, measures: bool = True) -> None:
        """Create a device that is switched on; without `measures` it has no measurement service."""
        self.address, self._name, self._measures = address, name, measures
        self.path = f"{ADAPTER}/dev_{address.replace(':', '_')}"
        self.messages: list[bytes] = []
        self.in_range, self.connected, self.notifies = True, False, False
        self.aborts = 0

    @property
    def measuring(self) -> bool:
        """Whether its last message started a measurement, and somebody listens."""
        return self.notifies and bool(self.messages) and self.messages[-1][1] == 1

    @property
    def control(self) -> str:
        """Object of the characteristic that starts measurements."""
        return f"{self.path}/service0010/char0011"

    @property
    def measurement(self) -> str:
        """Object of the characteristic with long payloads."""
        return f"{self.path}/service0010/char0013"

    def device(self) -> Interfaces:
        """Return the interfaces of the device's object."""
        values = {
            "Address": ("s", self.address),
            "AddressType": ("s", "public"),
            "Name": ("s", self._name),
            "Alias": ("s", self._name),
            "Paired": ("b", False),
            "Trusted": ("b", False),
            "Blocked": ("b", False),
            "LegacyPairing": ("b", False),
            "Connected": ("b", self.connected),
            "ServicesResolved": ("b", self.connected),
            "UUIDs": ("as", []),
            "Adapter": ("o", ADAPTER),
            "RSSI": ("n", -60),
        }
        return {"org.bluez.Device1": _variants(values)}

    def attributes(self) -> dict[str, Interfaces]:
        """Return the objects of its services and characteristics."""
        service = f"{self.path}/service0010"

        def characteristic(number: str, flags: Sequence[str]) -> Interfaces:
            values = {
                "UUID": ("s", _UUID(number)),
                "Service": ("o", service),
                "Value": ("ay", b""),
                "Notifying": ("b", False),
                "Flags": ("as", list(flags)),
                "MTU": ("q", 247),
            }
            return {"org.bluez.GattCharacteristic1": _variants(values)}

        uuid = _UUID("2000" if self._measures else "1000")
        values = {
            "UUID": ("s", uuid),
            "Device": ("o", self.path),
            "Primary": ("b", True),
            "Includes": ("ao", []),
        }
        objects: dict[str, Interfaces] = {service: {"org.bluez.GattService1": _variants(values)}}
        if self._measures:
            objects[self.control] = characteristic("2001", ["read", "write"])
            objects[self.measurement] = characteristic("2002", ["notify"])
        return objects


class SimulatedBluez:
    """A message bus with `org.bluez` on it, in a thread.

    Attributes:
        address: value for DBUS_SYSTEM_BUS_ADDRESS.
    """

    def __init__(self, path: Path, dots: Sequence[SimulatedDot], *, adapter: bool = True) -> None:
        """Listen at a Unix socket.

        Args:
            path: the socket.
            dots: the devices.
            adapter: whether there is an adapter.
        """
        self.address = f"unix:path={path}"
        self._path, self._dots, self._adapter = path, dots, adapter
        self._clients: dict[asyncio.StreamWriter, bool] = {}  # whether it wants signals
        self._serial = self._discovering = 0
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True, name="bluez")

    def __enter__(self) -> SimulatedBluez:
        """Start to listen."""
        self._thread.start()
        start = asyncio.start_unix_server(self._serve, self._path)
        self._server = asyncio.run_coroutine_threadsafe(start, self._loop).result()
        return self

    def __exit__(self, *_: object) -> None:
        """Close all connections."""
        asyncio.run_coroutine_threadsafe(self._close(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _close(self) -> None:
        self._server.close()
        tasks = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
        for writer in self._clients:
            writer.close()
        await asyncio.gather(*tasks, return_exceptions=True)

    def notify(self, dot: SimulatedDot, data: bytes) -> None:
        """Send a notification of a device, unless it does not measure."""
        self._loop.call_soon_threadsafe(self._notify, dot, data)

    def disconnect(self, dot: SimulatedDot, in_range: bool = False) -> None:
        """Let a device lose its connection, and stay in range or not."""
        self._loop.call_soon_threadsafe(self._disconnect, dot, in_range)

    def _notify(self, dot: SimulatedDot, data: bytes) -> None:
        if dot.measuring:
            self._changed(dot.measurement, "org.bluez.GattCharacteristic1", {"Value": ("ay", data)})

    def _disconnect(self, dot: SimulatedDot, in_range: bool) -> None:
        dot.in_range = in_range
        if dot.connected:
            dot.connected = dot.notifies = False
            states = {"ServicesResolved": ("b", False), "Connected": ("b", False)}
            self._changed(dot.path, "org.bluez.Device1", states)

    # --- the message bus ------------------------------------------------------------------------------------

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._clients[writer] = False
        with suppress(asyncio.IncompleteReadError, ConnectionError):
            await _greet(reader, writer)
            while True:
                head = await reader.readexactly(16)
                order = "<" if head[:1] == b"l" else ">"
                body, _, fields = struct.unpack(f"{order}3I", head[4:])
                rest = await reader.readexactly(-(-fields // 8) * 8 + body)
                call = Unmarshaller(io.BytesIO(head + rest)).unmarshall()
                if call is not None and call.message_type is MessageType.METHOD_CALL:
                    self._answer(call, writer)
                    await writer.drain()
        del self._clients[writer]
        writer.close()

    def _answer(self, call: Message, writer: asyncio.StreamWriter) -> None:
        after: Callable[[], None] | None = None
        try:
            signature, body, after = self._call(call, writer)
            reply = Message.new_method_return(call, signature, body)
        except _Failed as error:
            reply = Message.new_error(call, *error.args)
        reply.sender = BUS_NAME if call.destination == BUS_NAME else "org.bluez"
        if not call.flags & MessageFlag.NO_REPLY_EXPECTED:
            self._send(writer, reply)
        if after is not None:
            after()

    def _send(self, writer: asyncio.StreamWriter, message: Message) -> None:
        self._serial += 1
        message.serial = self._serial
        writer.write(bytes(message._marshall(False)))

    def _signal(self, path: str, interface: str, member: str, signature: str, body: list[Any]) -> None:
        for writer, wants in self._clients.items():
            if wants:
                message = Message.new_signal(path, interface, member, signature, body)
                message.sender = ":1.0"
                self._send(writer, message)

    def _changed(self, path: str, interface: str, values: dict[str, tuple[str, Any]]) -> None:
        self._signal(path, PROPERTIES, "PropertiesChanged", "sa{sv}as", [interface, _variants(values), []])

    def _call(
        self, call: Message, writer: asyncio.StreamWriter
    ) -> tuple[str, list[Any], Callable[[], None] | None]:
        """Return signature and body of the answer, and what happens after it."""
        member = call.member
        if call.destination == BUS_NAME:
            if member == "AddMatch":
                self._clients[writer] = True
            answers: dict[str, tuple[str, list[Any]]] = {
                "Hello": ("s", [f":1.{len(self._clients)}"]),
                "GetNameOwner": ("s", [":1.0"]),
                "NameHasOwner": ("b", [True]),
            }
            return *answers.get(member, ("", [])), None
        if member == "GetManagedObjects":
            return "a{oa{sa{sv}}}", [self._objects()], None
        if call.path == ADAPTER:
            if member in ("StartDiscovery", "StopDiscovery"):
                self._discovering += 1 if member == "StartDiscovery" else -1
            return "", [], self._advertise if member == "StartDiscovery" else None
        for dot in self._dots:
            if call.path.startswith(dot.path):
                return "", [], self._call_dot(dot, call)
        raise _Failed("org.freedesktop.DBus.Error.UnknownObject", f"no object {call.path}")

    # --- org.bluez ------------------------------------------------------------------------------------------

    def _objects(self) -> dict[str, Interfaces]:
        objects: dict[str, Interfaces] = {"/org/bluez": {}}
        if self._adapter:
            values = {
                "Address": ("s", "00:00:00:00:00:01"),
                "Name": ("s", "hci0"),
                "Alias": ("s", "hci0"),
                "Powered": ("b", True),
                "Discovering": ("b", False),
                "UUIDs": ("as", []),
                "Roles": ("as", ["central"]),
            }
            objects[ADAPTER] = {"org.bluez.Adapter1": _variants(values)}
        for dot in self._dots:
            if dot.connected:
                objects |= {dot.path: dot.device(), **dot.attributes()}
        return objects

    def _advertise(self) -> None:
        """Report the devices in range, again and again while a program looks for them."""
        if not self._discovering:
            return
        self._loop.call_later(ADVERTISE_S, self._advertise)
        for dot in self._dots:
            if dot.in_range and not dot.connected:
                self._signal("/", OBJECTS, "InterfacesAdded", "oa{sa{sv}}", [dot.path, dot.device()])

    def _call_dot(self, dot: SimulatedDot, call: Message) -> Callable[[], None] | None:
        if call.member == "Connect":
            if not dot.in_range:
                raise _Failed("org.bluez.Error.Failed", "br-connection-create-socket")
            self._changed(dot.path, "org.bluez.Device1", {"Connected": ("b", True)})
            if dot.aborts:
                dot.aborts -= 1
                after = (dot.path, "org.bluez.Device1", {"Connected": ("b", False)})
                self._loop.call_later(ABORT_S, self._changed, *after)
                raise _Failed("org.bluez.Error.Failed", "le-connection-abort-by-local")
            dot.connected = True
            return lambda: self._resolve(dot)
        if call.member == "Disconnect":
            return lambda: self._disconnect(dot, dot.in_range)
        if not dot.connected:
            raise _Failed("org.bluez.Error.NotConnected", "Not Connected")
        if call.member == "WriteValue" and call.path == dot.control:
            dot.messages.append(bytes(call.body[0]))
        elif call.path == dot.measurement and call.member in ("StartNotify", "StopNotify"):
            dot.notifies = call.member == "StartNotify"
        else:
            raise _Failed("org.bluez.Error.NotSupported", "Operation is not supported")
        return None

    def _resolve(self, dot: SimulatedDot) -> None:
        for path, interfaces in dot.attributes().items():
            self._signal("/", OBJECTS, "InterfacesAdded", "oa{sa{sv}}", [path, interfaces])
        self._changed(dot.path, "org.bluez.Device1", {"ServicesResolved": ("b", True)})


class DotLine:
    """A simulated sensor as a line of the simulator; all sensors share one bus, which the last one closes.

    Attributes:
        name: its Bluetooth address.
        bus: value for DBUS_SYSTEM_BUS_ADDRESS.
        master: None, because nothing has to be read here.
    """

    master = None

    def __init__(self, dot: SimulatedDot, bluez: SimulatedBluez, close: Callable[[], None]) -> None:
        """Store the sensor, its bus, and what closes the bus."""
        self.name, self.bus, self.close = dot.address, bluez.address, close
        self._dot, self._bluez = dot, bluez

    def send(self, wire: bytes) -> None:
        """Send a notification, if a program has started the measurement."""
        self._bluez.notify(self._dot, wire)

    def receive(self) -> bytes:
        """Return nothing: the bus answers by itself."""
        return b""


def dot_lines(count: int) -> list[DotLine]:
    """Return simulated sensors on a new bus."""
    stack = ExitStack()
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="simulated-bluez-")))
    dots = [SimulatedDot(f"D4:22:CD:00:00:{number:02X}") for number in range(count)]
    bluez = stack.enter_context(SimulatedBluez(folder / "bus", dots))
    return [DotLine(dot, bluez, stack.close if dot is dots[-1] else lambda: None) for dot in dots]


class _Failed(Exception):
    """Name and text of an error to answer with."""


async def _greet(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Accept any client."""
    await reader.readexactly(1)
    while (line := await reader.readuntil(b"\r\n")) != b"BEGIN\r\n":
        agreed = line.startswith(b"NEGOTIATE_UNIX_FD")
        writer.write(b"AGREE_UNIX_FD\r\n" if agreed else b"OK " + 32 * b"0" + b"\r\n")


def _variants(values: dict[str, tuple[str, Any]]) -> dict[str, Any]:
    return {name: Variant(signature, value) for name, (signature, value) in values.items()}
