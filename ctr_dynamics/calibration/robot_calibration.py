"""Calibration of a robot file on tips at rest or in slow motion, judged on tips that it has not seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.calibration.alignment import (
    MOST_LAG_S,
    SAMPLES,
    delay_coordinate,
    first_lag,
    first_mount,
    mount_angle,
    mount_vector,
    static_quantities,
)
from ctr_dynamics.calibration.model_error import model_error_of
from ctr_dynamics.calibration.tip_errors import TipErrors, tip_errors
from ctr_dynamics.calibration.tip_fit import (
    DELAY,
    Coordinate,
    Key,
    TipFit,
    TipModel,
    fit_tips,
    mount_coordinates,
)
from ctr_dynamics.calibration.tip_samples import TipSamples
from ctr_dynamics.diagnosis.inference.map_fit import Fit
from ctr_dynamics.diagnosis.output.robot_export import robot_with_fit
from ctr_dynamics.effects import effect_quantities
from ctr_dynamics.errors import InputError
from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]
FITTED = 2.0 / 3.0  # of the tips; the rest judges
LEAST = 10  # tips in either part
TURNED_RAD = 0.2  # a mount that is off by more than a few tolerances is another mount


@dataclass(frozen=True)
class Calibration:
    """A calibrated robot and what it is worth.

    Attributes:
        robot: with fitted values and posterior deviations. fit: what was found.
        before, after: errors on the held-out tips with the robot as given and as fitted; fitted: errors on those of the fit.
    """

    robot: Robot
    fit: TipFit
    before: TipErrors
    after: TipErrors
    fitted: TipErrors


def split(samples: TipSamples, until: float | None) -> tuple[TipSamples, TipSamples]:
    """Tips of the fit and held-out ones: up to ``until`` s and after; by default the first two thirds, and in a table every third row is held out.

    Raises:
        InputError: one part has too few tips, or a table is to be split by time.
    """
    count = np.arange(len(samples.stamps))
    if not samples.timed:
        if until is not None:
            raise InputError("a table has no times", do="leave --fit-until out; every third row is held out")
        seen = count % 3 != 2
    elif until is None:
        seen = count < FITTED * len(count)
    else:
        seen = samples.stamps <= until
    for part, name in ((seen, "to fit"), (~seen, "held out")):
        if part.sum() < LEAST:
            raise InputError(
                f"{int(part.sum())} tips {name}, at least {LEAST} are needed",
                do="record more, or move --fit-until",
            )
    return samples.chosen(seen), samples.chosen(~seen)


def calibrate(
    robot: Robot,
    samples: TipSamples,
    *,
    until: float | None = None,
    mount: Floats | None = None,
    note: str = "",
) -> Calibration:
    """Fit ``robot`` to tips, inside the tolerances of its file, and judge it on others.

    The lag between tracker and joints is free, for clocks are seldom known; so is a mount that is given, or that is plainly another one.

    Args:
        until: s of the recording that are fitted; see :func:`split`.
        mount: (4,) wxyz, the mount that the samples' orientations are already rid of; None for none.
        note: goes into the robot's description.

    Raises:
        InputError: too few tips, or the static model has no solution at most of them.
    """
    seen, unseen = split(samples, until)
    here = seen.thinned(SAMPLES)
    model = TipModel(robot, here)
    coordinates = [Coordinate.of(q) for q in static_quantities(robot)]
    start: dict[Key, float] = {}
    if here.timed:
        lag, _, _ = first_lag(robot, here, False, MOST_LAG_S)
        start[DELAY] = lag - robot.tracker.delay.value
        coordinates.append(delay_coordinate(robot, MOST_LAG_S))
    free = False
    if here.axes[3:].any():
        found = first_mount(model, start)
        free = mount is not None or mount_angle(found) > TURNED_RAD
        if free:
            model.mount = found
            coordinates += mount_coordinates()
    fit = fit_tips(model, coordinates, start)
    judge, seen_again = TipModel(robot, unseen, model.mount), TipModel(robot, seen, model.mount)
    left = [m.residual(p, m.tips(p)) for m, p in ((judge, {}), (judge, fit.point), (seen_again, fit.point))]
    errors = [tip_errors(r, m) for r, m in zip(left, (judge, judge, seen_again), strict=True)]
    text = f"calibrated{f' {note}' if note else ''}: {1e3 * errors[1].rms:.2f} mm rms on held-out tips"
    calibrated = calibrated_robot(robot, fit, text)
    if free:
        calibrated = calibrated.with_mount(tuple(mount_vector(model, fit.point, mount).tolist()))
    calibrated = calibrated.model_copy(update={"model_error": model_error_of(left[1], unseen, robot)})
    return Calibration(
        robot=calibrated,
        fit=fit,
        before=errors[0],
        after=errors[1],
        fitted=errors[2],
    )


def calibrated_robot(robot: Robot, fit: TipFit, note: str) -> Robot:
    """``robot`` with the values and deviations of ``fit``."""
    known = {q.key: q for q in effect_quantities(robot)}
    places = [i for i, c in enumerate(fit.coordinates) if c.key in known]
    exported = Fit(
        causes=(),
        active=tuple(known[fit.coordinates[i].key] for i in places),
        values=fit.values[places],
        covariance=fit.covariance[np.ix_(places, places)],
        chi2=0.0,
        log_evidence=0.0,
        residual=np.zeros(0),
        whitened=np.zeros(0),
        columns=np.zeros((0, len(places))),
        cost=0.0,
        inflation=1.0,
    )
    return robot_with_fit(robot, exported, robot.name, note)
