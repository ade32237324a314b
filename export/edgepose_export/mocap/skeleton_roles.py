"""Which joint of a skeleton is which part of the body, from the joints' names and from the tree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

from edgepose.errors import EdgeposeError

from .joint_words import LIMB_PARTS, Meaning, is_helper, meaning

_LONGEST_NAME = 120

SIDES = ("left", "right")
_LIMB_ROLES = ("thigh", "shank", "foot", "upper_arm", "forearm", "hand")
_OPTIONAL_ROLES = ("toes", "collar")
_ABOVE_CHEST = (None, Meaning("spine", ""), Meaning("neck", ""))
ROLES = (
    "pelvis",
    "chest",
    "neck",
    "head",
    *(f"{side}_{role}" for side in SIDES for role in (*_LIMB_ROLES, *_OPTIONAL_ROLES)),
)
"""Roles that a mapping may name joints for."""


class Side(NamedTuple):
    """Joints of one side, as indices."""

    thigh: int
    shank: int
    foot: int
    toes: int | None
    collar: int | None
    upper_arm: int
    forearm: int
    hand: int


class Roles(NamedTuple):
    """Joints of a skeleton by their role, as indices."""

    pelvis: int
    """The joint that carries both thighs."""
    spine: tuple[int, ...]
    """Joints from above the pelvis to the chest, which carries both arms, if not the neck does."""
    neck: int | None
    """The first joint between chest and head; None if there is none."""
    head: int
    left: Side
    right: Side

    @property
    def limbs(self) -> dict[int, tuple[int, int]]:
        """Joints at both ends of each limb, by the SMPL joint at its start."""
        ends = {}
        for side, joints in enumerate((self.left, self.right)):
            ends |= {
                1 + side: (joints.thigh, joints.shank),
                4 + side: (joints.shank, joints.foot),
                16 + side: (joints.upper_arm, joints.forearm),
                18 + side: (joints.forearm, joints.hand),
            }
        return ends


def find_roles(
    names: Sequence[str], parents: Sequence[int], mapping: Mapping[str, str] | None = None
) -> Roles:
    """Return the role of each joint that has one; fingers, twist bones, props and the like have none.

    The joints of limbs are found by name; pelvis and chest are the joints that carry both legs and both arms.

    Args:
        names: names of the joints (J); each joint comes after its parent.
        parents: index of each joint's parent, -1 for the root.
        mapping: names of joints by role (`ROLES`), which override what the names say.

    Raises:
        EdgeposeError: a role has no joint, or joints are not connected as in a body; the message names them.
    """
    longest = max(names, key=len)
    if len(longest) > _LONGEST_NAME:
        raise EdgeposeError(f"a joint's name has {len(longest)} characters: {longest[:20]}...")
    tree = _Tree(names, parents)
    given = _given(names, mapping or {})
    limbs = {side: _limb_joints(tree, side, given) for side in SIDES}
    missing = [f"{side}_{role}" for side in SIDES for role in _LIMB_ROLES if limbs[side].get(role) is None]
    if missing:
        raise EdgeposeError(_unknown(names, missing))
    for side in SIDES:
        _check_chain(tree, [limbs[side][role] for role in ("thigh", "shank", "foot", "toes")])
        _check_chain(tree, [limbs[side][role] for role in ("collar", "upper_arm", "forearm", "hand")])
    pelvis, spine = _trunk(tree, limbs, given)
    neck, head = _neck_and_head(tree, spine[-1], given)
    sides = []
    for side in SIDES:
        joints = limbs[side]
        collar = joints["collar"]
        if collar is not None and spine[-1] not in tree.above(collar):
            raise EdgeposeError(f"joint {names[collar]} is not above {names[spine[-1]]}, the chest")
        sides.append(Side(**joints))  # type: ignore[arg-type]
    return Roles(pelvis, spine, neck, head, *sides)


class _Tree:
    """Joints with their parents and what their names mean."""

    def __init__(self, names: Sequence[str], parents: Sequence[int]) -> None:
        self.names, self.parents = names, parents
        self.meanings = [meaning(name) for name in names]
        self._depths: list[int] = []
        for parent in parents:
            self._depths.append(0 if parent < 0 else self._depths[parent] + 1)

    def above(self, joint: int) -> list[int]:
        """Return a joint and all joints above it, up to the root."""
        path = [joint]
        while self.parents[path[-1]] >= 0:
            path.append(self.parents[path[-1]])
        return path

    def fork(self, a: int, b: int) -> int:
        """Return the lowest joint that both joints hang on."""
        above = set(self.above(a))
        return next(joint for joint in self.above(b) if joint in above)

    def between(self, top: int, bottom: int) -> list[int]:
        """Return the joints below `top` down to and with `bottom`."""
        path = self.above(bottom)
        return path[: path.index(top)][::-1]

    def named(self, part: str, side: str = "") -> int | None:
        """Return the joint nearest to the root whose name means a part."""
        found = [j for j, m in enumerate(self.meanings) if m == Meaning(part, side)]
        return min(found, key=self._depths.__getitem__, default=None)

    def check_only(self, joint: int) -> None:
        """Raise EdgeposeError if a joint that does not hang on this one has a name that means the same."""
        below = {joint}
        for other, (what, parent) in enumerate(zip(self.meanings, self.parents, strict=True)):
            if parent in below:
                below.add(other)
            elif other != joint and what is not None and what == self.meanings[joint]:
                raise EdgeposeError(
                    f"joints {self.names[joint]} and {self.names[other]} are both a "
                    f"{' '.join(filter(None, (what.side, what.part)))}; say which with --mapping FILE.toml"
                )

    def part(self, joint: int) -> str | None:
        """Return what part a joint's name means."""
        found = self.meanings[joint]
        return None if found is None else found.part


