"""Words in joint names: the part of the body that a name means, and its side.

Programs name joints after the bone that starts there (`LeftUpLeg`, `thigh_l`) or after the joint (`L_Knee`),
with prefixes (`mixamorig:`, `Character1_`, `CC_Base_`, `Bip01`), and with the side before or after the part.
Some words mean two things: a shoulder is a collar bone or an upper arm, a hip is a thigh or a joint above it,
a leg is a shank or a thigh. `skeleton_roles` decides between them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

from edgepose.formats.bvh_names import without_namespace

_PARTS = {
    "hip": "hip hips",
    "thigh": "thigh thighbone thighbend upleg uplegs upperleg upleg legupper femur bigleg",
    "leg": "leg legs",
    "shank": "shank shin shinbone calf knee lowerleg lowleg loleg leglower tibia crus",
    "ankle": "ankle",
    "foot": "foot feet heel",
    "toes": "toe toes toebase toebasis ball forefoot metatarsals football",
    "collar": "collar collarbone clavicle clavicule clav innershoulder",
    "shoulder": "shoulder",
    "upper_arm": "upperarm uparm armupper uarm shldr shldrbend humerus",
    "arm": "arm",
    "forearm": "forearm forearmbend lowerarm lowarm loarm armlower farm elbow radius",
    "hand": "hand wrist palm",
    "pelvis": "pelvis",
    "spine": "spine lowerback back abdomen abdomenlower abdomenupper ab belly stomach waist torso chest "
    "chestlower chestupper upperchest thorax sternum lowerspine midspine upperspine spinebase spinemid "
    "spinechest spinenavel",
    "neck": "neck necktwist lowerneck upperneck necklower neckupper",
    "head": "head skull",
}
LIMB_PARTS = (*_PARTS,)[: list(_PARTS).index("hand") + 1]
"""Parts of arms and legs."""

_PART = {word: part for part, words in _PARTS.items() for word in words.split()}

_SIDES = {"left": "left", "l": "left", "lft": "left", "right": "right", "r": "right", "rgt": "right"}
_FILLERS = ("joint", "jnt", "jt", "bone", "bn")
"""Words after a name that say nothing."""

_NO_BODY = {
    "ik", "fk", "ctrl", "control", "pole", "target", "effector", "dummy", "end", "nub", "site", "twist",
    "roll", "prop", "attach", "weapon", "socket", "marker", "helper", "aux",
}  # fmt: skip
"""Words in names of joints that are no part of the body, or only a share of one."""

_VERTEBRA = re.compile(r"[lt]\d{1,2}")
_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


class Meaning(NamedTuple):
    """Meaning of a joint's name."""

    part: str
    """A key of `_PARTS`."""
    side: str
    """"left", "right" or "" if the name tells none."""


def is_helper(name: str) -> bool:
    """Return whether a name is that of a joint beside the skeleton, such as a dummy or a twist bone."""
    if "necktwist" in _letters(name):  # a neck, in spite of its name
        return False
    return bool(_NO_BODY & set(map(str.lower, _WORDS.findall(name)))) or name.lower().endswith("dummy")


def meaning(name: str) -> Meaning | None:
    """Return the meaning of a joint's name, None if it has no known word."""
    plain = without_namespace(name)
    if _VERTEBRA.fullmatch(plain.lower()):
        return Meaning("spine", "")
    parted = [word for word in re.split(r"[^A-Za-z0-9]+", plain) if word]
    for words in (parted, _WORDS.findall(plain)):
        for start in range(len(words)):
            for text in _without_fillers(_letters("".join(words[start:]))):
                found = _sided(text)
                if found is not None:
                    return None if is_helper(name) else found
    return None


def _letters(name: str) -> str:
    """Return the letters of a name in lower case."""
    return "".join(filter(str.isalpha, name)).lower()


def _without_fillers(text: str) -> Iterator[str]:
    yield text
    for filler in _FILLERS:
        if text.endswith(filler):
            yield text.removesuffix(filler)


def _sided(text: str) -> Meaning | None:
    """Return the meaning of lower-case letters such as `lefthand`, `handl` or `head`."""
    part = _PART.get(text)
    if part is not None:
        return Meaning(part, "")
    for word, side in _SIDES.items():
        for rest in (text.removeprefix(word), text.removesuffix(word)):
            part = None if rest == text else _PART.get(rest)
            if part is not None:
                return Meaning(part, side)
    return None
