"""Tables of actuator positions to static shapes.

Reading and checking the poses, solving each row, writing the result.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.messages.unit_quaternions import WRITTEN_WITHIN, is_unit, norm
from ctr_dynamics.io.text_files import check_regular
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.statics import Statics

Floats = NDArray[np.float64]

FORCE = ("Fx", "Fy", "Fz")
TIP, QUATERNION = ("tip_x", "tip_y", "tip_z"), ("qw", "qx", "qy", "qz")
MAX_ANGLE = 20 * math.pi  # rad; ten turns, more are degrees
MAX_FORCE = 100.0  # N


@dataclass(frozen=True)
class Pose:
    """One row: ``problem`` says why it cannot be used, else beta (N,) m, alpha (N,) rad, force (3,) N and end
    angles (N,) rad or None. ``tip_position`` (3,) m and ``tip_quaternion`` (4,) wxyz are measured; None where
    the table has none.
    """

    line: int
    beta: Floats
    alpha: Floats
    force: Floats
    end_angles: Floats | None
    problem: str = ""
    tip_position: Floats | None = None
    tip_quaternion: Floats | None = None


@dataclass(frozen=True)
class StaticRow:
    """Result of one row; the arrays are empty unless ``status`` is ok or unstable.

    Attributes:
        status: ok, unstable (stability <= 0), failed (no equilibrium found) or invalid (input that cannot be
        used).
        reason: of failed and invalid.
        tip_position: (3,) m in ``ctr_base``; tip_quaternion: (4,) wxyz of tube 1's tip frame.
        torques: (N,) internal moment m_iz at beta_i, N m.
        stability: det of d alpha / d psi_L, loads held.
    """

    line: int
    status: str
    reason: str = ""
    tip_position: Floats | None = None
    tip_quaternion: Floats | None = None
    torques: Floats | None = None
    stability: float = math.nan


def _columns(n: int, name: str) -> list[str]:
    return [f"{name}{i + 1}" for i in range(n)]


def _check_header(header: Sequence[str], n: int, where: str, measured: bool) -> list[str]:
    """Names of columns that are not read. Raises InputError for missing, doubled and misspelt ones."""
    needed = _columns(n, "beta") + _columns(n, "alpha")
    groups = [list(FORCE), _columns(n, "psiL")]
    if measured:
        needed += TIP
        groups.append(list(QUATERNION))
    known = [*needed, *(name for group in groups for name in group)]
    doubled = sorted({name for name in header if header.count(name) > 1})
    if doubled:
        raise InputError(f"column '{doubled[0]}' is there twice", do="keep one of them", where=where)
    missing = [name for name in needed if name not in header]
    spare = [name for name in header if name not in known]
    folded = {name.lower(): name for name in known}
    for name in spare:
        near = get_close_matches(name.lower(), folded, 1, cutoff=0.65)
        if near:
            raise InputError(
                f"column '{name}' is not known for a robot of {n} tube{'s' if n > 1 else ''}",
                do=f"did you mean '{folded[near[0]]}'? Columns are {', '.join(known)}",
                where=where,
            )
    if missing:
        raise InputError(
            f"column '{missing[0]}' is missing", do=f"needed are {', '.join(needed)}", where=where
        )
    for group in groups:
        absent = [name for name in group if name not in header]
        if absent and len(absent) < len(group):
            raise InputError(
                f"column '{absent[0]}' is missing", do=f"give all of {', '.join(group)}, or none", where=where
            )
    return spare


def read_poses(path: Path, model: Model, measured: bool = False) -> tuple[list[Pose], list[str]]:
    """Poses of a CSV file with the columns beta1.., alpha1.. and optionally Fx, Fy, Fz and psiL1..; SI units
    and radians. ``measured``: tips are needed too, tip_x, tip_y, tip_z and optionally qw, qx, qy, qz.

    Returns:
        The rows, those that cannot be used with their ``problem``, and the names of columns that were not
        read.

    Raises:
        InputError: the file cannot be read or its columns are not these.
    """
    where = str(path)
    check_regular(path, "give a CSV file")
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.reader(stream, strict=True)
            lines = [(reader.line_num, cells) for cells in reader if any(cell.strip() for cell in cells)]
    except UnicodeDecodeError as error:
        raise InputError(
            f"not UTF-8 at byte {error.start}",
            do="save as UTF-8 text; the tips of a bag are compared with --measured",
            where=where,
        ) from None
    except csv.Error as error:
        raise InputError(f"not a CSV file: {error}", do="separate columns by commas", where=where) from None
    except OSError as error:
        raise InputError(
            f"cannot be read ({error.strerror})", do="check path and rights", where=where
        ) from None
    if not lines:
        raise InputError(
            "the file is empty", do="its first line names the columns beta1,..,alpha1,..", where=where
        )
    header = [cell.strip() for cell in lines[0][1]]
    spare = _check_header(header, model.n, where, measured)
    if len(lines) == 1:
        raise InputError("there is no row below the header", do="give one row for each pose", where=where)
    return [_pose(model, header, line, cells, measured) for line, cells in lines[1:]], spare


def _pose(model: Model, header: list[str], line: int, cells: list[str], measured: bool) -> Pose:
    n = model.n
    names = _columns(n, "beta") + _columns(n, "alpha")
    tip = (*TIP, *QUATERNION) if measured else ()
    names += [name for name in (*FORCE, *_columns(n, "psiL"), *tip) if name in header]
    values: dict[str, float] = {}
    problem = ""
    if len(cells) != len(header):
        problem = f"{len(cells)} cells for {len(header)} columns; give one number for each column"
    for name in names if not problem else ():
        text = cells[header.index(name)].strip()
        try:
            values[name] = float(text)
        except ValueError:
            problem = problem or f"{name} is '{text}', not a number"
            continue
        if not math.isfinite(values[name]):
            problem = problem or f"{name} is {text}, not a finite number"
    empty: Floats = np.zeros(0)
    if problem:
        return Pose(line, empty, empty, empty, None, problem)

    def group(labels: Sequence[str]) -> Floats:
        return np.array([values[label] for label in labels])

    beta, alpha = group(_columns(n, "beta")), group(_columns(n, "alpha"))
    force = group(FORCE) if FORCE[0] in values else np.zeros(3)
    end_angles = group(_columns(n, "psiL")) if "psiL1" in values else None
    problem = model.robot.actuator_problem(beta, alpha) or ""
    angles = alpha if end_angles is None else np.concatenate([alpha, end_angles])
    if not problem and np.abs(angles).max() > MAX_ANGLE:
        problem = (
            f"an angle of {angles[np.abs(angles).argmax()]:g} rad is beyond +-{MAX_ANGLE:.3g} rad; "
            "angles are in rad, a value in degrees is multiplied by pi/180"
        )
    if not problem and np.abs(force).max() > MAX_FORCE:
        problem = (
            f"a force of {np.linalg.norm(force):g} N is beyond {MAX_FORCE:g} N; forces are in N, base frame"
        )
    position = group(TIP) if measured else None
    quaternion = group(QUATERNION) if measured and QUATERNION[0] in values else None
    if quaternion is not None:
        size = norm(quaternion)
        if not problem and not is_unit(size, WRITTEN_WITHIN):
            problem = f"the quaternion has norm {size:g}, 1 +- {WRITTEN_WITHIN:g} is needed"
        quaternion = quaternion / max(size, 1e-12)
    return Pose(line, beta, alpha, force, end_angles, problem, position, quaternion)


def solve_poses(model: Model, poses: Sequence[Pose], tolerance: float = 1e-10) -> Iterator[StaticRow]:
    """Static shapes of ``poses`` one by one, with the robot's own weight and bodies.

    Rows do not depend on each other.
    """
    statics = Statics(model, tolerance)
    for pose in poses:
        if pose.problem:
            yield StaticRow(pose.line, "invalid", pose.problem)
            continue
        try:
            found = statics.solve(pose.beta, pose.alpha, pose.force, end_angles=pose.end_angles)
        except InputError as error:
            yield StaticRow(pose.line, "invalid", str(error))
            continue
        if not found.converged:
            how = (
                "near the given end angles"
                if pose.end_angles is not None
                else "on the branch grown from straight tubes"
            )
            yield StaticRow(pose.line, "failed", f"no equilibrium was found {how}")
            continue
        stability = statics.stability(found, pose.beta, pose.alpha, pose.force)
        if not math.isfinite(stability):
            yield StaticRow(pose.line, "failed", "the stability measure is not finite")
            continue
        yield StaticRow(
            pose.line,
            "ok" if stability > 0 else "unstable",
            "",
            found.tip_position.copy(),
            found.tip_quaternion,
            found.x[: model.n].copy(),
            stability,
        )


def output_header(n: int) -> list[str]:
    """Columns of the result for ``n`` tubes."""
    tip = ["tip_x", "tip_y", "tip_z", "qw", "qx", "qy", "qz"]
    return [*tip, *_columns(n, "tau"), "stability", "status"]


def output_cells(row: StaticRow, n: int) -> list[str]:
    """One row of the result as text; numbers are empty where there is no shape."""
    if row.tip_position is None or row.tip_quaternion is None or row.torques is None:
        return [""] * (8 + n) + [row.status]
    numbers = [*row.tip_position, *row.tip_quaternion, *row.torques, row.stability]
    return [f"{value:.12g}" for value in numbers] + [row.status]
