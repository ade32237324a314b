"""Model cards: pages beside archives with network, training data, licences, accuracy and commands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from edgepose.inference.archive import is_windowed
from edgepose_export.evaluation.real_wearers import cells
from edgepose_export.evaluation.uncertainty import EXPECTED
from edgepose_export.networks.registry import NETWORKS
from edgepose_export.training.sources import ABOUT, GROUPS

_INPUTS = {
    "root": "in the pelvis frame",
    "tilt": "in the pelvis frame, with the tilt and acceleration of the pelvis itself",
    "heading": "without the heading of the pelvis",
    "sequence": "in the pelvis frame of the first frame",
}


def card(metadata: dict[str, Any]) -> str:
    """Return an archive's card as Markdown, made from its metadata alone."""
    lines = [f"# {metadata['name']}", "", *_summary(metadata), ""]
    if metadata.get("real"):
        lines += _real_wearers(metadata)
    if metadata["measures"]:
        lines += _accuracy(metadata)
    return "\n".join([*lines, *_reproduction(metadata), ""])


def _summary(metadata: dict[str, Any]) -> list[str]:
    """Return the list at the top: network, input, targets, training data, licences, version."""
    kind = NETWORKS[metadata["kind"]].card.format(
        past=metadata["past"],
        future=metadata["future"],
        hidden=metadata["hidden"],
        latency=1e3 * metadata["future"] / metadata["rate_hz"],
    )
    training = metadata["training"]
    return [
        f"- Network: {kind}, {metadata['parameters'] / 1e6:.2f} million weights"
        f"{', rounded to about one part in a hundred' if metadata.get('rounded') else ''}.",
        f"- Input: calibrated orientations{' and accelerations' if metadata['acceleration'] else ''} of "
        f"{', '.join(metadata['placements'])} at {metadata['rate_hz']:g} Hz, "
        f"{_INPUTS[metadata['normalisation']]}.",
        f"- Targets: {metadata['targets']}; bones that carry a sensor are {metadata['measured_bones']}"
        f"{_smoothing(metadata)}.",
        *_place(metadata),
        f"- Trained on: {training['summary']}; {training['takes']} takes, {training['hours']:.2f} h, "
        f"{training['steps']} steps{_mean(training)}.",
        "- Licences of the motion data:",
        *(f"  - {text}" for text in training["licenses"]),
        f"- Weights: {_use(training.get('free'))} The code of edgepose is MIT.",
        f"- Exported by edgepose {metadata['edgepose']}, revision {metadata['revision'] or 'unknown'}.",
    ]


def _real_wearers(metadata: dict[str, Any]) -> list[str]:
    """Return the section with the measures on real wearers."""
    lines = [
        "## Accuracy on real wearers",
        "",
        "Mean ± standard deviation on recordings of real sensors. The walker's errors are those against "
        "further sensors on the same bones. The count is that of frames, or of strides where the unit is Hz. "
        "The last rows need no network. `edgepose evaluate --real` explains them and measures again.",
        "",
    ]
    for title, table in metadata["real"].items():
        head, *rows = cells(title, table)
        lines += [f"### {title}", "", _row(head), "|" + "---|" * len(head), *map(_row, rows), ""]
    return lines


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _use(free: dict[str, bool] | None) -> str:
    """Return what the weights may be used for, from the sources of their motion."""
    if not free:
        return "it is not recorded whether they are free for any use; the licences above decide."
    bound = [name for name, is_free in free.items() if not is_free]
    if not bound:
        return "free for any use, with the acknowledgements that the licences above ask for."
    return f"not free for any use, because of the motion of {', '.join(bound)}; see the licences above."


def _about(part: str) -> str:
    """Return what the takes of a part of the split are."""
    if part == "validation":
        return "the takes by which the end of training was chosen"
    return ABOUT.get(part) or f"the parts {', '.join(GROUPS[part])} together"


