"""Times from a device's frame numbers: the host's stamps say when, on average, and the frames say how far apart."""

from __future__ import annotations

from decimal import Decimal

import numpy as np

from ctr_dynamics.errors import InputError

SCATTER = 0.5  # periods rms about the line, beyond which the numbers do not count frames


def times_of_frames(
    times: list[Decimal], frames: list[float], seconds_per_unit: float, where: str
) -> tuple[list[Decimal], str]:
    """Times on the straight line through the stamps ``times`` over the numbers ``frames``, in the unit of ``times``, and a note.

    The mean of a host's delays stays in the stamps, as a latency that an alignment finds. Their scatter does not.

    Raises:
        InputError: fewer than three frames, or the stamps do not lie on a line: the counter was set back, or frames come at a changing rate.
    """
    if len(times) < 3:
        raise InputError(
            f"{len(times)} frames, at least 3 are needed for their rate",
            do="leave time.frames out",
            where=where,
        )
    first = times[0]
    t = np.array([float(time - first) for time in times])
    count = np.array(frames) - frames[0]
    middle, place = t.mean(), count.mean()
    period = float((count - place) @ (t - middle) / ((count - place) @ (count - place)))
    left = t - middle - period * (count - place)
    scatter = float(np.sqrt(np.mean(left**2)))
    if period <= 0.0 or scatter > SCATTER * period:
        raise InputError(
            f"times scatter by {seconds_per_unit * scatter:.4g} s rms about the frame numbers, {seconds_per_unit * period:.4g} s apart",
            do="check the column of frame numbers, or leave time.frames out; cut a log whose counter is set back",
            where=where,
        )
    found = [first + Decimal(repr(float(middle + period * (c - place)))) for c in count]
    note = (
        f"{where}: frames every {1e3 * seconds_per_unit * period:.4f} ms give the times; the stamps of the host scatter by "
        f"{1e3 * seconds_per_unit * scatter:.2f} ms rms about them"
    )
    return found, note
