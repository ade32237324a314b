"""The zero of each actor, from all of their motion files; see `mocap.zeroing`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial, reduce
from pathlib import Path
from typing import TYPE_CHECKING

from edgepose.cli.terminal.messages import say
from edgepose.errors import EdgeposeError
from edgepose.utils.jobs import run_in_order

if TYPE_CHECKING:
    from edgepose_export.mocap import Mapping as JointMapping
    from edgepose_export.mocap.zeroing import Evidence, Zero


def find_zeros(
    actors: Mapping[str, list[Path]], t_pose: Path | None, mapping: JointMapping | None, jobs: int
) -> dict[str, Zero]:
    """Return the zero of each actor by name, and say of whom it is not known.

    Files that cannot be read are left out; their conversion reports them.
    """
    from edgepose_export.cli.progress import progress
    from edgepose_export.mocap.zeroing import find_zero

    files = [(actor, path) for actor, paths in actors.items() for path in paths]
    read = partial(evidence_of, t_pose=t_pose, mapping=mapping)
    gathered: dict[str, list[Evidence]] = {actor: [] for actor in actors}
    found = run_in_order(read, [path for _, path in files], jobs)
    for (actor, _), evidence in zip(files, progress(found, "zeroing actors", len(files)), strict=True):
        if evidence is not None:
            gathered[actor].append(evidence)
    zeros = {actor: find_zero(total(parts)) for actor, parts in gathered.items() if parts}
    unknown = sorted(actor for actor, zero in zeros.items() if zero.evidence == "none")
    if unknown:
        say(
            f"{len(unknown)} of {len(zeros)} actors neither stand nor walk upright long enough to show their "
            f"straight pose; their trunks keep the zero of the source: {', '.join(unknown)}"
        )
    return zeros


def evidence_of(path: Path, t_pose: Path | None, mapping: JointMapping | None) -> Evidence | None:
    """Return what a motion file tells of its actor's zero; None if it cannot be read."""
    from edgepose_export.mocap import pieces, read_motion
    from edgepose_export.mocap.zeroing import Evidence

    try:
        parts = [Evidence.of(piece) for piece in pieces(read_motion(path, t_pose, mapping))]
    except (EdgeposeError, OSError):
        return None
    return total(parts) if parts else None


def total(parts: list[Evidence]) -> Evidence:
    """Return the evidence of several takes together."""
    return reduce(lambda one, other: one.plus(other), parts)