def _given(names: Sequence[str], mapping: Mapping[str, str]) -> dict[str, int]:
    """Return the joints of a mapping as indices."""
    for role, name in mapping.items():
        if name not in names:
            raise EdgeposeError(f"the mapping's joint {name!r} ({role}) is not in the skeleton")
    return {role: names.index(name) for role, name in mapping.items()}


def _limb_joints(tree: _Tree, side: str, given: Mapping[str, int]) -> dict[str, int | None]:
    """Return the joints of a side by their roles; None where a name is missing."""
    named = {part: tree.named(part, side) for part in LIMB_PARTS}

    def first(*words: str) -> int | None:
        return next((named[word] for word in words if named[word] is not None), None)

    shank = first("shank", "leg")
    thigh = first("thigh", "hip") if shank == named["leg"] else first("thigh", "hip", "leg")
    foot = first("ankle", "foot")
    upper_arm = first("upper_arm", "arm", "shoulder")
    joints = {
        "thigh": thigh,
        "shank": shank,
        "foot": foot,
        "toes": first("toes") if foot == named["foot"] else first("toes", "foot"),
        "collar": first("collar") if upper_arm == named["shoulder"] else first("collar", "shoulder"),
        "upper_arm": upper_arm,
        "forearm": named["forearm"],
        "hand": named["hand"],
    }
    for role, joint in joints.items():
        if f"{side}_{role}" in given:
            joints[role] = given[f"{side}_{role}"]
        elif joint is not None:
            tree.check_only(joint)
    return joints


def _check_chain(tree: _Tree, joints: Sequence[int | None]) -> None:
    """Raise EdgeposeError unless each joint hangs on the one before it; None is left out."""
    chain = [joint for joint in joints if joint is not None]
    for upper, lower in pairwise(chain):
        if upper == lower or upper not in tree.above(lower):
            raise EdgeposeError(
                f"joint {tree.names[lower]} does not hang on {tree.names[upper]}, as in a body; "
                "give --mapping if the names mislead"
            )


def _trunk(
    tree: _Tree, limbs: Mapping[str, Mapping[str, int | None]], given: Mapping[str, int]
) -> tuple[int, tuple[int, ...]]:
    """Return the pelvis and the joints of the spine, of which the last is the chest."""
    left, right = (limbs[side] for side in SIDES)
    thighs = _joint(left["thigh"]), _joint(right["thigh"])
    pelvis = given.get("pelvis", tree.fork(*thighs))
    for thigh in thighs:
        _check_chain(tree, [pelvis, thigh])
    arms = [
        _joint(joints["upper_arm"] if joints["collar"] is None else joints["collar"])
        for joints in (left, right)
    ]
    chest = given.get("chest", tree.fork(*arms))
    while "chest" not in given and tree.part(chest) == "neck":  # Biped's collars hang on the neck
        chest = tree.parents[chest]
    start = tree.fork(pelvis, chest)
    if start == chest:
        raise EdgeposeError(
            f"no joint of a spine lies between {tree.names[pelvis]}, the pelvis, and the arms"
        )
    path = tree.between(start, chest)
    spine = [joint for joint in path if not is_helper(tree.names[joint]) or joint == chest]
    return pelvis, tuple(spine)


def _neck_and_head(tree: _Tree, chest: int, given: Mapping[str, int]) -> tuple[int | None, int]:
    """Return the neck, None if there is none, and the head."""
    head = given.get("head", tree.named("head"))
    if head is None:
        head = _top(tree, chest)
    elif "head" not in given:
        tree.check_only(head)
    if head is None:
        raise EdgeposeError(_unknown(tree.names, ["head"]))
    if head == chest or chest not in tree.above(head):
        raise EdgeposeError(f"joint {tree.names[head]} is not above {tree.names[chest]}, the chest")
    path = [j for j in tree.between(chest, head)[:-1] if not is_helper(tree.names[j])]
    neck = given.get("neck", path[0] if path else None)
    _check_chain(tree, [chest, neck, head])
    return neck, head


def _top(tree: _Tree, chest: int) -> int | None:
    """Return the top of the only chain from the chest that is no arm, None if there is no such chain."""
    joint, path = chest, []
    while True:
        children = [
            child
            for child, parent in enumerate(tree.parents)
            if parent == joint and not is_helper(tree.names[child]) and tree.meanings[child] in _ABOVE_CHEST
        ]
        if len(children) != 1:
            return path[-1] if path and not children else None
        joint = children[0]
        path.append(joint)


def _joint(joint: int | None) -> int:
    assert joint is not None  # `find_roles` has checked it
    return joint


def _unknown(names: Sequence[str], missing: Sequence[str]) -> str:
    """Return the message on roles without a joint."""
    known = {name for name in names if meaning(name) is not None or is_helper(name)}
    unknown = [name for name in names if name not in known]
    listed = f"; joints not understood: {_few(unknown)}" if unknown else ""
    return f"unknown skeleton: no joint for {_few(missing)}{listed}; name them with --mapping FILE.toml"


def _few(words: Sequence[str], most: int = 5) -> str:
    return ", ".join(words[:most]) + (f" and {len(words) - most} more" if len(words) > most else "")
