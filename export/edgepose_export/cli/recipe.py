"""`edgepose train --recipe`: from folders of raw motion to an archive and its card, in one resumable run."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from edgepose.cli.terminal.messages import say
from edgepose.errors import EdgeposeError
from edgepose.utils.durable_files import write_whole
from edgepose_export.cli.export import export
from edgepose_export.cli.recording_jobs import motion_files
from edgepose_export.cli.synthesize import NotAllConvertedError, Request, synthesize
from edgepose_export.training.sources import OWN, TakeInfo, take_info

if TYPE_CHECKING:
    from edgepose_export.mocap.zeroing import Zero
    from edgepose_export.training.recipes import Recipe, Recordings

STATE = "run.json"


class Work:
    """The folder of a run, with the steps that are done.

    Attributes:
        folder: recordings, packed takes, stages, archive and card are below it.
        done: names of the steps that are done.
        lost: number of motion files that could not be converted, by step.
    """

    def __init__(self, folder: Path, recipe: Recipe, mocap: tuple[Path, ...]) -> None:
        """Open a folder, new or of an earlier call.

        Raises:
            EdgeposeError: it is in use by another run, or cannot be written.
        """
        self.folder, self._state = folder, folder / STATE
        about = {"recipe": recipe.name, "sha256": recipe.sha256, "mocap": [str(p.resolve()) for p in mocap]}
        try:
            before = json.loads(self._state.read_text(encoding="utf-8"))
            changed = [key for key in about if before[key] != about[key]]
            self.done, self.lost = list(before["done"]), dict(before["lost"])
        except FileNotFoundError:
            if folder.exists() and any(folder.iterdir()):
                raise EdgeposeError(
                    f"{folder}: holds files, but no run of a recipe; give another --out"
                ) from None
            changed, self.done, self.lost = [], [], {}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise EdgeposeError(f"{self._state}: cannot be read ({error}); give another --out") from error
        if changed:
            what = "other folders of motion" if changed == ["mocap"] else "another recipe, or version of it"
            raise EdgeposeError(f"{folder}: was begun with {what}; give another --out")
        self._about = about
        folder.mkdir(parents=True, exist_ok=True)
        self._write()

    def finish(self, step: str, lost: int = 0) -> None:
        """Note that a step is done, and how many motion files it lost."""
        self.done.append(step)
        if lost:
            self.lost[step] = lost
        self._write()

    def _write(self) -> None:
        state = self._about | {"done": self.done, "lost": self.lost}
        write_whole(self._state, json.dumps(state, indent=1), "the state of the run", overwrite=True)


def run_recipe(name: str, mocap: tuple[Path, ...], out: Path, threads: int) -> None:
    """Make all that a recipe asks for which is not there yet.

    Raises:
        EdgeposeError: a step fails; motion files that cannot be converted are reported at the end.
    """
    from edgepose_export.training.recipes import option_words, read_recipe, recipe_path

    recipe = read_recipe(recipe_path(name))
    _check_options(recipe)
    work = Work(out, recipe, mocap)
    archive = out / f"{recipe.name}.pt"
    recordings = [one for one in recipe.recordings if _step(one) not in work.done]
    if recordings:
        takes = wanted_takes(recipe, mocap)
        zeros: dict[str, Zero] = {}
        for one in recordings:
            _make_recordings(one, takes, mocap, work, zeros, threads)
    _train_stages(recipe, work, threads)
    if "export" not in work.done or not (archive.exists() and archive.with_suffix(".md").exists()):
        checkpoints = [str(_stage_folder(work, stage) / "checkpoint.pt") for stage in recipe.average]
        words = ["--out", str(archive), "--measure", str(out / "recordings"), "--overwrite"]
        export.main(
            [*checkpoints, *words, *option_words(recipe.export)], standalone_mode=False, obj=recipe.name
        )
        work.finish("export")
    say(f"{archive} is complete; run it with edgepose run --model {archive} --trust")
    if work.lost:
        raise EdgeposeError(
            f"{archive.name} was made without {max(work.lost.values())} motion files that could not be "
            "converted; see the messages that begin with 'skipped'"
        )


def _step(recordings: Recordings) -> str:
    return f"recordings {recordings.folder}"


def _stage_folder(work: Work, stage: str) -> Path:
    return work.folder / "stages" / stage


def _check_options(recipe: Recipe) -> None:
    """Raise EdgeposeError if options of the recipe are none of the commands that get them."""
    from edgepose_export.training.recipes import option_words

    here = [".", "--out", "."]
    calls = [(synthesize, f"recordings {one.folder}", [*here, *one.words()]) for one in recipe.recordings]
    calls.append((export, "export", [".", "--out", "model.pt", *option_words(recipe.export)]))
    for command, where, words in calls:
        try:
            command.make_context(command.name, words)
        except click.UsageError as error:
            raise EdgeposeError(f"recipe {recipe.name}, {where}: {error.format_message()}") from error


def wanted_takes(recipe: Recipe, mocap: tuple[Path, ...]) -> dict[Path, tuple[str, TakeInfo]]:
    """Return name and description of the motion files that a recipe uses; say what is missing or left out.

    A take that is there as .bvh and .amc is used once.

    Raises:
        EdgeposeError: there is none.
    """
    takes: dict[Path, tuple[str, TakeInfo]] = {}
    seen, others = set(), Counter[str]()
    for root in mocap:
        for path in sorted(motion_files(root), key=lambda path: (path.suffix.lower() != ".bvh", path)):
            below = path.relative_to(root if root.is_dir() else root.parent)
            name = (root.absolute().name / below).with_suffix("").as_posix()
            info = take_info(name)
            if info.part == "unused":
                continue
            if info.source.name not in recipe.sources:
                others[info.source.name] += 1
                continue
            key = (name if info.source.name == OWN else info.actor, path.stem)
            if key not in seen:
                seen.add(key)
                takes[path] = (name, info)
    found = Counter(info.source.name for _, info in takes.values())
    where = ", ".join(map(str, mocap))
    if not takes:
        raise EdgeposeError(f"{where}: no motion of the sources that recipe {recipe.name} uses")
    say(f"motion: {', '.join(f'{name} ({count} files)' for name, count in found.items())}")
    missing = [name for name in recipe.sources if name not in found and name not in (OWN, "amass")]
    if missing:
        say(f"recipe {recipe.name} uses {', '.join(missing)}, none found below {where}; going on without")
    if others:
        left_out = ", ".join(f"{name} ({count} files)" for name, count in others.items())
        say(f"recipe {recipe.name} does not use {left_out}")
    return takes


def _make_recordings(
    recordings: Recordings,
    takes: dict[Path, tuple[str, TakeInfo]],
    mocap: tuple[Path, ...],
    work: Work,
    zeros: dict[str, Zero],
    threads: int,
) -> None:
    chosen = frozenset(recordings.chosen(takes))
    lost = 0
    say(f"recordings {recordings.folder}: {len(chosen)} files")
    if chosen:
        folder = work.folder / "recordings" / recordings.folder
        words = [*map(str, mocap), "--out", str(folder), "--jobs", str(threads), "--resume"]
        try:
            synthesize.main([*words, *recordings.words()], standalone_mode=False, obj=Request(chosen, zeros))
        except NotAllConvertedError as error:
            say(f"{error}; going on without them")
            lost = error.count
    work.finish(_step(recordings), lost)


def _train_stages(recipe: Recipe, work: Work, threads: int) -> None:
    """Train the stages that are not done, each from the weights of the one before."""
    left = [stage for stage in recipe.stages if stage.name not in work.done]
    if not left:
        return
    import torch

    from edgepose_export.cli.train import Plan, train_on
    from edgepose_export.training.distributed import joined

    torch.set_num_threads(threads)
    before: Path | None = None
    for number, stage in enumerate(recipe.stages, 1):
        folder = _stage_folder(work, stage.name)
        if stage.name not in work.done:
            later = sum(one.work for one in recipe.stages[number:])
            plan = Plan(f"stage {number} of {len(recipe.stages)}, {stage.name}", stage.work, later)
            about: dict[str, Any] = {
                "run": stage.name,
                "recipe": {
                    "name": recipe.name,
                    "sha256": recipe.sha256,
                    "stages": [one.name for one in recipe.stages],
                },
            }
            resume = (folder / "checkpoint.pt").exists()
            with joined() as processes:
                train_on(
                    stage.config,
                    work.folder / "recordings",
                    folder,
                    processes,
                    about,
                    resume=resume,
                    init=None if resume else before,
                    cache=work.folder / "cache",
                    plan=plan,
                )
            work.finish(stage.name)
        before = folder / "checkpoint.pt"
