"""Effects between the tip and the tracker's measurements."""

from __future__ import annotations

import numpy as np

from ctr_dynamics.effects.plant import Plant
from ctr_dynamics.effects.registry import EffectParameter, Nominal, Values, effect
from ctr_dynamics.kernels.rotations import from_vector, matrix, multiply
from ctr_dynamics.robot import Robot


def _tolerance(quantity: str, axis: int) -> Nominal:
    """The tolerance along one axis of a vector of the robot file's tracker."""

    def of(robot: Robot, tube: int) -> float:
        return float(getattr(robot.tracker, quantity).tolerance[axis])

    return of


@effect(
    "registration_rotation",
    *(
        EffectParameter(
            f"r{a}_rad",
            "rad",
            0.0,
            0.03,
            _tolerance("registration_rotation", axis),
            text=f"turn about {a}",
        )
        for axis, a in enumerate("xyz")
    ),
    text="The tracker's frame is turned against the base frame.",
    source="reading = R p + t",
    joint=True,
    combine="turn",
)
def registration_rotation(plant: Plant, values: Values) -> None:
    turn = np.array([values["rx_rad"], values["ry_rad"], values["rz_rad"]])
    if turn.any():
        extra = from_vector(turn)
        tracker = plant.tracker
        plant.change_tracker(
            rotation=multiply(extra, tracker.rotation), translation=matrix(extra) @ tracker.translation
        )


@effect(
    "registration_translation",
    *(
        EffectParameter(
            f"t{a}_m",
            "m",
            0.0,
            0.004,
            _tolerance("registration_translation", axis),
            text=f"shift along {a}",
        )
        for axis, a in enumerate("xyz")
    ),
    text="The tracker's frame is shifted against the base frame.",
    source="reading = R p + t",
    joint=True,
    combine="add",
)
def registration_translation(plant: Plant, values: Values) -> None:
    shift = [values["tx_m"], values["ty_m"], values["tz_m"]]
    plant.change_tracker(translation=plant.tracker.translation + shift)


@effect(
    "tracker_lever_arm",
    *(
        EffectParameter(
            f"{a}_m",
            "m",
            0.0,
            0.004,
            _tolerance("lever_arm", axis),
            text=f"sensor position in the tip frame, {a}",
        )
        for axis, a in enumerate("xyz")
    ),
    text="The sensor does not sit where the robot file says.",
    source="reading = p + R lever",
    joint=True,
    combine="add",
)
def tracker_lever_arm(plant: Plant, values: Values) -> None:
    plant.change_tracker(lever=plant.tracker.lever + [values["x_m"], values["y_m"], values["z_m"]])


@effect(
    "tracker_latency",
    EffectParameter(
        "delay_s",
        "s",
        0.0,
        0.015,
        lambda robot, i: robot.tracker.delay.tolerance,
        text="how much older than its stamp a pose is",
        unbounded=True,  # drivers, networks and the clocks of two computers: from a millisecond to a good part of a second
    ),
    text="Tracker poses are older than their stamps.",
    source="reading(stamp) = pose(stamp - delay)",
    large_sizes=(-2.0, -1.0, 1.0, 2.0),
    combine="add",
)
def tracker_latency(plant: Plant, values: Values) -> None:
    plant.change_tracker(delay=plant.tracker.delay + values["delay_s"])


@effect(
    "tracker_averaging",
    # a mean delay of half of it, as plausible as that of tracker_latency
    EffectParameter("window_s", "s", 0.0, 0.03, low=0.0, text="length of the average before the stamp"),
    text="The tracker averages over a time before its stamp: delay and loss of amplitude.",
    source="moving average",
    large_sizes=(1.0,),
    combine="add",
)
def tracker_averaging(plant: Plant, values: Values) -> None:
    plant.change_tracker(averaging=plant.tracker.averaging + values["window_s"])


@effect(
    "clock_skew",
    EffectParameter("rate", "s/s", 0.0, 2e-3, text="tracker stamp = true time * (1 + rate)"),
    text="The tracker's clock runs at another rate.",
    source="linear clock model",
    large_sizes=(-1.0, 1.0),
    combine="add",
)
def clock_skew(plant: Plant, values: Values) -> None:
    plant.change_tracker(skew=plant.tracker.skew + values["rate"])


@effect(
    "tracker_scale",
    EffectParameter(
        "scale",
        "1",
        1.0,
        0.01,
        low=0.5,
        text="reported distance over true distance from the base frame's origin",
    ),
    text="The tracker reports all positions too large or too small.",
    source="reading = scale * p",
    combine="multiply",
)
def tracker_scale(plant: Plant, values: Values) -> None:
    plant.change_tracker(scale=plant.tracker.scale * values["scale"])


@effect(
    "drift",
    *(EffectParameter(f"{a}_m_per_s", "m/s", 0.0, 2e-4, text=f"speed along {a}") for a in "xyz"),
    text="The tracker's readings wander off steadily, whatever the robot does.",
    source="reading = p + drift * t",
    joint=True,
    combine="add",
)
def drift(plant: Plant, values: Values) -> None:
    speed = [values["x_m_per_s"], values["y_m_per_s"], values["z_m_per_s"]]
    plant.change_tracker(drift=plant.tracker.drift + speed)
