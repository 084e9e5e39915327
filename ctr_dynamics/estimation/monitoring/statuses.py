"""Statuses of the estimator for /diagnostics: each a plain function of the health's numbers, with value, limit and what to do."""

from __future__ import annotations

import math

from ctr_dynamics.estimation.monitoring.health import SLOW_JOINTS_S, TRACKER_LIMIT_S, Health
from ctr_dynamics.estimation.step_output import ERROR, OK, WARN, Status
from ctr_dynamics.io.messages.topics import JOINT_RATE_HZ

SNAP_WARNING_S = 1.0  # a snap that is nearer than this is warned of: time to stop an actuator by hand


def all_statuses(health: Health) -> list[Status]:
    """One status a part."""
    return [
        output(health.problem, health.steps),
        solver(health),
        joints(health),
        tracker(health),
        inputs(health, "load"),
        consistency(health),
        health.consistency.status(),
        stability(health),
    ]


def snap_ahead(health: Health) -> bool:
    """Whether the equilibrium is lost or unstable, or its loss is foretold: news that cannot wait."""
    return stability(health).level > OK


def output(problem: str, steps: int) -> Status:
    """Whether an output is valid, and the ``problem`` that it has; ``steps``: that have been taken."""
    return Status("output", ERROR if problem else OK, problem or "valid", {"steps": str(steps)})


def solver(health: Health) -> Status:
    """Failed steps and the work of the others."""
    values = {
        "failures": str(health.failures),
        "restarts": str(health.restarts),
        "steps in substeps": str(health.substeps),
        "accuracy": health.shortfall or "as asked",
        "steps taken again": str(health.corrected_steps),
        "sweeps per step": f"{health.sweeps / health.steps:.1f}" if health.steps else "0",
    }
    values.update({f"failed: {reason}": str(count) for reason, count in health.reasons.items()})
    if health.failures:
        message = f"{health.failures} steps failed; the last reason is in the values"
        return Status("solver", WARN, message, values)
    return Status("solver", OK, "ok", values)


def inputs(health: Health, group: str) -> Status:
    """Problems of the input ``group`` (joints, tracker or load): the newest while it is recent, and all of them in the values."""
    found = health.newest_first(group)
    values = {kind: f"{c.count}, last: {c.last}" for kind, c in getattr(health, group).items()}
    if not found:
        return Status(group, OK, "ok", values)
    kind, newest = found[0]
    if health.is_recent(newest):
        return Status(group, WARN, f"{kind} ({newest.count}): {newest.last}", values)
    return Status(group, OK, "ok; earlier: " + ", ".join(f"{kind} ({c.count})" for kind, c in found), values)


def joints(health: Health) -> Status:
    """Problems of the joint states, and whether they come often enough."""
    status, period_s = inputs(health, "joints"), health.joint_period_s
    if period_s <= SLOW_JOINTS_S:
        return status
    slow = (
        f"joint states come every {period_s:.3g} s (median of the last ones), limit {SLOW_JOINTS_S:g} s: what the actuators do "
        f"in between is guessed; publish them at {JOINT_RATE_HZ:g} Hz or more"
    )
    message = slow if status.level == OK else f"{status.message}; {slow}"
    return Status("joints", WARN, message, status.values)


def tracker(health: Health) -> Status:
    """Problems of the tracker, and what has become of its measurements."""
    status = inputs(health, "tracker")
    values = {
        **status.values,
        "accepted": str(health.measurements.accepted),
        "rejected": str(health.measurements.rejected),
        "late": str(health.late),
        "dropped": str(health.measurements.dropped),
        "fusion": "on" if health.fusing else "off",
        "shift m": f"{health.shift_m:.4g}",
        "noise by the stated": f"{health.noise_ratio:.2f}",
    }
    if health.rejecting:
        message = (
            f"{health.measurements.outside} of the last {len(health.measurements.recent)} samples are outside the gate (limit half): "
            "check the tracker's frame, units, stamps and the robot file"
        )
        return Status("tracker", ERROR, message, values)
    if not health.tracker_alive:
        message = (
            f"no usable measurement for {health.tracker_age_s:.1f} s, limit {TRACKER_LIMIT_S:g} s: "
            "the pose is the model's prediction since then"
        )
        if status.level == WARN:  # what becomes of those that come
            message += f"; the last: {health.newest_first('tracker')[0][1].last}"
        return Status("tracker", WARN, message, values)
    if health.shift_m:
        message = (
            f"positions lie {1e3 * health.shift_m:.1f} mm beside what any force on the robot explains and count little: "
            "has the tracker, its reference or the sensor moved?"
        )
        return Status("tracker", WARN, message, values)
    if health.noise_ratio > 1.0:
        message = (
            f"noise is {health.noise_ratio:.1f} times what the robot file states (limit 1): poses count less; "
            "check the line of sight, the field and the stated noise"
        )
        return Status("tracker", WARN, message, values)
    return Status("tracker", status.level, status.message, values)


def stability(health: Health) -> Status:
    """Elastic stability of the equilibrium that belongs to the present actuators."""
    found = health.stability
    if found is None:
        return Status("stability", OK, "not yet known", {})
    if found.lost:
        message = "no equilibrium near the last one: the robot has snapped or is about to; the outputs follow its dynamics"
        return Status("stability", WARN, message, {})
    values = {"det(d alpha / d psi_L)": f"{found.measure:.4g}"}
    ahead = found.time_to_snap
    if ahead is not None:
        values["time to snap s"] = f"{ahead:.3f}"
    if found.measure <= 0.0:
        message = f"unstable equilibrium: measure {found.measure:.4g}, limit 0"
        return Status("stability", WARN, message, values)
    if ahead is not None and ahead < SNAP_WARNING_S:
        message = f"a snap is ahead in {ahead:.2f} s (warned of below {SNAP_WARNING_S:g} s) at the present actuator rates; stop or turn back"
        return Status("stability", WARN, message, values)
    return Status("stability", OK, f"stable: measure {found.measure:.4g}, limit 0", values)


def consistency(health: Health) -> Status:
    """Mean NIS of the last second, and the process noise."""
    values = {"force deviation N": f"{health.force_sigma:.4g}"}
    error = health.model_error
    if error is not None:
        values["model error m"] = f"{error.position:.4g}"
        values["model error rad"] = f"{error.rotation:.4g}"
    if not health.measurements.recent:
        return Status("consistency", OK, "no samples yet", values)
    mean, limit = health.measurements.recent_nis
    values["nis per dof, last second"] = f"{mean:.2f}"
    if error is not None:
        message = (
            f"the tip departs from its model by {1e3 * error.position:.1f} mm and {math.degrees(error.rotation):.1f} deg per axis, "
            "beyond the robot file: the filter counts on that now; ctr-dynamics calibrate measures it"
        )
        return Status("consistency", WARN, message, values)
    if health.refutation:
        message = f"{health.refutation}: calibrate it, or state larger tolerances; until then the delay is not estimated"
        return Status("consistency", WARN, message, values)
    if mean > limit:
        message = f"mean NIS {mean:.2f} per degree of freedom, limit {limit:.2f}: the model misses an effect, or the noise is larger than stated"
        return Status("consistency", WARN, message, values)
    return Status("consistency", OK, f"mean NIS {mean:.2f} per degree of freedom", values)
