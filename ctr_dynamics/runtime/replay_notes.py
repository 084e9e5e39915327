"""What a replay says in words: unusual inputs, what is in no output, why no step was possible, and where next to nothing was estimated."""

from __future__ import annotations

import math
from typing import Any

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_reader import Bag
from ctr_dynamics.io.inputs.input_mapping import cure
from ctr_dynamics.io.messages.topics import JOINT_STATES, STEP_NS, TRACKER_TIP
from ctr_dynamics.parameters import PARAMETERS, Settings
from ctr_dynamics.robot import Robot

AFTER_NS = 1_000_000_000  # what arrives later than this after the last joint state changes no step
LIVE_ONLY = ("qos.", "record.", "timing_report", "output.max_age_s")  # parameters of a node
LEAST_SHARE = 0.1  # less than a tenth of a recording that was used is next to nothing: whoever needs the rest has to hear of it


def replay_notes(bag: Bag, settings: Settings, numbers: dict[str, Any]) -> list[str]:
    """All notes on a replay, a line each. ``numbers``: its summary."""
    notes = [*bag.notes, *bag.unchecked, *_without_effect(bag, settings)]
    return [
        *notes,
        *input_notes(numbers["input_problems"]),
        *_model_error(numbers["model_error"]),
        *_refutation(numbers["refutation"]),
        *_left_out(numbers),
    ]


def _model_error(found: dict[str, float] | None) -> list[str]:
    """Where the robot departs from its file by more than that states."""
    if found is None:
        return []
    return [
        f"the tip departs from its model by {1e3 * found['position']:.1f} mm and {math.degrees(found['rotation']):.1f} deg per axis, for "
        f"{found['time']:g} s, beyond the robot file: the filter has counted on that; measure it with ctr-dynamics calibrate"
    ]


def _refutation(found: str) -> list[str]:
    """Where the estimate has left the tolerances of the robot file at the end."""
    return [f"{found}: calibrate it with ctr-dynamics calibrate, or state larger tolerances"] if found else []


def shortfall(bag: Bag, settings: Settings, numbers: dict[str, Any]) -> str:
    """Why a replay is worth next to nothing, in one line; empty where it is worth something.

    Either less than ``LEAST_SHARE`` of the time that the joint states cover has valid outputs, or less than that of the tracker's poses was fused
    though fusion is on.
    """
    valid_s = (numbers["steps"] - numbers["invalid"]["steps"]) * STEP_NS * 1e-9
    covered_s = numbers["joints_cover_s"]
    limit = f"limit {100.0 * LEAST_SHARE:g} %"
    if valid_s < LEAST_SHARE * covered_s:
        first = numbers["invalid"]["stretches"][:1]
        why = f": {first[0]['reason']}" if first else _commonest(numbers["input_problems"]["joints"])
        return f"next to nothing was estimated: {valid_s:.3f} s valid of {covered_s:.2f} s of joint states, {limit}{why}"
    tracker = bag.topics.get(TRACKER_TIP)
    poses = tracker.messages if tracker is not None else 0
    used = numbers["measurements"]["used"]
    if settings["filter.enabled"] and poses and used < LEAST_SHARE * poses:
        why = (
            _commonest(numbers["input_problems"]["tracker"])
            or f": {numbers['rejected']} rejected, they contradict the model"
        )
        return f"the tracker was not used: {used} of {poses} poses fused, {limit}{why}"
    return ""


def _commonest(problems: dict[str, dict[str, Any]]) -> str:
    """The input problem that occurred most often, with its last occurrence."""
    if not problems:
        return ""
    kind, found = max(problems.items(), key=lambda item: item[1]["count"])
    return f": {kind} ({found['count']}): {found['last']}"


def input_notes(problems: dict[str, dict[str, Any]]) -> list[str]:
    """A line for each kind of unusual input that the estimator has noted, by group."""
    return [
        f"{group}: {kind} ({found['count']}), the last: {found['last']}"
        for group, kinds in problems.items()
        for kind, found in kinds.items()
    ]


def _without_effect(bag: Bag, settings: Settings) -> list[str]:
    """Notes on what has no effect: a missing tracker, and parameters of the live node."""
    tracker = bag.topics.get(TRACKER_TIP)
    notes = (
        []
        if tracker is not None and tracker.messages
        else [f"no pose on {TRACKER_TIP}: the model runs in open loop{_elsewhere(bag)}"]
    )
    live = [p.name for p in PARAMETERS if p.name.startswith(LIVE_ONLY) and settings[p.name] != p.default]
    if live:
        notes.append(f"parameters of the live node alone, without effect here: {', '.join(live)}")
    return notes


def _elsewhere(bag: Bag) -> str:
    """What to do where poses are in the bag under another name."""
    advice = cure(TRACKER_TIP, bag.stored_topics)
    return f"; {advice}" if advice.startswith("if ") else ""


def _left_out(numbers: dict[str, Any]) -> list[str]:
    """Notes on messages and steps that are in no output."""
    withheld, unused = numbers["withheld"], numbers["unused"]
    notes = []
    if withheld:
        notes.append(
            f"joints: their clock was set back; {withheld} steps of {STEP_NS * 1e-6:g} ms lie before what was out already "
            "and are left out, as no stamp is published twice: cut it off with `mcap filter` and replay it by itself"
        )
    if unused:
        notes.append(
            f"{unused} messages came more than {AFTER_NS * 1e-9:g} s after the last joint state and are not used: a replay ends with the joints"
        )
    return notes


def no_step(bag: Bag, robot: Robot, names: set[str], problems: dict[str, Any]) -> InputError:
    """The error that explains why a replay took no step, from the joint ``names`` of the bag and the estimator's ``problems`` with them."""
    expected = ", ".join(f"tube{i}_rotation, tube{i}_translation" for i in range(1, robot.n_tubes + 1))
    found = ", ".join(sorted(names)[:12]) or "none"
    odd = "".join(f"; {note}" for note in (*input_notes({"joints": problems}), *bag.notes[:2]))
    return InputError(
        f"no step was possible: no usable joint state of robot '{robot.name}' on {JOINT_STATES} (joints "
        f"found: {found}; needed: {expected}; readable messages: {_readable(bag)}{odd})",
        where=str(bag.path),
        do=(
            "mend what is said of the joints"
            if problems and "names" not in problems
            else "name the joints with --set joints.rotation_names=A,B and joints.translation_names=C,D"
        )
        + ", or look at units and robot with `ctr-dynamics info`",
    )


def _readable(bag: Bag) -> int:
    topic = bag.topics.get(JOINT_STATES)
    return (topic.messages if topic else 0) - bag.malformed.get(JOINT_STATES, 0)
