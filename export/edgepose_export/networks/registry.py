"""The table of all kinds of networks."""

from __future__ import annotations

from edgepose_export.networks import lstm, receptive_field
from edgepose_export.networks.kind import NetworkKind

NETWORKS: dict[str, NetworkKind] = {
    "birnn": lstm.BIRNN,
    "rnn": lstm.RNN,
    "feed-forward": receptive_field.FEED_FORWARD,
    "wavenet": receptive_field.WAVENET,
}
"""Kinds of networks by the name that configs and archives use."""
