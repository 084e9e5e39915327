"""`ctr-dynamics robot`: `new` writes a robot file from data sheets, `check` says what a file holds, `urdf` writes it for RViz."""

from __future__ import annotations

import dataclasses
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.atomic_files import atomic_file, check_targets
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import datasheet as sheets
from ctr_dynamics.robot_files import load_robot, robot_names
from ctr_dynamics.robot_files.summary import doubts, property_rows, tube_rows

# Option -> (SI unit, several values, what is asked, answer that is offered).
_ASKED: dict[str, tuple[str, bool, str, str]] = {
    "tip_mass": ("kg", False, "mass of a body at the tip", "0 g"),
    "tip_diameter": ("m", False, "diameter of that body", "0 mm"),
    "beta": ("m", True, "positions of the tubes' bases, <= 0, innermost first", ""),
    "alpha": ("rad", True, "angles of the actuators there, innermost first", ""),
    "position_noise": ("m", False, "tracker noise per axis, one sigma", "0.35 mm"),
    "rotation_noise": ("rad", False, "tracker rotation noise per axis, one sigma", "0.3 deg"),
    "delay": ("s", False, "how much older than its stamp a pose is", "0 ms +- 2 ms"),
    "lever_arm": (
        "m",
        True,
        "sensor in the tip frame: x, y, z",
        "0 mm +- 0.5 mm, 0 mm +- 0.5 mm, 0 mm +- 0.5 mm",
    ),
}


@dataclass(frozen=True)
class NewOptions:
    """Options of `robot new`."""

    file: Annotated[Path, typer.Argument(metavar="FILE.yaml", help="Robot file to write.")]
    tube: Annotated[
        list[str] | None,
        typer.Option(
            "--tube",
            metavar="DATA",
            help="One tube, innermost first: 'name=inner, od=1.244mm, id=1.028mm, straight=301mm, curved=97.1mm, "
            "radius=109mm+-2%, E=52GPa+-5%, density=6.45g/cm^3'.",
        ),
    ] = None
    name: Annotated[
        str, typer.Option("--name", metavar="NAME", help="Name of the robot; default: the file's.")
    ] = ""
    gravity: Annotated[
        str, typer.Option("--gravity", metavar="AXIS", help="Where weight points: -y, +x, ..")
    ] = "-y"
    tip_mass: Annotated[
        str, typer.Option("--tip-mass", metavar="MASS", help="Body at the tip: '8 g +- 0.1 g'.")
    ] = ""
    tip_diameter: Annotated[
        str, typer.Option("--tip-diameter", metavar="LENGTH", help="Of that body, a sphere.")
    ] = ""
    beta: Annotated[str, typer.Option("--beta", metavar="LIST", help="Rest positions: '-252mm, -198mm'.")] = (
        ""
    )
    alpha: Annotated[str, typer.Option("--alpha", metavar="LIST", help="Rest angles: '90deg, 90deg'.")] = ""
    position_noise: Annotated[
        str, typer.Option("--position-noise", metavar="LENGTH", help="Tracker noise, one sigma per axis.")
    ] = ""
    rotation_noise: Annotated[
        str, typer.Option("--rotation-noise", metavar="ANGLE", help="Its rotation noise, one sigma per axis.")
    ] = ""
    delay: Annotated[
        str,
        typer.Option(
            "--delay", metavar="TIME", help="How much older than its stamp a pose is: '18 ms +- 2 ms'."
        ),
    ] = ""
    lever_arm: Annotated[
        str,
        typer.Option("--lever-arm", metavar="LIST", help="Sensor in the tip frame: '0mm, 2mm+-0.5mm, -5mm'."),
    ] = ""
    registration: Annotated[
        str,
        typer.Option(
            "--registration",
            metavar="MATRIX",
            help="ctr_base in the tracker's frame: 16 numbers, the rows of [R t; 0 0 0 1], t in m.",
        ),
    ] = ""
    mount: Annotated[
        str,
        typer.Option(
            "--mount", metavar="LIST", help="Rotation vector of the sensor in the tip: '0deg, 90deg, 0deg'."
        ),
    ] = ""
    axes: Annotated[
        str, typer.Option("--axes", metavar="AXES", help="What the tracker measures, as xyzrp; default: all.")
    ] = ""
    force: Annotated[bool, typer.Option("--force", help="Write over an existing file.")] = False


