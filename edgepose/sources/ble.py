"""Movella DOT sensors over Bluetooth Low Energy as transports.

bleak works in an event loop. One loop, in a thread of its own, serves all sensors of the process, because
they share an adapter. The module is imported only when such sensors are asked for.
"""

from __future__ import annotations

import asyncio
import logging
import select
import socket
import threading
from collections import deque
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any, TypeVar

from edgepose.errors import ConfigError, DeviceError, EdgeposeError
from edgepose.sources import POLL_S
from edgepose.sources.line_reader import LineDisconnectedError
from edgepose.sources.protocol_detection import Datagram

try:
    from bleak import BleakClient, BleakScanner
    from bleak.exc import BleakBluetoothNotAvailableError, BleakDeviceNotFoundError
except ImportError as missing:
    raise ConfigError("--ble needs bleak: install it with pip install 'edgepose[ble]'") from missing

# Otherwise its warnings, such as about a missing `bluetoothctl`, come out beside those of edgepose.
logging.getLogger("bleak").setLevel(logging.CRITICAL)

_log = logging.getLogger(__name__)

_UUID = "1517{}-4947-11e9-8646-d663bd873d93"
CONTROL, MEASUREMENT = _UUID.format("2001"), _UUID.format("2002")
"""Characteristics that start measurements and that send long payloads, see firmware_protocols/docs/dot.md."""

_CUSTOM_MODE_5 = 26
START, STOP = bytes([1, 1, _CUSTOM_MODE_5]), bytes([1, 0, _CUSTOM_MODE_5])
"""Messages to the control characteristic."""

NAMES = ("Movella DOT", "Xsens DOT")
"""Names under which the sensors advertise themselves."""

FIND_S = 5.0
"""Longest time to find a sensor, to connect to it and to start it, each, seconds."""

STOP_S = 2.0
"""Longest time to stop a sensor and to disconnect from it, seconds."""

SCAN_S = 5.0
"""Time for which `edgepose devices` looks for sensors, seconds."""

_MOST = 4096
"""Notifications that may wait to be read: a minute of a sensor's."""

_Result = TypeVar("_Result")


class _Radio:
    """The event loop of all sensors, in a thread that starts with the first call.

    Attributes:
        connecting: held while a sensor is being connected to: BlueZ refuses a second attempt meanwhile.
    """

    connecting: asyncio.Lock

    def __init__(self) -> None:
        """Prepare; no thread runs yet."""
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None

    def call(self, coroutine: Coroutine[Any, Any, _Result]) -> _Result:
        """Run a coroutine in the loop, and return its result."""
        with self._lock:
            if self._loop is None:
                self._loop = asyncio.new_event_loop()
                self.connecting = asyncio.Lock()
                threading.Thread(target=self._loop.run_forever, daemon=True, name="bluetooth").start()
        future = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()  # after a Ctrl-C the coroutine still runs
            raise


_radio = _Radio()


