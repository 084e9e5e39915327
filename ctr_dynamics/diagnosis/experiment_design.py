"""Motions of an experiment, put together from blocks that one robot can make.

In: a robot and random numbers. Out: blocks, and scenarios of them. A block begins and ends at the rest position, so that blocks can follow one
another in any order and what they tell of the parameters adds up. Its motions are splines, as fast as the options allow, along which the robot stays
away from elastic instability. A weight may hang at the tip meanwhile: such blocks come first, and then the weight is cut.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ctr_dynamics.diagnosis.diagnosis_options import DesignOptions
from ctr_dynamics.errors import InputError
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.stability import StabilityWatch
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.robot import Robot
from ctr_dynamics.simulation.motion_primitives import AnyPrimitive, Hold, Table
from ctr_dynamics.simulation.scenario import Load, Scenario, TubeMotion

Floats = NDArray[np.float64]
Kind = Literal["rest", "turns", "together", "translations"]
SPACING_S = 0.01  # of the points of a spline: a joint state each
LOOKS_S = 0.05  # between looks at the stability
SECANTS = 3  # to the mass of a weight
TRIES = 3  # for each motion, at a robot that can hardly move
HALVINGS = 4  # of a motion that is too large for the robot


class MotionBlock(NamedTuple):
    """Motions from the rest position and back: ``rotations`` and ``translations`` (points, N) rad and m at every ``SPACING_S``, while a weight
    of ``hung_kg`` hangs at the tip (0: none)."""

    kind: Kind
    hung_kg: float
    rotations: Floats
    translations: Floats

    @property
    def loaded(self) -> bool:
        """Whether a weight hangs at the tip."""
        return self.hung_kg > 0.0


def motion_blocks(robot: Robot, options: DesignOptions) -> list[MotionBlock]:
    """Rest with a weight, and random motions of every kind with and without it; fewer where the robot can hardly move."""
    rng = np.random.default_rng(options.seed)
    points = round(options.block_s / SPACING_S) + 1
    nothing = np.zeros((points, robot.n_tubes))
    weight = hung_mass(robot, options) if any(robot.gravity.value) else 0.0
    blocks = [MotionBlock("rest", weight, nothing, nothing)]
    for kind in itertools.islice(_kinds(robot.n_tubes), TRIES * options.blocks):
        hung_kg = 0.0 if len(blocks) % 2 else weight
        block = _safe(robot, _random(robot, kind, hung_kg, rng, options), options)
        if block is not None:
            blocks.append(block)
        if len(blocks) > options.blocks:
            break
    return blocks


def _kinds(n: int) -> Iterator[Kind]:
    """Kinds of blocks in turn."""
    one_tube: tuple[Kind, ...] = ("together", "together", "translations")
    yield from itertools.cycle(("turns", "turns", "turns", *one_tube) if n > 1 else one_tube)


def _random(
    robot: Robot, kind: Kind, hung_kg: float, rng: np.random.Generator, options: DesignOptions
) -> MotionBlock:
    """A motion of that kind with as many turning points as chance has it, as fast as is allowed."""
    n, t = robot.n_tubes, np.arange(round(options.block_s / SPACING_S) + 1) * SPACING_S
    knots = int(rng.choice(options.turning_points))

    def splines(count: int, rate: float, most: float) -> Floats:
        made = np.zeros((len(t), count))
        for column in range(count):
            values = np.concatenate([[0.0], rng.normal(size=knots), [0.0]])
            spline = CubicSpline(np.linspace(0.0, t[-1], knots + 2), values, bc_type="clamped")
            path = spline(t)
            path[-1] = 0.0
            made[:, column] = path * min(rate / np.abs(spline(t, 1)).max(), most / np.abs(path).max())
        return made

    rotations, translations = np.zeros((len(t), n)), np.zeros((len(t), n))
    if kind == "turns":
        rotations = splines(n, options.fastest_rad_s, options.farthest_rad)
    elif kind == "together":
        rotations = np.repeat(splines(1, options.fastest_rad_s, options.farthest_rad), n, axis=1)
    else:
        rotations = splines(n, 0.5 * options.fastest_rad_s, options.farthest_rad)
        farthest = options.farthest_translation * robot.exposed_length
        translations = splines(n, options.fastest_m_s, farthest)
    return MotionBlock(kind, hung_kg, rotations, translations)


def _safe(robot: Robot, block: MotionBlock, options: DesignOptions) -> MotionBlock | None:
    """The block, or half of its motion, or a quarter and so on: as much as keeps the robot where it can be and stable. None where nothing does."""
    for halved in range(HALVINGS + 1):
        part = 0.5**halved
        smaller = block._replace(rotations=part * block.rotations, translations=part * block.translations)
        if _possible(robot, smaller, options):
            return smaller
    return None


def _possible(robot: Robot, block: MotionBlock, options: DesignOptions) -> bool:
    """Whether the robot can be at all points of the motion, and its measure of elastic stability stays above a part of that at rest."""
    alpha, beta = np.array(robot.rest.alpha.value), np.array(robot.rest.beta.value)
    watch = StabilityWatch(Model(robot, nodes=16))
    force = block.hung_kg * np.array(robot.gravity.value)
    try:
        resting = watch.update(0.0, beta, alpha)
        for i in range(0, len(block.rotations), round(LOOKS_S / SPACING_S)):
            now = watch.update(i * SPACING_S, beta + block.translations[i], alpha + block.rotations[i], force)
            if now.lost or not now.measure > options.least_stability * resting.measure:
                return False
    except InputError:
        return False
    return True


def scenario_of(robot: Robot, blocks: Sequence[MotionBlock], options: DesignOptions) -> Scenario:
    """The ``blocks`` one after another, those with a weight first. It is cut half-way through the pause behind them."""
    order = sorted(blocks, key=lambda block: not block.loaded)
    n, gap = robot.n_tubes, Hold(kind="hold", duration_s=options.pause_s)
    tubes = []
    for tube in range(n):
        axes: list[list[AnyPrimitive]] = []
        for paths in ([b.rotations for b in order], [b.translations for b in order]):
            axis: list[AnyPrimitive] = []
            for path in paths:
                times = np.round(np.arange(len(path)) * SPACING_S, 9).tolist()
                values = np.round(path[:, tube], 6).tolist()
                axis += [Table(kind="table", duration_s=times[-1], times_s=times, values=values), gap]
            axes.append(axis if any(path[:, tube].any() for path in paths) else [])
        tubes.append(TubeMotion(rotation=axes[0], translation=axes[1]))
    loaded, each_s = sum(block.loaded for block in order), options.block_s + options.pause_s
    cut_s = round(loaded * each_s - 0.5 * options.pause_s, 9)
    loads = [Load(end_s=cut_s, fall_s=0.01, hung_mass_kg=order[0].hung_kg)] if loaded else []
    return Scenario(duration_s=len(order) * each_s + options.pause_s, tubes=tubes, loads=loads)


def hung_mass(robot: Robot, options: DesignOptions) -> float:
    """kg, of the weight: it deflects the tip by a part of the exposed length, and has two digits."""
    model, gravity = Model(robot, nodes=16), np.array(robot.gravity.value)
    beta, alpha = np.array(robot.rest.beta.value), np.array(robot.rest.alpha.value)
    wanted, mass = options.deflection * robot.exposed_length, 1e-4 * model.scale[0]
    statics = Statics(model)
    free = statics.solve(beta, alpha)
    for _ in range(SECANTS):  # a deflection grows a little less than its weight
        moved = statics.solve(beta, alpha, mass * gravity).tip_position - free.tip_position
        mass *= wanted / float(np.linalg.norm(moved))
    return round(mass, 1 - math.floor(math.log10(mass)))
