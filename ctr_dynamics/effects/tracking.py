"""Effects between the tip and the tracker's readings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ctr_dynamics.effects.registry import Effect, Parameter, Values, register
from ctr_dynamics.kernels.rotations import from_vector, matrix, multiply

if TYPE_CHECKING:
    from ctr_dynamics.effects.setup import Setup


def _rotation(setup: Setup, values: Values) -> None:
    turn = np.array([values["rx_rad"], values["ry_rad"], values["rz_rad"]])
    if turn.any():
        extra = from_vector(turn)
        setup.rotation = multiply(extra, setup.rotation)
        setup.translation = matrix(extra) @ setup.translation


def _translation(setup: Setup, values: Values) -> None:
    setup.translation = setup.translation + [values["tx_m"], values["ty_m"], values["tz_m"]]


def _lever(setup: Setup, values: Values) -> None:
    setup.lever = setup.lever + [values["x_m"], values["y_m"], values["z_m"]]


def _drift(setup: Setup, values: Values) -> None:
    setup.drift = setup.drift + [values["x_m_per_s"], values["y_m_per_s"], values["z_m_per_s"]]


register(
    Effect(
        "registration_rotation",
        tuple(
            Parameter(
                f"r{a}_rad",
                "rad",
                0.0,
                0.03,
                lambda robot, i: float(np.max(robot.tracker.registration_rotation.tolerance)),
                text=f"turn about {a}",
            )
            for a in "xyz"
        ),
        _rotation,
        "The tracker's frame is turned against the base frame.",
        "reading = R p + t",
        joint=True,
    )
)
register(
    Effect(
        "registration_translation",
        tuple(
            Parameter(
                f"t{a}_m",
                "m",
                0.0,
                0.004,
                lambda robot, i: float(np.max(robot.tracker.registration_translation.tolerance)),
                text=f"shift along {a}",
            )
            for a in "xyz"
        ),
        _translation,
        "The tracker's frame is shifted against the base frame.",
        "reading = R p + t",
        joint=True,
    )
)
register(
    Effect(
        "tracker_lever_arm",
        tuple(
            Parameter(
                f"{a}_m",
                "m",
                0.0,
                0.004,
                lambda robot, i: float(np.max(robot.tracker.lever_arm.tolerance)),
                text=f"sensor position in the tip frame, {a}",
            )
            for a in "xyz"
        ),
        _lever,
        "The sensor does not sit where the robot file says.",
        "reading = p + R lever",
        joint=True,
    )
)


def _latency(setup: Setup, values: Values) -> None:
    setup.delay += values["delay_s"]


def _averaging(setup: Setup, values: Values) -> None:
    setup.averaging += values["window_s"]


def _skew(setup: Setup, values: Values) -> None:
    setup.skew += values["rate"]


def _tracker_scale(setup: Setup, values: Values) -> None:
    setup.tracker_scale *= values["scale"]


register(
    Effect(
        "tracker_latency",
        (
            Parameter(
                "delay_s",
                "s",
                0.0,
                0.015,
                lambda robot, i: robot.tracker.delay.tolerance,
                text="how much older than its stamp a pose is",
            ),
        ),
        _latency,
        "Tracker poses are older than their stamps.",
        "reading(stamp) = pose(stamp - delay)",
    )
)
register(
    Effect(
        "tracker_averaging",
        (Parameter("window_s", "s", 0.0, 0.04, low=0.0, text="length of the average before the stamp"),),
        _averaging,
        "The tracker averages over a time before its stamp: delay and loss of amplitude.",
        "moving average",
    )
)
register(
    Effect(
        "clock_skew",
        (Parameter("rate", "s/s", 0.0, 2e-3, text="tracker stamp = true time * (1 + rate)"),),
        _skew,
        "The tracker's clock runs at another rate.",
        "linear clock model",
    )
)
register(
    Effect(
        "tracker_scale",
        (
            Parameter(
                "scale",
                "1",
                1.0,
                0.01,
                low=0.5,
                text="reported distance over true distance from the base frame's origin",
            ),
        ),
        _tracker_scale,
        "The tracker reports all positions too large or too small.",
        "reading = scale * p",
    )
)
register(
    Effect(
        "drift",
        tuple(Parameter(f"{a}_m_per_s", "m/s", 0.0, 2e-4, text=f"speed along {a}") for a in "xyz"),
        _drift,
        "The tracker's readings wander off steadily, whatever the robot does.",
        "reading = p + drift * t",
        joint=True,
    )
)
