"""The page beside each archive: what it is, from which data, how good, how to make it again."""

from __future__ import annotations

from typing import Any

from edgepose_export.evaluation.uncertainty import EXPECTED

_KINDS = {
    "birnn": "bidirectional LSTM; the pose of a frame is known once its {future} future frames have come "
    "({latency:.0f} ms)",
    "rnn": "unidirectional LSTM; the pose of a frame is known at once",
    "feed-forward": "five dense layers over {past} past and {future} future frames; the pose of a frame is "
    "known once these have come ({latency:.0f} ms)",
    "wavenet": "dilated convolutions over {past} past frames; the pose of a frame is known at once",
}

_INPUTS = {
    "root": "as seen from the pelvis",
    "tilt": "as seen from the pelvis, with the pelvis' own tilt and acceleration",
    "heading": "without the pelvis' heading",
    "sequence": "as seen from the pelvis in the first frame",
}


def card(metadata: dict[str, Any]) -> str:
    """Markdown of an archive's card, made from its metadata alone."""
    kind = _KINDS[metadata["kind"]].format(
        past=metadata["past"],
        future=metadata["future"],
        latency=1e3 * metadata["future"] / metadata["rate_hz"],
    )
    training = metadata["training"]
    several = training.get("checkpoints", 1) > 1
    mixed = "Bandai-Namco" in training["summary"]
    bandai = ", and both Bandai-Namco Research motion datasets" if mixed else ""
    lines = [
        f"# {metadata['name']}",
        "",
        f"- Network: {kind}; {_size(metadata)}, {metadata['parameters'] / 1e6:.2f} million weights"
        f"{', rounded by about a hundredth' if metadata.get('rounded') else ''}.",
        f"- Input: calibrated orientations{' and accelerations' if metadata['acceleration'] else ''} of "
        f"{', '.join(metadata['placements'])} at {metadata['rate_hz']:g} Hz, "
        f"{_INPUTS[metadata['normalisation']]}.",
        f"- Targets: {metadata['targets']}; bones that carry a sensor are {metadata['measured_bones']}"
        f"{_smoothing(metadata)}.",
        f"- Trained on: {training['summary']}; {training['takes']} takes, {training['hours']:.2f} h, "
        f"{training['steps']} steps{_mean(training)}.",
        "- Licences of that motion:",
        *(f"  - {text}" for text in training["licenses"]),
        "- Weights: for non-commercial use wherever a licence above says NC; edgepose's own code is MIT.",
        f"- Exported by edgepose {metadata['edgepose']}, revision {metadata['revision'] or 'unknown'}.",
        "",
    ]
    if metadata["measures"]:
        lines += [
            "## On motion it has never seen",
            "",
            "Mean ± deviation over all frames; synthetic sensors on held-out takes, run through this "
            "archive. Position errors are on the default body.",
            "",
        ]
    for part, rows in metadata["measures"].items():
        lines += [f"### {part}", "", *_table(rows), ""]
    if metadata["measures"]:
        lines += _deviations(metadata["deviations"])
        lines += _precisions(metadata["precisions"])
        lines += [
            "The parts: `cmu-walk-run` is CMU subjects 07, 08, 09; `cmu-02` is CMU subject 02 (bends, "
            "punches, sword, washing); `bandai-styles` is Bandai-Namco's styles exhausted and tired. None of "
            "these takes or styles is in the training set.",
            "",
        ]
    lines += [
        "## Make it again",
        "",
        "```",
        "edgepose synthesize MOCAP --out recordings --jobs 2",
        f"edgepose synthesize MOCAP/{'*_normal_*' if mixed else '*'}.bvh --hold 3 --out recordings/standing",
        *(["edgepose synthesize SOME --seated 1 --out recordings/seated"] if _seated(metadata) else []),
        f"edgepose train --config {metadata['name']} --data recordings --out runs/{metadata['name']}",
        f"edgepose export runs/{metadata['name']}/checkpoint.pt {'OTHERS ' * several}--out "
        f"{metadata['name']}.pt{' --rounded' * metadata.get('rounded', False)} --measure recordings",
        "```",
        "",
        "MOCAP is a folder with the motion named above. For the shipped models: the BVH files of CMU "
        f"subjects 01, 02, 03, 05 - 09 and some further takes (cgspeed's conversion){bandai}. The whole "
        "config is in the archive's metadata."
        + (" OTHERS are earlier checkpoints, see docs/research/training-history.md." * several),
        "",
    ]
    return "\n".join(lines)


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
        f"; a low-pass of two poles at {metadata['smoothing']:g} behind the network, over rotations as seen "
        "from a level pelvis"
    )


def _mean(training: dict[str, Any]) -> str:
    count = training.get("checkpoints", 1)
    return f" in the last of {count} trainings, the mean of whose weights this is" if count > 1 else ""


def _seated(metadata: dict[str, Any]) -> bool:
    """Whether the network was trained on made sitting."""
    return metadata["training"]["config"].get("seated_share", 0.0) > 0.0


def _size(metadata: dict[str, Any]) -> str:
    if metadata["kind"] in ("birnn", "rnn"):
        return f"{metadata['hidden']} units a direction, two layers"
    return f"{metadata['hidden']} units in the widest layer"


def _deviations(parts: dict[str, dict[str, Any]]) -> list[str]:
    """How often errors are within the predicted standard deviations, once these are fitted."""
    lines = [
        "### Predicted standard deviations",
        "",
        "Fitted to the errors on validation takes, a factor a joint. The joints' errors within one and two "
        f"deviations (expected {100 * EXPECTED[0]:.0f} and {100 * EXPECTED[1]:.0f} %), and the factor that "
        "would make the deviations right on the part:",
        "",
        "| part | within one, % | within two, % | factor | errors |",
        "|---|---|---|---|---|",
    ]
    for part, numbers in parts.items():
        one, two = (100 * share for share in numbers["within"])
        lines.append(f"| {part} | {one:.1f} | {two:.1f} | {numbers['scale']:.2f} | {numbers['values']} |")
    return [*lines, ""]


def _precisions(parts: dict[str, dict[str, Any]]) -> list[str]:
    """What `run --precision` does to the poses."""
    lines = [
        "### Precision of the weights",
        "",
        "As `run` streams: the error against the truth, and how far the poses are from those in f32.",
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