def _accuracy(metadata: dict[str, Any]) -> list[str]:
    """Return the section with the measures on held-out takes."""
    lines = [
        "## Accuracy on held-out motion",
        "",
        "Mean ± standard deviation over all frames, with synthetic sensors on held-out takes. Position "
        "errors are on the default body.",
        "",
    ]
    for part, rows in metadata["measures"].items():
        lines += [f"### {part}", "", *_table(rows), ""]
    return [
        *lines,
        *_deviations(metadata["deviations"]),
        *_places(metadata.get("place_accuracy", {})),
        *_precisions(metadata["precisions"]),
        f"The parts: {'; '.join(f'`{part}` is {_about(part)}' for part in metadata['measures'])}. "
        "No training has seen any of these takes.",
        "",
    ]


def _reproduction(metadata: dict[str, Any]) -> list[str]:
    """Return the section with the commands that made the archive, as far as they are recorded."""
    training = metadata["training"]
    runs = [*training.get("earlier", ()), {"run": training.get("run"), "steps": training["steps"]}]
    recipe = training.get("recipe")
    commands, notes = _by_recipe(recipe, runs) if recipe else _by_configs(runs)
    if not training.get("exported_by_recipe"):
        last = f"RUN/stages/{runs[-1]['run']}" if recipe else "RUN"
        commands.append(_export_command(metadata, last))
        if training.get("checkpoints", 1) > 1:
            notes.append("OTHERS are the checkpoints that were averaged with it.")
    return ["## Reproduce", "", "```", *commands, "```", "", " ".join(notes)]


def _by_recipe(recipe: dict[str, Any], runs: list[dict[str, Any]]) -> tuple[list[str], list[str]]:
    """Return the command and notes for training by a recipe."""
    notes = [
        "MOCAP are folders with the motion named above. The recipe, with the configs that it builds on, has "
        f"the checksum {recipe['sha256'][:16]}. {_list_of(runs)}"
    ]
    missing = [name for name in recipe["stages"] if name not in [run["run"] for run in runs]]
    if missing:
        notes.append(f"Its stages {', '.join(missing)} were not run.")
    return [f"edgepose train --recipe {recipe['name']} MOCAP... --out RUN"], notes


def _by_configs(runs: list[dict[str, Any]]) -> tuple[list[str], list[str]]:
    """Return commands and notes for single runs, each but the first from the weights of the one before."""
    commands = []
    for number, run in enumerate(runs, 1):
        out = "RUN" if number == len(runs) else f"RUN{number}"
        init = f" --init RUN{number - 1}/checkpoint.pt" if number > 1 else ""
        commands.append(
            f"edgepose train --config {run['run'] or 'CONFIG'} --data RECORDINGS --out {out}{init}"
        )
    notes = [
        "RECORDINGS is a folder of the motion data named above, written by `edgepose synthesize`; how is not "
        f"recorded. The config of the last run is in the archive's metadata. {_list_of(runs)}"
    ]
    return commands, notes


def _list_of(runs: list[dict[str, Any]]) -> str:
    listed = [f"{run['run'] or 'CONFIG'} ({run['steps']} steps)" for run in runs]
    return f"Runs: {', '.join(listed)}."


def _export_command(metadata: dict[str, Any], run: str) -> str:
    several = metadata["training"].get("checkpoints", 1) > 1
    window = f" --past {metadata['past']} --future {metadata['future']}" if is_windowed(metadata) else ""
    flags = "" if metadata["precision"] == "f32" else f" --precision {metadata['precision']}"
    flags += " --rounded" if metadata.get("rounded") else ""
    flags += " --measure RECORDINGS" if metadata["measures"] else ""
    others = "OTHERS " * several
    return f"edgepose export {run}/checkpoint.pt {others}--out {metadata['name']}.pt{window}{flags}"


