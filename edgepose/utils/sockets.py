"""Socket addresses: parsing of users' texts, resolution for the system."""

from __future__ import annotations

import errno
import socket
from collections.abc import Sequence
from typing import Any, NamedTuple

from edgepose.errors import ConfigError, DeviceError


def resolve(host: str, port: int, kind: socket.SocketKind) -> tuple[socket.AddressFamily, Any]:
    """Return the family and address of a host to listen on or send to.

    For a name with addresses of both kinds, such as `localhost`, it is the IPv4 one: senders and listeners
    must make the same choice.

    Raises:
        OSError, UnicodeError: there is no such host.
    """
    found = socket.getaddrinfo(host, port, type=kind)
    family, _, _, _, address = min(found, key=lambda entry: entry[0] != socket.AF_INET)
    return family, address


def failure_text(error: OSError | UnicodeError, host: str) -> str:
    """Return the reason why a host cannot be found, listened on or sent to."""
    if getattr(error, "errno", None) == errno.EINVAL and ":" in host and "%" not in host:
        return f"it needs the network interface by which it is reached, such as {host}%eth0"
    # socket.create_server adds the address, which the message has anyway.
    return str(getattr(error, "strerror", None) or error).partition(" (while attempting")[0]


def bound_socket(host: str, port: int) -> socket.socket:
    """Return a UDP socket that listens on an address and does not block.

    Raises:
        DeviceError: the address does not belong to this machine, or the port is in use.
    """
    try:
        family, address = resolve(host, port, socket.SOCK_DGRAM)
        bound = socket.socket(family, socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        raise DeviceError(f"cannot find {host!r} to listen on: {failure_text(error, host)}") from error
    bound.setblocking(False)
    try:
        bound.bind(address)
    except OSError as error:
        bound.close()
        raise DeviceError(
            f"cannot listen on {host} port {port}: {failure_text(error, host)}; "
            "give an address of this machine and a free port"
        ) from error
    return bound


CASTS = ("broadcast", "multicast")
"""Words that permit an address of many machines."""


class Address(NamedTuple):
    """Host name or address, UDP port, and "broadcast" or "multicast" if it stands for many machines."""

    host: str
    port: int
    cast: str = ""


class Destination(NamedTuple):
    """Destination of datagrams: as `Address`, with the value of an option, such as a format."""

    host: str
    port: int
    option: str
    cast: str = ""


def address_text(host: str, port: int) -> str:
    """Return HOST:PORT, with brackets around an IPv6 address."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def parse_address(text: str) -> tuple[str, int]:
    """Parse "HOST:PORT", with an IPv6 address in brackets.

    Raises:
        ConfigError: the text has another form.
    """
    host, colon, port = text.rpartition(":")
    if not colon or not port or text.endswith("]"):
        raise ConfigError(f"no port in {text!r}: write HOST:PORT, for example 127.0.0.1:9000")
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    elif ":" in host:
        raise ConfigError(f"cannot tell address from port in {text!r}: write an IPv6 address as [::1]:9000")
    if not host or any(c in "[]" or c.isspace() for c in host):
        raise ConfigError(f"no host in {text!r}: write HOST:PORT, for example 127.0.0.1:9000")
    if not (port.isascii() and port.isdigit() and len(port) <= 5 and 1 <= int(port) <= 65535):
        raise ConfigError(f"port {port!r} in {text!r} is not a number from 1 to 65535")
    return host, int(port)


def parse_host_and_port(text: str) -> tuple[str, int]:
    """Parse a text that is exactly HOST:PORT.

    Raises:
        ConfigError: the text is something else.
    """
    if "," in text:
        raise ConfigError(f"{text!r} is more than HOST:PORT")
    return parse_address(text)


def parse_datagram_address(text: str) -> Address:
    """Parse "HOST:PORT[,broadcast|multicast]", see `parse_address`.

    Raises:
        ConfigError: the text has another form.
    """
    host, port, (cast,) = _split_options(text, CASTS)
    return Address(host, port, cast)


def parse_destination(text: str, key: str, choices: Sequence[str]) -> Destination:
    """Parse "HOST:PORT[,key=value][,broadcast|multicast]", see `parse_address`.

    Args:
        text: the text.
        key: name of the option.
        choices: its values; the first is the default.

    Raises:
        ConfigError: the text has another form.
    """
    host, port, (value, cast) = _split_options(text, [f"{key}={choice}" for choice in choices], CASTS)
    return Destination(host, port, value.removeprefix(f"{key}=") or choices[0], cast)


def _split_options(text: str, *groups: Sequence[str]) -> tuple[str, int, list[str]]:
    """Return host, port, and the option of each group that follows them; "" where there is none.

    Raises:
        ConfigError: an option is unknown, or there are two of a group.
    """
    address, *options = text.split(",")
    host, port = parse_address(address)
    for option in options:
        if not any(option in group for group in groups):
            possible = ", ".join(each for group in groups for each in group)
            raise ConfigError(f"unknown option {option!r} in {text!r}: possible are {possible}")
    given = [[option for option in options if option in group] for group in groups]
    for several in given:
        if len(several) > 1:
            raise ConfigError(f"{several[0]!r} and {several[1]!r} in {text!r}: give one of them")
    return host, port, ["".join(each) for each in given]


def check_page(host: str, port: int) -> None:
    """Check that a page can be served at an address of this machine; port 0 stands for any.

    Raises:
        DeviceError: the port is taken, or the address is not one of this machine.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        socket.create_server((host, port), family=family).close()
    except (OSError, UnicodeError) as error:
        reason = failure_text(error, host)
        # Errors of name resolution have negative numbers.
        flag = "--page-port" if isinstance(error, OSError) and (error.errno or -1) > 0 else "--host"
        raise DeviceError(
            f"cannot show poses at {host} port {port}: {reason}; choose another {flag}"
        ) from error
