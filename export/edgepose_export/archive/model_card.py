"""Model cards: pages beside archives with network, training data, licences, accuracy and commands."""

from __future__ import annotations

import json
from typing import Any

from edgepose_export.evaluation.uncertainty import EXPECTED
from edgepose_export.networks.registry import NETWORKS
from edgepose_export.training.config import CONFIGS, config_values, read_config

_INPUTS = {
    "root": "in the pelvis frame",
    "tilt": "in the pelvis frame, with the tilt and acceleration of the pelvis itself",
    "heading": "without the heading of the pelvis",
    "sequence": "in the pelvis frame of the first frame",
}


_PARTS = {
    "cmu-walk-run": "`cmu-walk-run` is CMU subjects 07, 08 and 09",
    "cmu-02": "`cmu-02` is CMU subject 02 (bending, punching, sword play, washing)",
    "bandai-styles": "`bandai-styles` is Bandai-Namco's styles exhausted and tired",
    "validation": "`validation` is the takes by which the end of training was chosen",
}


def card(metadata: dict[str, Any]) -> str:
    """Return an archive's card as Markdown, made from its metadata alone."""
    lines = [f"# {metadata['name']}", "", *_summary(metadata), ""]
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
        "- Weights: for non-commercial use wherever a licence above says NC. The code of edgepose is MIT.",
        f"- Exported by edgepose {metadata['edgepose']}, revision {metadata['revision'] or 'unknown'}.",
    ]


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
        f"The parts: {'; '.join(_PARTS[part] for part in metadata['measures'])}. None of these takes or "
        "styles is in the training set.",
        "",
    ]


def _reproduction(metadata: dict[str, Any]) -> list[str]:
    """Return the section with the commands that make the archive."""
    name = metadata["name"]
    if metadata["training"]["config"] != _shipped_config(name):
        return _own_reproduction(metadata)
    several = metadata["training"].get("checkpoints", 1) > 1
    with_bandai = "Bandai-Namco" in metadata["training"]["summary"]
    bandai = ", and both Bandai-Namco Research motion datasets" if with_bandai else ""
    return [
        "## Reproduce",
        "",
        "```",
        "edgepose synthesize MOCAP --out recordings --jobs 2",
        f"edgepose synthesize MOCAP/{'*_normal_*' if with_bandai else '*'}.bvh --hold 3 "
        "--out recordings/standing",
        *(["edgepose synthesize SOME --seated 1 --out recordings/seated"] if _seated(metadata) else []),
        f"edgepose train --config {name} --data recordings --out runs/{name}",
        f"edgepose export runs/{name}/checkpoint.pt {'OTHERS ' * several}--out "
        f"{name}.pt{' --rounded' * metadata.get('rounded', False)} --measure recordings",
        "```",
        "",
        "MOCAP is a folder with the motion data named above. The shipped models use the BVH files of CMU "
        f"subjects 01, 02, 03, 05 - 09 and a few more takes (cgspeed's conversion){bandai}. The whole "
        "config is in the archive's metadata."
        + (" OTHERS are earlier checkpoints, see docs/research/training-history.md." * several),
    ]


def _shipped_config(name: str) -> dict[str, Any] | None:
    """Return the config of a shipped model; None if there is none of that name."""
    path = CONFIGS / f"{name}.toml"
    # As JSON, like the archive's: tuples become lists.
    return json.loads(json.dumps(config_values(read_config(path)))) if path.is_file() else None


def _own_reproduction(metadata: dict[str, Any]) -> list[str]:
    """Return the section with the commands for a network of a user's own, as far as they are known."""
    several = metadata["training"].get("checkpoints", 1) > 1
    window = f" --past {metadata['past']} --future {metadata['future']}" if metadata["future"] else ""
    flags = "" if metadata["precision"] == "f32" else f" --precision {metadata['precision']}"
    flags += " --rounded" if metadata.get("rounded") else ""
    flags += " --measure RECORDINGS" if metadata["measures"] else ""
    return [
        "## Reproduce",
        "",
        "```",
        "edgepose train --config CONFIG --data RECORDINGS --out RUN",
        f"edgepose export RUN/checkpoint.pt {'OTHERS ' * several}--out {metadata['name']}.pt{window}{flags}",
        "```",
        "",
        "CONFIG is a TOML file with the config in the archive's metadata; RECORDINGS is a folder of the "
        "motion data named above, written by `edgepose synthesize`."
        + (" OTHERS are the checkpoints that were averaged with it." * several),
    ]


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


def _seated(metadata: dict[str, Any]) -> bool:
    """Return whether the network was trained on synthetic sitting."""
    return metadata["training"]["config"].get("seated_share", 0.0) > 0.0


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
