"""What a robot file says, in the units of a workshop, and what in it looks doubtful."""

from __future__ import annotations

import math

import numpy as np

from ctr_dynamics.robot.schema import Robot

CLEARANCE_M = (5e-6, 0.3e-3)  # radial; outside, a diameter is probably wrong or play matters
MAX_STRAIN = 0.08  # Nitinol recovers up to about this
MODULUS_PA = (0.5e9, 450e9)  # soft polymers to tungsten
MAX_ALPHA = 4 * math.pi  # two turns; more at rest are degrees


def tube_rows(robot: Robot) -> list[tuple[str, ...]]:
    """A header and one row for each tube."""
    rows: list[tuple[str, ...]] = [
        ("tube", "od x id mm", "length mm", "precurved mm", "bend radius mm", "E GPa", "EI N m^2", "GJ N m^2")
    ]
    for tube in robot.tubes:
        peaks = [segment.peak_curvature for segment in tube.precurvature]
        curved = sum(s.length.value for s, peak in zip(tube.precurvature, peaks, strict=True) if peak)
        radius = f"{1e3 / max(peaks):.1f}" if max(peaks) else "-"
        rows.append(
            (
                tube.name,
                f"{2e3 * tube.outer_radius.value:.3f} x {2e3 * tube.inner_radius.value:.3f}",
                f"{1e3 * tube.length:.1f}",
                f"{1e3 * curved:.1f}",
                radius,
                f"{1e-9 * tube.youngs_modulus.value:.1f} +- {100 * tube.youngs_modulus.relative:.1f} %",
                f"{tube.bending_stiffness:.4g}",
                f"{tube.torsion_stiffness:.4g}",
            )
        )
    return rows


def property_rows(robot: Robot) -> list[tuple[str, str]]:
    """Name and text of everything else that the file holds: masses, friction, sensors, errors, actuators and effects."""
    rows: list[tuple[str, str]] = []
    for tube in robot.tubes:
        density = f"{tube.density.value:.0f} +- {tube.density.tolerance:.0f} kg/m^3"
        body = tube.end_body
        if body is not None:
            density += f", body at the end {1e3 * body.mass.value:.3g} +- {1e3 * body.mass.tolerance:.2g} g"
        rows.append((f"mass of {tube.name}", density))
    g, friction = robot.gravity, robot.friction
    down = ", ".join(f"{v:.2f}" for v in g.value)
    rows.append(("gravity", f"{down} m/s^2 +- {math.degrees(g.direction_tolerance):.2f} deg"))
    for name, pair in (("friction at the plate", friction.base), ("friction of tubes", friction.tubes)):
        mu, c = pair.coulomb, pair.viscous
        rows.append(
            (
                name,
                f"{mu.value:.3g} +- {mu.tolerance:.2g}, viscous {c.value:.3g} +- {c.tolerance:.2g} N m s/rad",
            )
        )
    offset = robot.encoders.offset
    rows.append(
        (
            "encoders",
            f"offset {math.degrees(offset.value):.3g} +- {math.degrees(offset.tolerance):.2g} deg, "
            f"noise {math.degrees(robot.encoders.noise.value):.2g} deg",
        )
    )
    tracker = robot.tracker
    noise = tracker.noise
    rows += [
        (
            "tracker",
            f"axes {tracker.axes or 'xyzrpy'}, noise {1e3 * noise.position.value:.3g} mm and {math.degrees(noise.rotation.value):.2g} deg, "
            f"drift {1e3 * noise.drift.value:.2g} mm in {noise.drift_time.value:g} s, "
            f"delay {1e3 * tracker.delay.value:.3g} +- {1e3 * tracker.delay.tolerance:.2g} ms",
        ),
        (
            "registration",
            f"+- {1e3 * max(tracker.registration_translation.tolerance):.2g} mm and "
            f"{math.degrees(max(tracker.registration_rotation.tolerance)):.2g} deg, "
            f"lever arm {', '.join(f'{1e3 * v:.2f}' for v in tracker.lever_arm.value)} +- {1e3 * max(tracker.lever_arm.tolerance):.2g} mm",
        ),
    ]
    error = robot.model_error
    if error is not None:
        told = f"{1e3 * error.position.value:.2f} mm and {math.degrees(error.rotation.value):.2f} deg per axis, for {error.time.value:.2g} s"
    else:
        told = "none is stated; ctr-dynamics calibrate measures it"
    rows.append(("model error", told))
    if robot.actuators is not None:
        for name, speed, unit in (
            ("rotation", robot.actuators.rotation_speed, "rad/s"),
            ("translation", robot.actuators.translation_speed, "m/s"),
        ):
            if speed is not None:
                rows.append((f"actuators, {name}", f"at most {speed.value:g} {unit}"))
    for effect, values in robot.extensions.items():
        rows.append((f"effect {effect}", ", ".join(f"{key} {value:g}" for key, value in values.items())))
    return rows


