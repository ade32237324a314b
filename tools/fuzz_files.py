"""Damages files of every kind that edgepose reads, and runs the commands that read them.

Each case damages a whole file at random and runs one command on it in a process with limits: 10 s and 1 GB of
memory. Whatever the file holds, a command must end with exit code 0, or with 1, 2 or 3 and a message. It must
not write NaN or infinity, and not leave samples out without a message.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import random
import re
import shutil
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
from fuzz_mutations import damage_file, damage_folder, is_text
from fuzz_packets import FRAMINGS
from fuzz_process import LIMIT_BYTES, LIMIT_S, Ended, Lost, run_command, run_forked, supervised, warm_up
from fuzz_seeds import CONVERT, POSES, RECORDING, Kind, counted, make_kinds

TO_NPZ = CONVERT[0]

GOOD = ("ok", "refused")
"""Outcomes that are right."""

SLOW = ("bench", "evaluate", "export", "report", "run", "solve", "train")
"""Commands that take so long that they are chosen less often."""

SLOW_TURNS = 4
"""Kinds for which there are only such commands have one case in this number of turns."""

NOT_FINITE = re.compile(r"(?<![\w.:/\\-])-?(?:nan|inf|infinity)(?![\w.:/\\-])", re.IGNORECASE)
"""NaN or infinity as a value of a table."""


class Result(NamedTuple):
    """Result of a case.

    Attributes:
        outcome: one of GOOD, or what is wrong.
        detail: the last message.
        words: the command.
    """

    outcome: str
    detail: str
    words: list[str]


Case = tuple[Kind, int]
"""A kind of file, and the number of one of the ways to damage it."""


def not_finite(path: Path) -> str | None:
    """Return where an output has NaN or infinity; None if it has none."""
    if path.suffix == ".npz":
        with np.load(path) as arrays:
            sparse = set(arrays["sparse"].tolist()) if "sparse" in arrays.files else set()
            for key in set(arrays.files) - sparse:
                if arrays[key].dtype.kind == "f" and not np.isfinite(arrays[key]).all():
                    return f"{path.name}: {key}"
    elif path.suffix in (".csv", ".bvh"):
        # Metadata is text.
        text = re.sub(r"^#.*$", "", path.read_text(errors="replace"), flags=re.MULTILINE)
        found = NOT_FINITE.search(text)
        return found and f"{path.name}: {found[0]} at character {found.start()}"
    elif path.suffix == ".json" or path.name == "stdout":
        text = path.read_text(errors="replace")
        names: list[str] = []
        if text.startswith("{"):
            json.loads(text, parse_constant=names.append)
        return f"{path.name}: {names[0]}" if names else None
    return None


def judge(ended: Ended, out: Path, whole: int | None) -> tuple[str, str]:
    """Return the outcome of a command and its last message.

    Args:
        ended: the command.
        out: folder with its outputs.
        whole: number of samples or poses that it must have written to NPZ if it ends with exit code 0; None
            if that is unknown.
    """
    message = (ended.errors.strip().splitlines() or [""])[-1]
    if ended.seconds > LIMIT_S:
        return "hang", f"{ended.seconds:.0f} s"
    if ended.peak_bytes > LIMIT_BYTES:
        return "over memory", f"{ended.peak_bytes >> 20} MB"
    if "Traceback" in ended.errors:
        places = re.findall(r'File "[^"]*?([^/"]+)", line (\d+)', ended.errors)
        return "traceback", f"{message} ({':'.join(places[-1])})" if places else message
    if "unexpected error" in ended.errors + ended.out:
        return "unexpected error", next(
            line for line in (ended.errors + ended.out).splitlines() if "unexpected error" in line
        )
    if warned := re.search(r".*:\d+: \w*Warning: .*", ended.errors):
        return "warning of Python", warned[0]
    if ended.code not in (0, 1, 2, 3):
        return "other exit code", f"{ended.code}: {message}"
    if ended.code and not (message or ended.out):
        return "no message", ""
    for path in (out.parent / "stdout", *sorted(out.rglob("*"))):
        if path.is_file() and (bad := not_finite(path)):
            return "not finite", bad
    if not ended.code and whole is not None and (counted(out) or 0) < whole:
        return "silent loss", f"{counted(out)} of {whole}"
    return ("refused" if ended.code else "ok"), message


def notices_damage(kind: Kind) -> bool:
    """Whether a digit in the place of another can cost a sample only if the reader notices it.

    It does not if it may have to skip foreign lines or frames.
    """
    return kind.commands in (RECORDING, POSES) or kind.name in FRAMINGS


class Fuzzer:
    """Runs cases in a folder of their own, which is emptied before each."""

    def __init__(self, folder: Path, seed: int, keep: Path | None) -> None:
        """Write the whole files.

        Args:
            folder: an empty folder for all files.
            seed: of all random numbers.
            keep: folder for the files of cases that fail.
        """
        self._seeds = folder / "seeds"
        self._folder = folder / "case"
        self._seed, self._keep = seed, keep
        self._seeds.mkdir()
        self.kinds = make_kinds(self._seeds, run_forked)
        readable = [kind for kind in self.kinds.values() if notices_damage(kind)]
        counts = supervised(self._count_whole, readable)
        # The first packet of a capture may look like the end of one that began before it.
        self._whole = {
            kind.name: count - (kind.name in FRAMINGS) for kind, count in counts if isinstance(count, int)
        }

    def run(self, case: Case) -> Result:
        """Run a case."""
        kind, number = case
        rng = random.Random(f"{self._seed} {kind.name} {number}")
        weights = [1 if command.split()[0] in SLOW else 6 for command in kind.commands]
        (command,) = rng.choices(kind.commands, weights)
        target = self._prepare(kind)
        whole = self._whole.get(kind.name) if command.startswith(TO_NPZ) else None
        if whole is not None and not self._keeps_all(rng, target):
            whole = None
        if whole is None:
            (damage_folder if target.is_dir() else damage_file)(rng, target)
        words = self._words(kind, command)
        ended = run_command(words, self._folder)
        try:
            result = Result(*judge(ended, self._folder / "out", whole), words)
        # Whatever a reader raises about an output that is not whole.
        except Exception as error:
            result = Result("unreadable output", repr(error), words)
        if result.outcome not in GOOD:
            self.keep(case)
        return result

    def keep(self, case: Case) -> None:
        """Copy the files of the last case, if they are to be kept."""
        if self._keep is not None:
            target = self._keep / f"{case[0].name}-{case[1]}"
            shutil.rmtree(target, ignore_errors=True)
            shutil.copytree(self._folder, target, symlinks=True)

    def _keeps_all(self, rng: random.Random, target: Path) -> bool:
        """Damage single digits of a text; return False for files that are not text."""
        paths = sorted(path for path in target.rglob("*") if path.is_file()) if target.is_dir() else [target]
        path = rng.choice(paths)
        content = bytearray(path.read_bytes())
        places = [place.start() for place in re.finditer(rb"\d", bytes(content))]
        if rng.random() < 0.5 or not is_text(bytes(content)) or not places:
            return False
        for place in rng.sample(places, min(len(places), rng.choice((1, 1, 5)))):
            content[place] = rng.choice(b"0123456789 .-x")
        path.write_bytes(content)
        return True

    def _count_whole(self, kind: Kind) -> int | None:
        """Return the number of samples or poses that `convert` makes of the whole file."""
        self._prepare(kind)
        ended = run_command(self._words(kind, kind.commands[0]), self._folder)
        return None if ended.code else counted(self._folder / "out")

    def _prepare(self, kind: Kind) -> Path:
        """Copy the whole file; return what is to be damaged."""
        shutil.rmtree(self._folder, ignore_errors=True)
        (self._folder / "out").mkdir(parents=True)
        target = self._folder / kind.seed.name
        if kind.seed.is_dir():
            return Path(shutil.copytree(kind.seed, target))
        return Path(shutil.copy(kind.seed, target))

    def _words(self, kind: Kind, command: str) -> list[str]:
        """Return the words of a command on the case's file."""
        file = self._folder / kind.seed.name
        names = {"file": file if kind.inside is None else file / kind.inside, "out": self._folder / "out"}
        return [word.format(seeds=self._seeds, **names) for word in command.split()]


