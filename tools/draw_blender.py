"""Draws poses in Blender: those of a BVH file, or those that the add-on VMC4B receives.

Runs in a Python that has Blender's module: python -m venv venv && venv/bin/pip install bpy==5.0.1

    venv/bin/python tools/draw_blender.py walk.bvh --at 1 --at 7.2 --out blender-path.png
    venv/bin/python tools/draw_blender.py walk.bvh --vmc4b ADDONS --at 1 --out vmc-sitting.png

With --vmc4b the BVH file is the avatar: an armature in its rest pose, whose bones are named as with
`--bvh walk.bvh,names=unity`. ADDONS is the folder that holds VMC4B. What comes at port 39539 moves the
avatar, for example from `edgepose run --realtime --osc 127.0.0.1:39539`. The picture is drawn 3 s after the
last message.

Both print the heights of the pelvis and of the lowest joint of the feet, and how far the wearer came, metres.
"""

from __future__ import annotations

import argparse
import importlib
import itertools
import sys
import time
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

FPS = 60
END_S = 3.0
"""Time without a message after which nothing more is expected, seconds."""
FLOOR_M = -0.04
"""Height of the floor: sticks have a radius, joints of the toes are at height 0."""
COLOURS = {"left": (0.09, 0.46, 0.81), "right": (0.01, 0.045, 0.11), "": (0.02, 0.14, 0.34)}
THICK = ("hip", "knee", "spine", "neck", "pelvis", "leg", "chest")

Sticks = dict[str, list[tuple[Vector, Vector]]]
"""Ends of the sticks of a pose, by the bone that they start from."""


def sticks(armature: bpy.types.Object) -> Sticks:
    """Return the bones as they are now, in the world."""
    world, found = armature.matrix_world, {}
    for bone in armature.pose.bones:
        ends = [child.head for child in bone.children] or [bone.tail]
        found[bone.name] = [((world @ bone.head).copy(), (world @ end).copy()) for end in ends]
    return found


def heights_and_ground(pose: Sticks) -> tuple[float, float, float, float]:
    """Return x and y of the root, its height, and the height of the lowest joint of the feet."""
    root = next(iter(pose.values()))[0][0]
    feet = [ends[0][0].z for name, ends in pose.items() if name.lower().endswith(("foot", "toes", "ankle"))]
    return root.x, root.y, root.z, min(feet)


def from_file(armature: bpy.types.Object, at_s: list[float]) -> tuple[np.ndarray, list[Sticks]]:
    """Return root and feet (T, 4) of the armature's animation, and its poses at some times."""
    scene, rows = bpy.context.scene, []
    for frame in range(1, int(armature.animation_data.action.frame_range[1]) + 1, 3):
        scene.frame_set(frame)
        rows.append(heights_and_ground(sticks(armature)))
    poses = []
    for second in at_s:
        scene.frame_set(round(second * FPS) + 1)
        poses.append(sticks(armature))
    return np.array(rows), poses


def from_vmc4b(
    armature: bpy.types.Object, addons: Path, at_s: list[float]
) -> tuple[np.ndarray, list[Sticks]]:
    """Return root and feet (T, 4) of the avatar that VMC4B moves, and poses at some times of the sender."""
    sys.path.insert(0, str(addons))
    config, state = (importlib.import_module(f"VMC4B.core.{name}") for name in ("config", "state"))
    applier = importlib.import_module("VMC4B.core.applier").Applier()
    config.register()
    scene = bpy.context.scene
    armature.animation_data_clear()
    armature.data.pose_position = "POSE"
    scene.vmc4b_target_armature = armature.name
    for bone in config.human_body_bones_torso:
        if bone in armature.pose.bones:
            armature.pose.bones[bone].rotation_mode = "QUATERNION"
            setattr(scene, f"vmc4b_bones_{bone}", bone)
    state.config = config.Config()
    state.server.start("127.0.0.1", 39539)
    rows, poses, sender_s, heard = [], [], 0.0, None
    try:
        while heard is None or time.monotonic() < heard + END_S:
            while state.server.queue:
                item = state.server.queue.popleft()
                applier.update(item["address"], item["args"])
                heard = time.monotonic()
                if item["address"] == "/VMC/Ext/T":
                    sender_s = item["args"][0]
            bpy.context.view_layer.update()
            if heard is not None:
                pose = sticks(armature)
                rows.append(heights_and_ground(pose))
                if len(poses) < len(at_s) and sender_s >= at_s[len(poses)]:
                    poses.append(pose)
            time.sleep(0.02)
    finally:
        state.server.stop()
    return np.array(rows), poses


# --- picture ------------------------------------------------------------------------------------------------


