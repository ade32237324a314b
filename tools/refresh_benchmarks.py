"""Measures speed on this machine, and writes the tables and the picture of the pages about speed.

\b
    python tools/refresh_benchmarks.py                     # eight minutes; run nothing else meanwhile
    python tools/refresh_benchmarks.py --from speed.json   # write the pages from earlier measurements

Runs `edgepose bench`, bench_sizes.py and bench_wearers.py, keeps their figures in one file, and writes the
tables that stand between two comments, `table NAME: made by tools/refresh_benchmarks.py` and `end of table`.
Tables without such comments compare revisions, or took an hour, and stay.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import click

from edgepose.benchmarks.speed import BUDGET_US
from edgepose.cli.speed_tables import tables_of

ROOT = Path(__file__).resolve().parents[1]
PAGES = (ROOT / "docs/reference/performance.md", ROOT / "docs/research/speed.md")
PICTURE = ROOT / "docs/images/wearers.png"

_BLOCK = re.compile(
    r"(<!-- table (\w+): made by tools/refresh_benchmarks\.py -->\n).*?(<!-- end of table -->)", re.DOTALL
)


def measure() -> dict[str, Any]:
    """Run the benchmarks, and draw the picture.

    Raises:
        click.ClickException: one of them fails.
    """
    tools = ROOT / "tools"
    report = json.loads(_output("-m", "edgepose", "bench", "--json"))
    report["sizes"] = json.loads(_output(str(tools / "bench_sizes.py"), "--json"))["models"]
    report["wearers"] = _output(str(tools / "bench_wearers.py"), "--draw", str(PICTURE)).splitlines()
    return report


def _output(*words: str) -> str:
    """Return what a Python program prints."""
    click.echo(f"running {' '.join(words)}", err=True)
    process = subprocess.run([sys.executable, *words], stdout=subprocess.PIPE, text=True, check=False)
    if process.returncode:
        raise click.ClickException(f"{words[0]} failed with exit code {process.returncode}; no page changed")
    return process.stdout


def page_tables(report: dict[str, Any]) -> dict[str, str]:
    """Return all tables by name, each with a line break at its end."""
    shipped = tables_of(report, BUDGET_US)
    everything = tables_of(report | {"models": report["models"] + report["sizes"]}, BUDGET_US)
    tables = shipped | {name: everything[name] for name in ("networks", "start")}
    tables["wearers"] = [line for line in report["wearers"] if line.startswith("|")]
    return {name: "\n".join(lines) + "\n" for name, lines in tables.items()}


def with_tables(text: str, tables: dict[str, str]) -> str:
    """Return a page with its tables of these names made again.

    Raises:
        KeyError: the page names another table.
    """
    return _BLOCK.sub(lambda block: block[1] + tables[block[2]] + block[3], text)


@click.command(help=__doc__)
@click.option("--from", "earlier", type=click.Path(path_type=Path), help="Figures measured earlier.")
@click.option(
    "--out", type=click.Path(path_type=Path), default="speed.json", show_default=True, help="Figures to keep."
)
def main(earlier: Path | None, out: Path) -> None:
    """Run the command line."""
    if earlier is not None:
        report = json.loads(earlier.read_text(encoding="utf-8"))
    else:
        report = measure()
        out.write_text(json.dumps(report, indent=1), encoding="utf-8")
    tables = page_tables(report)
    for page in PAGES:
        before = page.read_text(encoding="utf-8")
        after = with_tables(before, tables)
        page.write_text(after, encoding="utf-8")
        click.echo(f"{page.relative_to(ROOT)}: {'changed' if after != before else 'up to date'}")


if __name__ == "__main__":
    main()
