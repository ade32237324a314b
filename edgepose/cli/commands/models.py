"""`edgepose models`: list model archives, show their cards."""

from __future__ import annotations

import json
import textwrap
from pathlib import Path
from typing import Any

import click

from edgepose.cli.options.json_result import json_option, show_json
from edgepose.cli.terminal.messages import show
from edgepose.inference import archive


@click.command()
@click.argument("names", nargs=-1, metavar="[NAME|PATH]...")
@click.option(
    "--trust",
    is_flag=True,
    help="Add the archives' SHA-256 checksums to your own list, so that `run` loads them.",
)
@json_option
def models(names: tuple[str, ...], trust: bool, as_json: bool) -> None:
    """List the shipped model archives, or show the cards of archives. No code in an archive is run.

    \b
    Examples:
      edgepose models
      edgepose models birnn
      edgepose models --trust my-model.pt
    """
    if trust and not names:
        raise click.UsageError("--trust needs the PATH of an archive")
    paths = [archive.find_archive(name) for name in names]
    if as_json:
        infos = [archive.trust(path) if trust else archive.read_info(path) for path in paths or _bundled()]
        show_json("models", {"models": [_values(info) for info in infos]})
        return
    if not names:
        _list()
    for path in paths:
        _show(archive.trust(path) if trust else archive.read_info(path))


def _bundled() -> list[Path]:
    return list(archive.bundled_archives())


def _values(info: archive.ArchiveInfo) -> dict[str, Any]:
    return {
        "name": info.path.stem,
        "file": info.path,
        "bytes": info.path.stat().st_size,
        "sha256": info.sha256,
        "trusted": info.trusted,
        "metadata": info.metadata,
    }


_WIDTH = 80
"""Columns of a terminal."""


def _list() -> None:
    rows = [("name", "kind", "units", "frames", "size", "trained on")]
    for path in _bundled():
        about = archive.read_info(path).metadata
        frames = (
            f"{about['past']} past, {about['future']} future"
            if about["past"] or about["future"]
            else "1, no look-ahead"
        )
        size = f"{path.stat().st_size / 1e6:.1f} MB"
        rows.append(
            (path.stem, about["kind"], str(about["hidden"]), frames, size, about["training"]["summary"])
        )
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    indent = sum(widths[:-1]) + 2 * len(widths[:-1])
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row[:-1], widths[:-1], strict=True)]
        first, *rest = textwrap.wrap(row[-1], _WIDTH - indent) or [""]
        show("\n".join(["  ".join([*cells, first]).rstrip(), *(" " * indent + line for line in rest)]))


def _show(info: archive.ArchiveInfo) -> None:
    card = info.path.with_suffix(".md")
    if info.path.parent == archive.MODELS and card.is_file():
        show(card.read_text(encoding="utf-8").rstrip())
    else:
        for key, value in info.metadata.items():
            # JSON, so that text from an untrusted file cannot control the terminal.
            show(f"{json.dumps(key)[1:-1]}: {json.dumps(value)}")
    show(f"\nfile: {Path(info.path)}\nsha256: {info.sha256}\ntrusted: {'yes' if info.trusted else 'no'}")