def new(options: NewOptions) -> int:
    """Write a robot file from tube data sheets.

    Without --tube every value is asked for. Units stand behind the numbers; '+- 2 %' or '+- 0.01 mm' is one
    standard deviation.
    """
    file = options.file
    if file.exists() and not options.force:
        raise InputError("the file exists", do="give another name, or --force", where=str(file))
    given: dict[str, str] = {key: getattr(options, key) for key in _ASKED}
    tubes: list[tuple[str, dict[str, sheets.Measured]]]
    if options.tube:
        tubes = [sheets.tube_from_text(text, number) for number, text in enumerate(options.tube, 1)]
    else:
        try:
            tubes = _ask_tubes()
            given = {key: text or _ask(*_question(key)) for key, text in given.items()}
        except typer.Abort:
            raise InputError("no answer", do="give --tube for each tube to be asked nothing") from None
    values: dict[str, Any] = {}
    for key, text in given.items():
        if text.strip():
            unit, several, _, _ = _ASKED[key]
            read = sheets.measures if several else sheets.measured
            values[key] = read(text, unit, f"--{key.replace('_', '-')}")
    if options.mount:
        values["mount"] = sheets.measures(options.mount, "rad", "--mount")
    if options.registration:
        values["registration"] = sheets.matrix_from_text(options.registration, "--registration")
    sheet = dataclasses.replace(
        sheets.Sheet(options.name or file.stem, tuple(tubes), options.gravity, axes=options.axes), **values
    )
    robot = sheets.robot_from_sheet(sheet)
    assumed = sheets.rest_assumed(sheet)
    with atomic_file(file) as temporary:
        text = sheets.robot_file_text(robot, [*sheets.ASSUMED, *assumed])
        temporary.write_text(text, encoding="utf-8")
    _show(robot)
    for line in assumed:
        print(f"ctr-dynamics: note: {line}", file=sys.stderr)
    print(f"output  {file}")
    return 0


def check(
    robot: Annotated[
        str,
        typer.Argument(metavar="NAME_OR_FILE", help=f"A robot file, or one of {', '.join(robot_names())}."),
    ],
    rest: Annotated[bool, typer.Option("--rest/--no-rest", help="Solve the shape at rest.")] = True,
) -> int:
    """Say what a robot file holds, what in it looks doubtful, where its tip rests, how it vibrates, and with which nodes, errors and cost it is
    estimated.

    Exit code 1 when no equilibrium is found at rest.
    """
    loaded = load_robot(robot)
    _show(loaded)
    if not rest:
        return 0
    found = _rest(loaded)
    if found:
        _accuracy(loaded)
    return 0 if found else 1


def urdf(
    robot: Annotated[
        str,
        typer.Argument(metavar="NAME_OR_FILE", help=f"A robot file, or one of {', '.join(robot_names())}."),
    ],
    output: Annotated[Path, typer.Option("--output", metavar="FILE.urdf", help="URDF file to write.")],
    frame: Annotated[str, typer.Option("--frame", metavar="NAME", help="Its base link.")] = "ctr_base",
) -> int:
    """Write the robot as a URDF, for RViz and robot_state_publisher: drives as joints, ends of the tubes as frames."""
    from ctr_dynamics.view.urdf import robot_urdf

    loaded = load_robot(robot)
    check_targets({"output": output}, {"robot file": loaded.source})
    with atomic_file(output) as part:
        part.write_text(robot_urdf(loaded, frame), encoding="utf-8")
    print(f"output  {output}")
    return 0


robot = {"new": new, "check": check, "urdf": urdf}