def material(name: str, colour: tuple[float, float, float]) -> bpy.types.Material:
    """Return a new material."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    made.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (*colour, 1.0)
    return made


def stick(start: Vector, end: Vector, radius: float, colour: bpy.types.Material) -> None:
    """Add a cylinder with a ball at its start."""
    axis = end - start
    if axis.length > 1e-4:
        bpy.ops.mesh.primitive_cylinder_add(
            radius=radius, depth=axis.length, location=(start + end) / 2, vertices=16
        )
        made = bpy.context.object
        made.rotation_mode = "QUATERNION"
        made.rotation_quaternion = Vector((0.0, 0.0, 1.0)).rotation_difference(axis)
        made.data.materials.append(colour)
    bpy.ops.mesh.primitive_uv_sphere_add(radius=radius, location=start, segments=16, ring_count=8)
    bpy.context.object.data.materials.append(colour)


def draw(rows: np.ndarray, poses: list[Sticks], out: Path) -> None:
    """Draw poses and the path of the root on a floor, seen from the side."""
    colours = {side: material(side, colour) for side, colour in COLOURS.items()}
    for pose in poses:
        for name, ends in pose.items():
            side = next(side for side in COLOURS if name.lower().startswith(side))
            radius = 0.055 if any(word in name.lower() for word in THICK) else 0.04
            for start, end in ends:
                stick(start, end, radius, colours[side])
    path = rows[np.unique(np.linspace(0, len(rows) - 1, 150).round().astype(int)), :2]
    line = material("path", (0.85, 0.3, 0.02))
    for a, b in itertools.pairwise(path):
        stick(Vector((*a, FLOOR_M + 0.01)), Vector((*b, FLOOR_M + 0.01)), 0.012, line)
    bpy.ops.mesh.primitive_plane_add(size=60, location=(0, 0, FLOOR_M))
    bpy.context.object.data.materials.append(material("floor", (0.75, 0.75, 0.75)))
    roots = np.array([heights_and_ground(pose)[:2] for pose in poses])
    low, high = roots.min(axis=0), roots.max(axis=0)
    add_camera(Vector((*(low + high) / 2, 0.8)), float(np.linalg.norm(high - low)))
    render(out)


def add_camera(middle: Vector, span: float) -> None:
    """Add the camera, which looks along the -X axis of the room, and the light."""
    scene = bpy.context.scene
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    camera.location = middle + Vector((max(span * 1.2 + 3.0, 6.0), -1.2, 0.9))
    camera.rotation_euler = (middle - camera.location).to_track_quat("-Z", "Y").to_euler()
    sun = bpy.data.lights.new("sun", "SUN")
    sun.energy = 3.0
    light = bpy.data.objects.new("sun", sun)
    light.rotation_euler = (0.6, 0.4, 0.3)
    scene.collection.objects.link(light)
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    background = scene.world.node_tree.nodes["Background"]
    background.inputs[0].default_value = (1.0, 1.0, 1.0, 1.0)
    background.inputs[1].default_value = 0.8


def render(out: Path) -> None:
    """Write the picture."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 16, True
    scene.render.resolution_x, scene.render.resolution_y = 800, 370
    scene.view_settings.view_transform = "Standard"
    scene.render.image_settings.file_format = "PNG"
    scene.render.filepath = str(out.resolve())
    bpy.ops.render.render(write_still=True)


def main() -> None:
    """Read or receive poses, print their heights, and draw some of them."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("bvh", type=Path)
    parser.add_argument("--vmc4b", type=Path, metavar="ADDONS", help="folder that holds VMC4B")
    parser.add_argument("--at", type=float, action="append", required=True, help="seconds since the start")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = FPS
    bpy.ops.import_anim.bvh(filepath=str(given.bvh), global_scale=0.01, update_scene_fps=True)
    armature = next(o for o in bpy.context.scene.objects if o.type == "ARMATURE")
    if given.vmc4b:
        rows, poses = from_vmc4b(armature, given.vmc4b, given.at)
    else:
        rows, poses = from_file(armature, given.at)
    away_m = np.linalg.norm(rows[:, :2] - rows[0, :2], axis=1)
    print(
        f"Blender {bpy.app.version_string}: {len(rows)} poses, farthest {away_m.max():.2f} m from the start"
    )
    print(f"height of the pelvis {rows[:, 2].min():.3f} to {rows[:, 2].max():.3f} m")
    print(f"height of the lowest joint of the feet {rows[:, 3].min():.3f} to {rows[:, 3].max():.3f} m")
    for second, pose in zip(given.at, poses, strict=False):
        *_, pelvis, feet = heights_and_ground(pose)
        print(f"at {second:g} s: pelvis {pelvis:.3f}, feet {feet:.3f} m")
    draw(rows, poses, given.out)


if __name__ == "__main__":
    main()
