"""Slow joint states are no gaps: how long to wait for the next one follows from the recording's own rate."""

from __future__ import annotations

import numpy as np

from ctr_dynamics.io.bag_info import GAP_PERIODS
from ctr_dynamics.io.bag_reader import Bag
from ctr_dynamics.io.messages.topics import JOINT_STATES
from ctr_dynamics.parameters import Settings, parameter


def with_joint_rate(bag: Bag, settings: Settings) -> tuple[Settings, str]:
    """``settings`` with an ``input_timeout_s`` that fits the joint states of ``bag``, and a note; a value that was set stays.

    The parameter's default is the least.
    """
    name = "input_timeout_s"
    if settings.was_set(name):
        return settings, ""
    stamps = np.unique([item.message.stamp_ns for item in bag.inputs({JOINT_STATES})])
    if len(stamps) < 3:
        return settings, ""
    period_s = float(np.median(np.diff(stamps))) * 1e-9
    wait_s = min(GAP_PERIODS * period_s, parameter(name).high or np.inf)
    if wait_s <= settings[name]:
        return settings, ""
    note = f"joints: {1.0 / period_s:.3g} Hz, so {name} is {wait_s:.3g} s instead of {settings[name]:g} s"
    return settings.replace({name: wait_s}), note
