#!/usr/bin/env python3
"""Write poses to all outputs at once, at a fixed rate, and count what arrives.

    python tools/bench_outputs.py --rate 1000 --seconds 10

Receivers run in a process of their own. With --dead each output over the network has a second target that is
dead: an address at which nothing listens, a viewer that connects and never reads. Prints for each output the
median processor time of a pose, and how many of its messages arrived; ends with 1 if some were lost.
"""

from __future__ import annotations

import argparse
import multiprocessing
import socket
import sys
import tempfile
import time
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from edgepose.config import OutputConfig
from edgepose.formats.bvh import read_bvh
from edgepose.formats.poses.registry import read_poses
from edgepose.pose import CONTACTS, PoseFrame
from edgepose.rotations import rotvec_to_matrix
from edgepose.sinks.base import Sink
from edgepose.sinks.open import open_outputs

DATAGRAMS = {"udp": 1, "osc": 2, "vrchat": 1, "mocopi": 1}
"""Datagrams that each output sends for a pose."""


def free_port(kind: socket.SocketKind) -> int:
    """Return a free port of this machine."""
    with socket.socket(socket.AF_INET, kind) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def receive(addresses: dict[str, int], viewer: int, ready, done, counts) -> None:
    """Count datagrams by address, and the poses that a viewer gets, until 0.3 s after `done`."""
    sockets = {}
    for name, port in addresses.items():
        sockets[name] = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sockets[name].setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 23)
        sockets[name].bind(("127.0.0.1", port))
        sockets[name].setblocking(False)
    found = dict.fromkeys([*addresses, "tcp"], 0)
    ready.set()
    stream = None
    end_s = float("inf")
    while time.monotonic() < end_s:
        for name, each in sockets.items():
            try:
                while each.recv(65536):
                    found[name] += 1
            except BlockingIOError:
                pass
        try:
            stream = stream or socket.create_connection(("127.0.0.1", viewer), 0.1)
            stream.setblocking(False)
            found["tcp"] += stream.recv(1 << 20).count(b"$")
        except (BlockingIOError, ConnectionRefusedError):
            pass
        if done.is_set():
            end_s = min(end_s, time.monotonic() + 0.3)
        time.sleep(0.001)
    counts.put(found)


def motion(count: int, rate: float) -> list[PoseFrame]:
    """Return poses of a body whose joints swing while it walks ahead."""
    rng = np.random.default_rng(1)
    axes = rng.normal(size=(24, 3)) * 0.4
    poses = []
    for i in range(count):
        rotations = rotvec_to_matrix(axes * np.sin(2.0 * np.pi * i / rate)).astype(np.float32)
        place, contacts = np.array([0.0, 0.95, i / rate]), np.full(len(CONTACTS), 0.5, np.float32)
        std = np.zeros(24, np.float32)
        poses.append(PoseFrame(i, 1.7e9 + i / rate, rotations, std, place, frozenset(), False, contacts))
    return poses


def outputs(folder: Path, ports: dict[str, int], viewer: int, dead: bool) -> OutputConfig:
    """Return all outputs; their files are in a folder."""
    given: dict[str, list[str]] = {
        name: [str(folder / f"poses.{name}")] for name in ("csv", "npz", "bvh", "glb", "sto", "mot")
    }
    given |= {name: [f"127.0.0.1:{port}"] for name, port in ports.items()}
    given["tcp"] = [f"127.0.0.1:{viewer}"]
    if find_spec("pylsl") is not None:
        given["lsl"] = ["edgepose bench"]
    if dead:
        for name in DATAGRAMS:
            given[name].append(f"127.0.0.1:{free_port(socket.SOCK_DGRAM)}")
    return OutputConfig(**given)


def write(
    sinks: list[Sink], poses: list[PoseFrame], rate: float
) -> tuple[dict[str, list[float]], list[float]]:
    """Write the poses at a rate; return processor time by output, and lateness by pose, seconds."""
    spent: dict[str, list[float]] = {type(sink).__name__: [] for sink in sinks}
    late = []
    start_s = time.perf_counter() + 0.2
    for i, pose in enumerate(poses):
        time.sleep(max(0.0, start_s + i / rate - time.perf_counter()))
        before_s = time.thread_time()
        for sink in sinks:
            sink.write(pose)
            after_s = time.thread_time()
            spent[type(sink).__name__].append(after_s - before_s)
            before_s = after_s
        late.append(time.perf_counter() - start_s - i / rate)
    return spent, late


def main() -> int:
    """Run the benchmark; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rate", type=float, default=1000.0, help="poses a second")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--dead", action="store_true", help="add dead receivers")
    args = parser.parse_args()
    count = round(args.rate * args.seconds)
    poses = motion(count, args.rate)
    ports = {name: free_port(socket.SOCK_DGRAM) for name in DATAGRAMS}
    viewer = free_port(socket.SOCK_STREAM)
    ready, done, counts = multiprocessing.Event(), multiprocessing.Event(), multiprocessing.Queue()
    process = multiprocessing.Process(target=receive, args=(ports, viewer, ready, done, counts))
    process.start()
    ready.wait()
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        config = outputs(Path(folder), ports, viewer, args.dead)
        sinks = open_outputs(stack, config, args.rate, translation=True, contacts=True)
        if args.dead:
            stack.enter_context(socket.create_connection(("127.0.0.1", viewer)))  # never reads
        time.sleep(0.5)  # for the viewer to connect
        spent, late = write(sinks, poses, args.rate)
        done.set()
        found = counts.get()
        process.join()
        for sink in sinks:
            sink.close()
        found |= {name: len(read_poses(Path(folder) / f"poses.{name}").frames) for name in ("csv", "npz")}
        found["bvh"] = len(read_bvh(Path(folder) / "poses.bvh").rotations)
    print("| output | us a pose | arrived |\n|---|---|---|")
    lost = False
    medians_us = {name: 1e6 * float(np.median(seconds)) for name, seconds in spent.items()}
    for name, median_us in medians_us.items():
        flag = {"VmcSink": "osc"}.get(name, name.removesuffix("Sink").lower())
        wanted = count * DATAGRAMS.get(flag, 1)
        share = f"{min(found[flag], wanted)} of {wanted}" if flag in found else "-"
        lost |= flag in found and found[flag] < wanted
        print(f"| {flag} | {median_us:.0f} | {share} |")
    p99, most = np.percentile(np.array(late) * 1e3, [99, 100])
    print(f"| all | {sum(medians_us.values()):.0f} | |\n")
    print(f"lateness {p99:.1f} ms p99, {most:.1f} ms max at {args.rate:g} poses a second")
    return int(lost)


if __name__ == "__main__":
    sys.exit(main())