def doubts(robot: Robot) -> list[str]:
    """What is allowed and yet probably a mistake, one line each."""
    found: list[str] = []
    for i, (inside, outside) in enumerate(zip(robot.tubes, robot.tubes[1:], strict=False), 1):
        gap = outside.inner_radius.value - inside.outer_radius.value
        low, high = CLEARANCE_M
        if not low <= gap <= high:
            found.append(
                f"clearance between tube {i} and {i + 1} is {1e3 * gap:.4f} mm per side, usual are {1e3 * low:.3f} to "
                f"{1e3 * high:.1f} mm; check the diameters"
            )
    for i, tube in enumerate(robot.tubes, 1):
        low, high = MODULUS_PA
        if not low <= tube.youngs_modulus.value <= high:
            found.append(
                f"Young's modulus of tube {i} is {1e-9 * tube.youngs_modulus.value:.4g} GPa, that of solids is {1e-9 * low:g} to {1e-9 * high:g} GPa "
                "(Nitinol 30 to 85): check unit and diameters"
            )
        strain = max(segment.peak_curvature for segment in tube.precurvature) * tube.outer_radius.value
        if strain > MAX_STRAIN:
            found.append(
                f"tube {i} is strained by {100 * strain:.1f} % when straight, Nitinol recovers up to about {100 * MAX_STRAIN:.0f} %; "
                "check bend radius and diameter"
            )
    turned = max(robot.rest.alpha.value, key=abs)
    if abs(turned) > MAX_ALPHA:
        found.append(
            f"an angle at rest is {turned:g} rad, more than two turns: if that is in degrees, write {math.radians(turned):.6g}"
        )
    exact = [name for name, value in _deviations(robot) if value == 0.0]
    if exact:
        found.append(
            f"taken as exact, because no tolerance is given: {', '.join(exact)}; the published covariance will be too small if they "
            "are not"
        )
    noise = robot.tracker.noise
    if noise.position.value == 0 or noise.rotation.value == 0:
        found.append("the tracker's noise is zero; give its measured standard deviation")
    return found


def _deviations(robot: Robot) -> list[tuple[str, float]]:
    """Name and size of every deviation that the filter would carry."""
    found: list[tuple[str, float]] = []
    for i, tube in enumerate(robot.tubes, 1):
        found.append((f"youngs_modulus of tube {i}", tube.youngs_modulus.tolerance))
        if any(np.any(segment.coefficients) for segment in tube.precurvature):
            found.append((f"precurvature of tube {i}", tube.precurvature_tolerance))
        if tube.end_body:
            found.append((f"mass at the end of tube {i}", tube.end_body.mass.tolerance))
    tracker = robot.tracker
    return [
        *found,
        ("density", max(tube.density.tolerance for tube in robot.tubes)),
        ("direction of gravity", robot.gravity.direction_tolerance),
        ("encoder offset", robot.encoders.offset.tolerance),
        (
            "registration",
            max(*tracker.registration_rotation.tolerance, *tracker.registration_translation.tolerance),
        ),
        ("lever arm", max(tracker.lever_arm.tolerance)),
        ("tracker delay", tracker.delay.tolerance),
    ]