class DotSensor:
    """A connected sensor that measures; its notifications come out as datagrams."""

    def __init__(self, address: str) -> None:
        """Connect to a sensor, and start its measurement.

        Args:
            address: its Bluetooth address.

        Raises:
            DeviceError: there is no adapter or no such sensor, or it is not a DOT.
        """
        self._address = address
        self._data: deque[bytes] = deque()
        self._lost = self._overrun = False
        # One byte for each notification: they can be waited for like the data of other lines.
        self._reader, self._writer = socket.socketpair()
        self._reader.setblocking(False)
        self._writer.setblocking(False)
        try:
            self._client = _radio.call(self._connect())
        except BaseException as error:
            self._close_sockets()
            if isinstance(error, EdgeposeError) or not isinstance(error, Exception):
                raise
            raise DeviceError(f"{address}: {_problem(error)}") from error

    async def _connect(self) -> BleakClient:
        client = BleakClient(self._address, self._on_disconnect, timeout=FIND_S)
        async with _radio.connecting:
            await client.connect()
        self._lost = not client.is_connected  # bleak reports attempts of its own that it repeats, too
        try:
            await asyncio.wait_for(self._start(client), FIND_S)
        except BaseException:
            with suppress(Exception):
                await client.disconnect()
            raise
        return client

    async def _start(self, client: BleakClient) -> None:
        if any(client.services.get_characteristic(each) is None for each in (CONTROL, MEASUREMENT)):
            raise DeviceError(
                f"{self._address}: not a Movella DOT, because it has no measurement service; "
                "edgepose devices --ble lists those in range"
            )
        await client.start_notify(MEASUREMENT, self._on_notification)
        await client.write_gatt_char(CONTROL, START, response=True)

    def _on_notification(self, _: Any, data: bytearray) -> None:
        if len(self._data) < _MOST:
            self._data.append(bytes(data))
            self._wake()
        elif not self._overrun:
            self._overrun = True
            _log.warning("%s: notifications are not read in time; some are lost", self._address)

    def _on_disconnect(self, _: Any) -> None:
        self._lost = True
        self._wake()

    def _wake(self) -> None:
        with suppress(OSError):  # full, and the reader wakes up anyway; or closed
            self._writer.send(b"\0")

    def read(self) -> tuple[list[Datagram], bool]:
        """See `Transport.read`."""
        select.select([self._reader], [], [], POLL_S)
        return self._receive()

    @property
    def waiting(self) -> Callable[[], tuple[list[Datagram], bool]]:
        """See `Transport.waiting`."""
        return self._receive

    @property
    def file(self) -> int:
        """See `Transport.file`."""
        return self._reader.fileno()

    def _receive(self) -> tuple[list[Datagram], bool]:
        # The bytes first: one that is sent after that wakes the reader again.
        with suppress(BlockingIOError):
            self._reader.recv(_MOST)
        lost = self._lost
        data = [self._data.popleft() for _ in range(len(self._data))]
        if lost and not data:
            raise LineDisconnectedError
        return [Datagram(self._address, each) for each in data], False

    def close(self) -> None:
        """Stop the measurement, and disconnect."""
        with suppress(Exception):  # of a sensor that is out of range
            _radio.call(asyncio.wait_for(self._stop(), STOP_S))
        self._close_sockets()

    async def _stop(self) -> None:
        try:
            if self._client.is_connected:
                await self._client.write_gatt_char(CONTROL, STOP, response=True)
        finally:
            await self._client.disconnect()

    def _close_sockets(self) -> None:
        self._reader.close()
        self._writer.close()


def sensors_in_range() -> dict[str, str]:
    """Return the addresses of the DOT sensors in range, with their names and signal strengths.

    Raises:
        DeviceError: there is no adapter, or it cannot be used.
    """
    try:
        found = _radio.call(BleakScanner.discover(SCAN_S, return_adv=True))
    except Exception as error:
        raise DeviceError(_problem(error)) from error
    return {
        device.address: f"{NAMES[0]}  {advertisement.rssi} dBm"
        for device, advertisement in sorted(found.values(), key=lambda each: each[0].address)
        if (advertisement.local_name or device.name or "").strip() in NAMES
    }


def _problem(error: Exception) -> str:
    """Describe an error of bleak, and what to do about it."""
    # The first argument alone: bleak adds a code for programs.
    text = (str(error.args[0] if error.args else "").splitlines() or [""])[0]
    if isinstance(error, BleakDeviceNotFoundError):
        return (
            f"not found over Bluetooth in {FIND_S:g} s; check that the sensor is on, in range, and not "
            "connected to a phone or another program"
        )
    if isinstance(error, BleakBluetoothNotAvailableError):
        return f"Bluetooth is not available: {text.rstrip('.')}; plug in an adapter, and switch it on"
    if isinstance(error, OSError) and not isinstance(error, TimeoutError):
        reason = error.strerror or error
        return f"Bluetooth is not available: no D-Bus ({reason}); check that BlueZ (bluetoothd) is running"
    if "ServiceUnknown" in text or "NameHasNoOwner" in text:
        return "Bluetooth is not available: BlueZ (bluetoothd) is not running; start the service bluetooth"
    if isinstance(error, TimeoutError | asyncio.TimeoutError):
        return "it does not answer over Bluetooth; move it closer, or switch it off and on"
    return f"Bluetooth failed ({type(error).__name__}: {text}); switch the sensor off and on"