def cases(kinds: dict[str, Kind], only: tuple[str, ...], number: int | None, count: int) -> list[Case]:
    """Return cases, one of each kind in turn, of slow ones rarely; or the case of one number of each kind."""
    chosen = [kinds[name] for name in only or kinds]
    if number is not None:
        return [(kind, number) for kind in chosen]
    turns = (
        (kind, turn)
        for turn in itertools.count()
        for kind in chosen
        if only or turn % SLOW_TURNS == 0 or not all(command.split()[0] in SLOW for command in kind.commands)
    )
    return list(itertools.islice(turns, count))


def fuzz(fuzzer: Fuzzer, chosen: list[Case]) -> Counter[str]:
    """Run cases, up to Ctrl-C; print those that fail and return the number of each outcome."""
    counts: Counter[str] = Counter()
    with contextlib.suppress(KeyboardInterrupt):
        for case, result in supervised(fuzzer.run, chosen):
            if isinstance(result, Lost):
                fuzzer.keep(case)
                outcome = "hang" if result.code is None else "killed"
                result = Result(outcome, "" if result.code is None else f"exit code {result.code}", [])
            counts[result.outcome] += 1
            if result.outcome not in GOOD:
                print(f"{case[0].name}-{case[1]}: {result.outcome}: {result.detail[:300]}")
                print(f"    {' '.join(result.words)}", flush=True)
    return counts


@click.command(help=__doc__)
@click.option(
    "--cases", "count", type=click.IntRange(1), default=1000, show_default=True, help="Damaged files."
)
@click.option("--seed", type=int, default=0, show_default=True, help="Another seed damages in other ways.")
@click.option("--only", multiple=True, metavar="KIND", help="Kind of file; repeatable.  [default: all]")
@click.option("--case", type=click.IntRange(0), help="Run only the case of this number of each kind.")
@click.option("--keep", type=click.Path(path_type=Path), help="Folder for the files of cases that fail.")
@click.option("--kinds", "list_kinds", is_flag=True, help="List the kinds of files.")
def main(
    count: int, seed: int, only: tuple[str, ...], case: int | None, keep: Path | None, list_kinds: bool
) -> None:
    """Run the command line."""
    warnings.simplefilter("ignore")
    warm_up()
    with tempfile.TemporaryDirectory() as folder:
        fuzzer = Fuzzer(Path(folder), seed, keep)
        if list_kinds:
            print(*fuzzer.kinds, sep="\n")
            return
        start = time.monotonic()
        counts = fuzz(fuzzer, cases(fuzzer.kinds, only, case, count))
        seconds = time.monotonic() - start
    print(", ".join(f"{number} {outcome}" for outcome, number in counts.most_common()))
    print(f"{counts.total()} cases of {len(only or fuzzer.kinds)} kinds in {seconds:.0f} s")
    sys.exit(any(outcome not in GOOD for outcome in counts))


if __name__ == "__main__":
    main()
