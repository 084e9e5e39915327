"""How far off the tip may be, and whether an output can be trusted with that."""

from __future__ import annotations

from typing import NamedTuple

from ctr_dynamics.estimation.monitoring.health import Health


class Deviations(NamedTuple):
    """Deviations of one output, m in 3-D.

    Attributes:
        tip: by the published covariance. driven: part of it, by actuators that are not known yet. by_load: how far a known load that no measurement
            has confirmed moves the tip. largest: limit of the deviation.
    """

    tip: float
    driven: float
    by_load: float
    largest: float

    def problem(self, health: Health, unknown_delay: float | None = None) -> str:
        """Why the output cannot be trusted; empty when it can.

        ``unknown_delay``: where the tracker is late by a time that is not known, how far it and the model lie apart at least, m.
        """
        limit = f"limit {1e3 * self.largest:.1f} mm"
        if self.tip > self.largest and 2.0 * self.driven**2 > self.tip**2:
            return (
                f"joint states come too late: what the actuators did meanwhile may have moved the tip by {1e3 * self.tip:.1f} mm, {limit} "
                "(output.largest_deviation_m)"
            )
        if self.tip > self.largest and self.by_load > self.largest:
            return (
                f"the known load has jumped and moves the tip by {1e3 * self.by_load:.1f} mm, and no measurement has confirmed it: {limit} "
                "(output.largest_deviation_m)"
            )
        if self.tip > self.largest:
            return f"the tip is known to no better than the limit of {1e3 * self.largest:.1f} mm (output.largest_deviation_m)"
        apart = health.measurements.apart_m if unknown_delay is None else unknown_delay
        if health.fusing and health.tracker_alive and apart > self.largest:
            return (
                f"tracker and model lie {1e3 * apart:.1f} mm apart, {limit}: check the tracker's frame and sensor, the joints' "
                "zeros and the robot file"
            )
        if health.fusing and health.rejecting:
            return "the tracker contradicts the model: most of its last measurements are outside the gate"
        return ""
