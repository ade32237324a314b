"""Receivers of poses: each gets one output, because it cannot tell several apart."""

from __future__ import annotations

from collections.abc import Iterable
from ipaddress import ip_address
from typing import Any

from edgepose.errors import ConfigError
from edgepose.sinks.registry import SINKS
from edgepose.utils.sockets import Address, Destination, address_text


def check_receivers(outputs: Iterable[tuple[str, str, Any]]) -> None:
    """Check that no receiver gets poses in two forms, or of two wearers that it cannot tell apart.

    Args:
        outputs: wearer, name and target of each output.

    Raises:
        ConfigError: one does.
    """
    owners: dict[object, tuple[str, str, Any]] = {}
    for output in outputs:
        wearer, name, target = output
        if name not in SINKS:
            continue
        other_wearer, other_name, other = owners.setdefault(_receiver(name, target), output)
        if output == (other_wearer, other_name, other):
            continue
        if isinstance(target, Address | Destination) and _form(name, target) != _form(other_name, other):
            both = f"{_prefix(other_wearer)}{other_name} and {_prefix(wearer)}{name}"
            raise ConfigError(
                f"{both} send to {address_text(*target[:2])} in two forms, of which a receiver reads one; "
                "give each its own port"
            )
        if wearer == other_wearer:
            raise ConfigError(f"the output {name} sends to {address_text(*target[:2])} twice")
        if SINKS[name].one_wearer:
            raise ConfigError(
                f"{other_wearer} and {wearer} have the same {name}, whose receiver cannot tell them apart; "
                "give each their own"
            )


def _receiver(name: str, target: Any) -> object:
    """Return a value that is equal for two targets if they are one receiver; names are not resolved."""
    if not isinstance(target, Address | Destination):
        return name, target
    host = "127.0.0.1" if target.host.casefold() == "localhost" else target.host.casefold()
    try:
        return ip_address(host), target.port
    except ValueError:  # a name
        return host, target.port


def _form(name: str, target: Address | Destination) -> tuple[str, str]:
    return name, target.option if isinstance(target, Destination) else ""


def _prefix(wearer: str) -> str:
    return f"{wearer}: " if wearer else ""