def _show(robot: Robot) -> None:
    rows = tube_rows(robot)
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    print(f"robot {robot.name}")
    for row in rows:
        print("  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip())
    for name, text in property_rows(robot):
        print(f"{name:<22} {text}")
    for doubt in doubts(robot):
        print(f"ctr-dynamics: note: {doubt}", file=sys.stderr)


def _rest(robot: Robot) -> bool:
    from ctr_dynamics.model.model import Model
    from ctr_dynamics.model.statics import Statics

    found = Statics(Model(robot)).solve(robot.rest.beta.value, robot.rest.alpha.value)
    if not found.converged:
        print("ctr-dynamics: warning: no static equilibrium was found at rest", file=sys.stderr)
        return False
    x, y, z = 1e3 * found.tip_position
    beta = ", ".join(f"{1e3 * x:.2f}" for x in robot.rest.beta.value)
    alpha = ", ".join(f"{math.degrees(x):.2f}" for x in robot.rest.alpha.value)
    print(f"rest         beta {beta} mm, alpha {alpha} deg")
    print(f"tip at rest  {x:.2f}, {y:.2f}, {z:.2f} mm in ctr_base")
    return True


def _accuracy(robot: Robot) -> None:
    """Modes at rest, nodes, and expected errors."""
    from ctr_dynamics.estimation.discretisation import discretise
    from ctr_dynamics.parameters import Settings

    settings = Settings()
    found = discretise(robot, int(settings["model.nodes"]), float(settings["model.accuracy_m"]))
    for i, mode in enumerate(found.modes, 1):
        share = f"{1e3 * mode.amplitude_m:8.3f} mm"
        print(
            f"mode {i}  {mode.frequency_hz:8.2f} Hz  damping {mode.damping:6.3f}  {share}"
            f"{'' if mode.resolved else '  unresolved'}"
        )
    print(f"nodes        {found.nodes}")
    print("step         3 ms, one or more substeps of Radau IIA, order 7")
    for name, error in (("nodes", found.space_error_m), ("steps", found.time_error_m)):
        print(f"error of {name}  {'not known' if error is None else f'{1e3 * error:.4f} mm'}")
    print("(rms of the tip over 4 s after a load is cut that deflects it by a third of the exposed length)")
    shortfall = found.shortfall(float(settings["model.accuracy_m"]))
    if shortfall:
        print(f"ctr-dynamics: warning: {shortfall}", file=sys.stderr)


def _question(key: str) -> tuple[str, str]:
    _, _, text, offered = _ASKED[key]
    return text, offered


def _ask(text: str, offered: str = "", si: str = "") -> str:
    """An answer; with `si` it is asked for again until it can be read."""
    while True:
        answer = str(typer.prompt(text, default=offered, show_default=bool(offered), err=True))
        if not si or not answer:
            return answer
        try:
            sheets.measured(answer, si, text)
        except InputError as error:
            print(f"  {error}", file=sys.stderr)
        else:
            return answer


def _ask_tubes() -> list[tuple[str, dict[str, sheets.Measured]]]:
    tubes: list[tuple[str, dict[str, sheets.Measured]]] = []
    while True:
        number = len(tubes) + 1
        text = f"name of tube {number}, {'the innermost' if number == 1 else 'the next outer one (empty: no more)'}"
        name = _ask(text, "inner" if number == 1 else "")
        if not name:
            return tubes
        data: dict[str, sheets.Measured] = {}
        for key, (si, needed, meaning) in sheets.TUBE_KEYS.items():
            if key == "radius" and not data.get("curved"):
                continue
            offered = {"id": "0 mm", "density": "6.45 g/cm^3"}.get(key, "")
            answer = ""
            while not answer:
                answer = _ask(
                    f"  {meaning} ({key}){'' if needed or key == 'radius' else ', empty: none'}", offered, si
                )
                if not needed and key != "radius":
                    break
            if answer:
                data[key] = sheets.measured(answer, si, key)
        tubes.append((name, data))
