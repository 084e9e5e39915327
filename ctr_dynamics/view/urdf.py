"""The robot as a URDF: plate, drives and the ends of the tubes, for RViz and robot_state_publisher.

A URDF has rigid links only. So the drives of the tubes are its joints, under the names of the joint states, and the tubes themselves come as markers
(:mod:`ctr_dynamics.view.markers`). The ends of the tubes hang on floating joints, whose transforms the estimator publishes.
"""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree import ElementTree as ET

from ctr_dynamics.errors import InputError
from ctr_dynamics.robot import Robot
from ctr_dynamics.runtime.transform_encoder import tip_frame
from ctr_dynamics.view.markers import COLOURS

PLATE_RADIUS, PLATE_THICKNESS = 0.03, 0.002  # m, for the eye
HUB_LENGTH = 0.008  # m, of a drive
# Where the robot file states no speeds; a URDF wants a limit, and effort is none that is known.
FASTEST_ROTATION, FASTEST_TRANSLATION = 100.0, 1.0  # rad/s, m/s

_Shape = tuple[float, ET.Element, tuple[float, ...]]  # place along z, m; geometry; colour


def robot_urdf(robot: Robot, frame_id: str = "ctr_base") -> str:
    """The URDF of ``robot`` as a text, with its base link ``frame_id``.

    Joints ``tubeN_translation`` (m) and ``tubeN_rotation`` (rad) of every tube N are those of the joint states: the first is zero or negative, the
    second about +z. SI units.

    Raises:
        InputError: ``frame_id`` is empty or holds white space.
    """
    if not frame_id or frame_id.split() != [frame_id]:
        raise InputError(
            f"name of the base link '{frame_id}'", do="give a name without blanks", where="--frame"
        )
    root = ET.Element("robot", name=robot.name)
    _link(root, frame_id, [(0.0, _cylinder(PLATE_RADIUS, PLATE_THICKNESS), (0.6, 0.6, 0.6))])
    actuators = robot.actuators
    rotation = actuators.rotation_speed.value if actuators and actuators.rotation_speed else FASTEST_ROTATION
    translation = (
        actuators.translation_speed.value
        if actuators and actuators.translation_speed
        else FASTEST_TRANSLATION
    )
    for i, tube in enumerate(robot.tubes):
        name, colour = f"tube{i + 1}", COLOURS[i % len(COLOURS)]
        outer, straight = tube.outer_radius.value, -float(robot.rest.beta.value[i])
        _link(root, f"{name}_slide", [])
        slide = _joint(root, f"{name}_translation", "prismatic", frame_id, f"{name}_slide")
        ET.SubElement(slide, "axis", xyz="0 0 1")
        limits: dict[str, str] = {"lower": _text(-tube.length), "upper": "0", "effort": "0"}
        ET.SubElement(slide, "limit", {**limits, "velocity": _text(translation)})
        shapes: list[_Shape] = [(0.0, _cylinder(5.0 * outer, HUB_LENGTH), colour)]
        if straight > 0.0:  # as far as the plate where the robot rests
            shapes.append((0.5 * straight, _cylinder(outer, straight), colour))
        _link(root, f"{name}_drive", shapes)
        turn = _joint(root, f"{name}_rotation", "continuous", f"{name}_slide", f"{name}_drive")
        ET.SubElement(turn, "axis", xyz="0 0 1")
        ET.SubElement(turn, "limit", effort="0", velocity=_text(rotation))
        tip = tip_frame(frame_id, i + 1)
        _link(root, tip, [(0.0, ET.Element("sphere", radius=_text(2.0 * outer)), colour)])
        _joint(root, f"{name}_tip", "floating", frame_id, tip)
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _link(root: ET.Element, name: str, shapes: Sequence[_Shape]) -> None:
    """A link with shapes at places along its z axis (m), each in its colour."""
    link = ET.SubElement(root, "link", name=name)
    for number, (z, shape, colour) in enumerate(shapes):
        visual = ET.SubElement(link, "visual")
        ET.SubElement(visual, "origin", xyz=f"0 0 {_text(z)}", rpy="0 0 0")
        ET.SubElement(visual, "geometry").append(shape)
        material = ET.SubElement(visual, "material", name=f"{name}_{number}")
        ET.SubElement(material, "color", rgba=" ".join(f"{c:g}" for c in (*colour, 1.0)))


def _joint(root: ET.Element, name: str, kind: str, parent: str, child: str) -> ET.Element:
    joint = ET.SubElement(root, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    return joint


def _cylinder(radius: float, length: float) -> ET.Element:
    return ET.Element("cylinder", radius=_text(radius), length=_text(length))


def _text(value: float) -> str:
    """A number without an exponent that readers of URDF might not take."""
    return f"{value:.9f}".rstrip("0").rstrip(".")