_COLUMNS = {
    "sip_error_deg": "SIP error, deg",
    "joint_angle_error_15_deg": "15 joints, deg",
    "joint_angle_error_10_deg": "10 joints without a sensor, deg",
    "position_error_cm": "position, cm",
    "jitter_km_s3": "jitter, km/s^3",
}


def _table(rows: dict[str, dict[str, list[float]]]) -> list[str]:
    head = ["method", *_COLUMNS.values(), "frames"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for name, measures in rows.items():
        cells = [f"{measures[key][0]:.2f} ± {measures[key][1]:.2f}" for key in _COLUMNS]
        lines.append("| " + " | ".join([name, *cells, str(int(measures["sip_error_deg"][2]))]) + " |")
    return lines


def _smoothing(metadata: dict[str, Any]) -> str:
    if not metadata["smoothing"]:
        return ""
    return (
        f"; the network's rotations, in a level pelvis frame, pass a two-pole low-pass filter with poles at "
        f"{metadata['smoothing']:g}"
    )


def _mean(training: dict[str, Any]) -> str:
    count = training.get("checkpoints", 1)
    return f" in the last of {count} training runs, whose weights are averaged" if count > 1 else ""


def _deviations(parts: dict[str, dict[str, Any]]) -> list[str]:
    """Return the table of how often errors lie within the fitted standard deviations."""
    lines = [
        "### Predicted standard deviations",
        "",
        "Scaled by one factor per joint, fitted to the errors on the validation takes. The table shows the "
        "shares of joint errors within one and two standard deviations (expected: "
        f"{100 * EXPECTED[0]:.0f} and {100 * EXPECTED[1]:.0f} %), and the factor that would still be needed "
        "to make the standard deviations right.",
        "",
        "| part | within one, % | within two, % | factor | errors |",
        "|---|---|---|---|---|",
    ]
    for part, numbers in parts.items():
        one, two = (100 * share for share in numbers["within"])
        lines.append(f"| {part} | {one:.1f} | {two:.1f} | {numbers['scale']:.2f} | {numbers['values']} |")
    return [*lines, ""]


def _place(metadata: dict[str, Any]) -> list[str]:
    if "place" not in metadata:
        return []
    names = ", ".join(metadata["place"]["contacts"])
    return [
        f"- Also: probabilities that these joints rest on something: {names}; velocity of the pelvis "
        f"({metadata['place']['velocity']})."
    ]


def _places(parts: dict[str, dict[str, float]]) -> list[str]:
    """Return the table of the accuracy of contacts and velocity."""
    if not parts:
        return []
    lines = [
        "### Contacts and velocity",
        "",
        "Streamed as by `edgepose run`. Balanced accuracy: the mean of the shares of contacts of ankles and "
        "toes, and of moments without contact, that are found.",
        "",
        "| part | contacts of the feet, balanced accuracy, % | error of the velocity, m/s |",
        "|---|---|---|",
    ]
    for part, row in parts.items():
        lines.append(f"| {part} | {100 * row['contact']:.1f} | {row['velocity']:.2f} |")
    return [*lines, ""]


def _precisions(parts: dict[str, dict[str, Any]]) -> list[str]:
    """Return the table of the effect of `run --precision` on the poses."""
    lines = [
        "### Precision of the weights",
        "",
        "Streamed as by `edgepose run`: errors against the true poses, and distances to the poses in f32.",
        "",
        "| part | precision | SIP error, deg | hips and shoulders from f32, deg | 10 joints from f32, deg |",
        "|---|---|---|---|---|",
    ]
    for part, rows in parts.items():
        for name, row in rows.items():
            error = row["errors"]["sip_error_deg"]
            cells = [
                f"{row['away'][key][0]:.4f} ± {row['away'][key][1]:.4f}"
                for key in ("sip_error_deg", "joint_angle_error_10_deg")
            ]
            lines.append(f"| {part} | {name} | {error[0]:.2f} ± {error[1]:.2f} | " + " | ".join(cells) + " |")
    return [*lines, ""]
