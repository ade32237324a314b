"""Whole files of the kinds that training, evaluation and `bench` read, and the commands that read them."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from fuzz_process import Ended

DATA = Path(__file__).parents[1] / "tests" / "data"

CONFIG = """steps = 2
sequences = 2
window = 20
validate_every = 1
learning_rate = 0.001
averaging = 0.9

[network]
kind = "rnn"
hidden = 8
targets = "global-6d"
measured = "passed"

[shares]
cmu = 0.25

[augmentation]
heading_deg = 4.0
"""

TAKES = ("dataset-2_walk_normal_001", "dataset-2_raise-up-right-hand_normal_001")

TRAIN = "train --config {seeds}/config.toml --data {seeds}/takes --out {out} --threads 1"

Commands = tuple[str, ...]


def training_seeds(
    folder: Path, run: Callable[[list[str], Path], Ended]
) -> Iterator[tuple[str, Path, Commands, str | None]]:
    """Yield name, seed, commands, and the entry of the folder, as in `fuzz_seeds.Kind`."""
    takes = folder / "takes"
    sources = [str(DATA / "mocap" / f"{name}.bvh") for name in TAKES]
    run(["synthesize", *sources, "--out", str(takes), "--rate", "60"], folder)
    shutil.copy(takes / f"{TAKES[0]}.npz", takes / "07_01.npz")
    (folder / "config.toml").write_text(CONFIG)
    trained = folder / "trained"
    words = TRAIN.format(seeds=folder, out=trained).split()
    ended = run(words, folder)
    if ended.code:
        raise RuntimeError(ended.errors)
    export = "export {file} --out {out}/new.pt"
    yield "checkpoint", trained / "best.pt", (export, f"{TRAIN} --init {{file}}"), None
    yield "config", folder / "config.toml", (TRAIN.replace("{seeds}/config.toml", "{file}"),), None
    evaluate = "evaluate --model rnn --online stream --data {file} --part"
    train = TRAIN.replace("{seeds}/takes", "{file}")
    yield "takes", takes, (train, f"{evaluate} all"), ""
    published = folder / "published"
    published.mkdir()
    take = {"gt": np.zeros((40, 72)), "imu_acc": np.zeros((40, 17, 3))}
    take["imu_ori"] = np.tile(np.eye(3), (40, 17, 1, 1))
    (published / "s_09_01.pkl").write_bytes(pickle.dumps(take, 2))
    yield "published", published, (f"{evaluate} published",), ""
    broad = folder / "broad"
    broad.mkdir()
    name = "07_undisturbed_fast_rotation_B_95Hz.npz"
    with np.load(DATA / "broad" / name) as arrays:
        start = int(np.argmax(arrays["movement"])) - 50
        cut = {key: array[start:][:200] if array.ndim else array for key, array in arrays.items()}
    np.savez(broad / name, **cut)
    yield "broad", broad, ("bench orientation --data {file} --json",), ""
