"""The robot as a visualization_msgs/MarkerArray: every tube in its colour and diameter, and where the tip may be."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.cdr import CdrWriter
from ctr_dynamics.robot import Robot

TUBES_TOPIC = "/ctr/view/tubes"
MARKER_ARRAY = "visualization_msgs/msg/MarkerArray"
# Innermost first; distinguishable with every colour vision (Okabe and Ito 2008).
COLOURS = (
    (0.835, 0.369, 0.0),
    (0.0, 0.447, 0.698),
    (0.0, 0.62, 0.451),
    (0.8, 0.475, 0.655),
    (0.902, 0.624, 0.0),
)
LINE_STRIP, SPHERE = 4, 2
ADD = 0
CHI_95 = math.sqrt(7.814727903251179)
"""Radius of the ellipsoid that holds 95 % of a 3-D normal distribution, in deviations."""

Floats = NDArray[np.float64]


def tube_lines(robot: Robot, beta: Sequence[float], s: Floats, points: Floats) -> list[Floats]:
    """Points (m, 3) of each tube's visible centre line, from the base plate to the tube's end.

    Args:
        beta: (N,) positions of the tubes' bases, m.
        s: (P,) arc lengths of the backbone, m, rising. points: (P, 3) m.
    """
    lines = []
    for tube, b in zip(robot.tubes, beta, strict=True):
        end = min(max(tube.length + b, 0.0), float(s[-1]))
        inside = points[s < end]
        last = np.array([np.interp(end, s, points[:, i]) for i in range(3)])
        lines.append(np.vstack([inside, last]) if len(inside) else np.vstack([points[0], last]))
    return lines


def ellipsoid(covariance: Floats, scale: float) -> tuple[Floats, Floats]:
    """Diameters (3,) m and orientation (4,) xyzw of the 95 % ellipsoid of a (3, 3) covariance, magnified by `scale`."""
    sizes, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    if np.linalg.det(axes) < 0:
        axes[:, 0] = -axes[:, 0]
    diameters = 2.0 * scale * CHI_95 * np.sqrt(np.maximum(sizes, 1e-18))
    return diameters, _quaternion(axes)


def _quaternion(R: Floats) -> Floats:
    """(4,) xyzw of a rotation matrix, by its largest component."""
    squares = np.array(
        [
            1 + R[0, 0] - R[1, 1] - R[2, 2],
            1 - R[0, 0] + R[1, 1] - R[2, 2],
            1 - R[0, 0] - R[1, 1] + R[2, 2],
            1 + np.trace(R),
        ]
    )
    k = int(np.argmax(squares))
    rows = (
        (squares[0], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[2, 1] - R[1, 2]),
        (R[0, 1] + R[1, 0], squares[1], R[1, 2] + R[2, 1], R[0, 2] - R[2, 0]),
        (R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], squares[2], R[1, 0] - R[0, 1]),
        (R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], squares[3]),
    )
    q = np.array(rows[k])
    return np.asarray(q / np.linalg.norm(q))


class Marker(NamedTuple):
    """What a marker shows: position (3,) m, orientation (4,) xyzw, scale (3,) m, colour (4,) rgba, points (n, 3) m of a line."""

    namespace: str
    number: int
    kind: int
    position: Sequence[float]
    orientation: Sequence[float]
    scale: Sequence[float]
    colour: Sequence[float]
    points: Floats


def encode_tubes(
    robot: Robot,
    stamp_ns: int,
    frame_id: str,
    backbone: NDArray[np.float32],
    beta: Sequence[float],
    tip: tuple[Floats, Floats] | None = None,
    diameter_scale: float = 1.0,
    ellipsoid_scale: float = 10.0,
) -> bytes:
    """The serialised MarkerArray.

    Args:
        backbone: (P, 15) as in `/ctr/estimator/backbone_state`.
        beta: (N,) m.
        tip: position (3,) m and covariance (3, 3) m^2 of `/ctr/estimator/tip_pose`; None draws no ellipsoid.
        diameter_scale, ellipsoid_scale: magnification of tubes and ellipsoid.
    """
    rows = backbone.astype(float)
    s, points = rows[:, topics.BACKBONE_FIELDS.index("s")], rows[:, 1:4]
    writer = CdrWriter()
    writer.uint32(robot.n_tubes + (tip is not None))
    identity = (0.0, 0.0, 0.0, 1.0)
    for i, line in enumerate(tube_lines(robot, beta, s, points)):
        diameter = 2.0 * robot.tubes[i].outer_radius.value * diameter_scale
        colour = (*COLOURS[i % len(COLOURS)], 1.0)
        tube = Marker("tubes", i, LINE_STRIP, (0.0, 0.0, 0.0), identity, (diameter, 0.0, 0.0), colour, line)
        _write(writer, stamp_ns, frame_id, tube)
    if tip is not None:
        size, turn = ellipsoid(tip[1], ellipsoid_scale)
        grey = (0.6, 0.6, 0.6, 0.5)
        place = tip[0].tolist()
        cloud = Marker(
            "tip covariance", 0, SPHERE, place, turn.tolist(), size.tolist(), grey, np.zeros((0, 3))
        )
        _write(writer, stamp_ns, frame_id, cloud)
    return writer.done()


def _write(writer: CdrWriter, stamp_ns: int, frame_id: str, marker: Marker) -> None:
    """One visualization_msgs/Marker, field by field in the order of its definition."""
    writer.header(stamp_ns, frame_id)
    writer.string(marker.namespace)
    for value in (marker.number, marker.kind, ADD):
        writer.int32(value)
    writer.float64s([*marker.position, *marker.orientation, *marker.scale])
    writer.float32s(marker.colour)
    writer.int32(0)  # lifetime: until replaced
    writer.uint32(0)
    writer.boolean(False)  # frame_locked
    writer.uint32(len(marker.points))
    writer.float64s(marker.points.reshape(-1).tolist())
    writer.uint32(0)  # colors
    writer.string("")  # texture_resource
    writer.header(0, "")  # texture
    writer.string("")
    writer.raw(b"")
    writer.uint32(0)  # uv_coordinates
    writer.string("")  # text
    writer.string("")  # mesh_resource
    writer.string("")  # mesh_file
    writer.raw(b"")
    writer.boolean(False)  # mesh_use_embedded_materials
