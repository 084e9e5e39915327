"""A calibration in words, and as a robot file with a head that says what it is worth."""

from __future__ import annotations

import math

from ctr_dynamics.calibration.robot_calibration import Calibration
from ctr_dynamics.robot_files import robot_to_yaml


def lines(found: Calibration) -> list[str]:
    """What was found: every value with its deviation before and after, and the errors on held-out tips."""
    fit = found.fit
    out = [f"{'':38}{'before':>11}{'+-':>9}{'after':>11}{'+-':>9}"]
    for c, value, sigma in zip(fit.coordinates, fit.values, fit.sigma, strict=True):
        name = " ".join(c.key)
        out.append(f"{name:38}{c.off:11.5f}{c.prior:9.5f}{value:11.5f}{sigma:9.5f}")
    mount = found.robot.tracker.mount_rotation
    if mount is not None:
        out.append(f"mount of the sensor  {', '.join(f'{v:.4f}' for v in mount.value)} rad")
    error = found.robot.model_error
    if error is not None:
        out.append(
            f"model error          {1e3 * error.position.value:.2f} mm, {math.degrees(error.rotation.value):.2f} deg per axis, "
            f"for {error.time.value:.2g} s"
        )
    out += [
        f"fitted tips {found.fitted.count:5d}   after   {found.fitted.text()}",
        f"held out    {found.before.count:5d}   before  {found.before.text()}",
        f"held out    {found.after.count:5d}   after   {found.after.text()}",
    ]
    return out


PARAMETERS_INSIDE = "The given tracker.delay_s, lever_arm_m, mount and registration parameters are part of this file: do not give them with it."


def robot_text(found: Calibration, with_parameters: bool) -> str:
    """Text of the new robot file. ``with_parameters``: whether parameters of the tracker have become part of it."""
    head = [
        "SI units and radians; tolerances are the standard deviations of the fit.",
        f"Held-out tips before: {found.before.text()}",
        f"Held-out tips after: {found.after.text()}",
    ]
    if with_parameters:
        head.append(PARAMETERS_INSIDE)
    return "".join(f"# {line}\n" for line in head) + robot_to_yaml(found.robot)
