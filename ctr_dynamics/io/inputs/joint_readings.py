"""Readings of actuators, as a lab's driver names and scales them, as ``tubeN_rotation`` (rad) and ``tubeN_translation`` (m)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.messages.cdr import JointStateIn

Floats = NDArray[np.float64]
_CANONICAL = re.compile(
    r"(?P<prefix>.*?[/._:-])?tube[_-]?(?P<tube>\d{1,2})[_/.-](?P<kind>rotation|translation)"
)
_WAITING = 20  # stamps that wait for the rest of their joints: drivers that split joint states finish one before the next few


@dataclass(frozen=True)
class JointReadings:
    """How readings become alpha (rad) and beta (m): scale * reading + offset.

    Attributes:
        rotation_names, translation_names: of the driver, innermost tube first; empty: ``tubeN_rotation`` and ``tubeN_translation``, with or
            without a prefix, from 1 or from 0. A name that is a number is the place in a message without names, from 0.
        rotation_scale, translation_scale: one number, one a tube, or the rows of an (N, N) matrix where readings are sums of angles.
        rotation_offset: rad, translation_offset: m; one number, or one a tube.
    """

    rotation_names: tuple[str, ...] = ()
    translation_names: tuple[str, ...] = ()
    rotation_scale: tuple[float, ...] = (1.0,)
    rotation_offset: tuple[float, ...] = (0.0,)
    translation_scale: tuple[float, ...] = (1.0,)
    translation_offset: tuple[float, ...] = (0.0,)

    @property
    def plain(self) -> bool:
        """Whether readings need neither names nor numbers changed."""
        return self == JointReadings()

    @property
    def neutral(self) -> bool:
        """Whether the numbers stay as they are."""
        scales = {*self.rotation_scale, *self.translation_scale}
        return scales == {1.0} and not any((*self.rotation_offset, *self.translation_offset))

    @property
    def turns(self) -> tuple[float, ...]:
        """rad, by which an angle jumps where its reading wraps: a turn of the reading in radians or of the actuator."""
        turn = 2.0 * np.pi
        return tuple(sorted({turn, *(turn * abs(s) for s in self.rotation_scale if abs(s) > 0.05)}))

    def matrices(self, n: int) -> tuple[Floats, Floats, Floats, Floats]:
        """Rotation scale (n, n) and offset (n,), translation scale (n, n) and offset (n,).

        Raises:
            InputError: another count of numbers than 1, n or, for scales, n n.
        """
        return (
            _matrix(self.rotation_scale, n, "joints.rotation_scale"),
            _vector(self.rotation_offset, n, "joints.rotation_offset_rad"),
            _matrix(self.translation_scale, n, "joints.translation_scale"),
            _vector(self.translation_offset, n, "joints.translation_offset_m"),
        )

    def check(self) -> None:
        """Raises:
        InputError: names given for one kind alone, in different numbers, or twice.
        """
        rotations, translations = self.rotation_names, self.translation_names
        if len(rotations) != len(translations):
            raise InputError(
                f"joints.rotation_names has {len(rotations)} names and joints.translation_names {len(translations)}",
                do="give one of each for every tube, innermost first",
            )
        names = (*rotations, *translations)
        double = next((name for name in names if names.count(name) > 1), None)
        if double is not None:
            raise InputError(f"'{double}' stands for two joints", do="give every joint its own name")


def _vector(values: Sequence[float], n: int, name: str) -> Floats:
    if len(values) not in (1, n):
        raise InputError(
            f"has {len(values)} numbers for {n} tubes",
            do="give one number, or one for each tube",
            where=f"parameter {name}",
        )
    return np.broadcast_to(np.array(values, dtype=float), (n,)).copy()


def _matrix(values: Sequence[float], n: int, name: str) -> Floats:
    if len(values) == n * n:
        return np.array(values, dtype=float).reshape(n, n)
    if len(values) not in (1, n):
        raise InputError(
            f"has {len(values)} numbers for {n} tubes",
            do=f"give one number, one for each tube, or the {n} rows of a matrix",
            where=f"parameter {name}",
        )
    return np.diag(_vector(values, n, name))


class JointConverter:
    """Joint states as the estimator names and scales them, from a driver's messages in the order of their arrival.

    A message that holds some of the joints waits for others of the same stamp.

    Args:
        readings: names, scales and offsets.
        n: number of tubes; 0 where it is not known: the names tell.

    Attributes:
        notes: what was taken for what, one line each.
        surplus: that the messages name more tubes than there are, in words; empty where they do not.
    """

    def __init__(self, readings: JointReadings, n: int = 0) -> None:
        readings.check()
        declared = len(readings.rotation_names)
        if declared and n and declared != n:
            raise InputError(
                f"joints.rotation_names has {declared} names, the robot {n} tubes",
                do="give one for each tube, innermost first",
            )
        self.readings, self.n = readings, n or declared
        if self.n:
            readings.matrices(self.n)  # so many numbers as there are tubes
        self.notes: list[str] = []
        self.surplus = ""
        self._plans: dict[tuple[tuple[str, ...], int], dict[str, int]] = {}
        self._from_zero = False
        self._waiting: dict[int, dict[str, float]] = {}
        self._matrices: tuple[Floats, Floats, Floats, Floats] | None = None
        self._names: tuple[str, ...] = ()

    def convert(self, message: JointStateIn) -> list[JointStateIn]:
        """The whole joint state that ``message`` is, or completes; none while joints are missing.

        What never becomes whole is given as far as it has come, and a message whose joints are not known as it is, for who names what is missing.
        """
        if not message.positions and message.names:
            return [] if self._waiting else [message]
        key = (message.names, len(message.positions))
        plan = self._plans.get(key)
        if plan is None:
            plan = self._plans[key] = self._plan(*key)
        if not plan or len(message.positions) < len(message.names):
            return [message]
        wanted = self._wanted(plan)
        if len(plan) >= len(wanted):
            if self._waiting:
                self._waiting.pop(message.stamp_ns, None)
            if plan.get(wanted[0]) is not None and self.readings.neutral and self._same(plan, message.names):
                return [message]
            return [self._scaled(message, wanted, [message.positions[plan[name]] for name in wanted])]
        return self._completed(message, wanted, plan)

    def _same(self, plan: dict[str, int], names: tuple[str, ...]) -> bool:
        """Whether the message itself names the joints as the estimator does."""
        return bool(names) and all(names[place] == name for name, place in plan.items())

    def _wanted(self, plan: dict[str, int]) -> tuple[str, ...]:
        """All joints, rotations first."""
        n = self.n or max(int(name[4 : name.index("_")]) for name in (*plan, *self._names))
        if len(self._names) != 2 * n:
            self._names = joint_names(n)
        return self._names

    def _completed(
        self, message: JointStateIn, wanted: tuple[str, ...], plan: dict[str, int]
    ) -> list[JointStateIn]:
        parts = self._waiting.setdefault(message.stamp_ns, {})
        for name, place in plan.items():
            parts.setdefault(name, message.positions[place])
        if len(parts) == len(wanted):
            del self._waiting[message.stamp_ns]
            return [self._scaled(message, wanted, [parts[name] for name in wanted])]
        return self.rest(_WAITING)

    def rest(self, waiting: int = 0) -> list[JointStateIn]:
        """Joint states that are not whole, oldest first, but for so many that go on waiting."""
        given = []
        while len(self._waiting) > waiting:
            stamp_ns, parts = next(iter(self._waiting.items()))
            del self._waiting[stamp_ns]
            given.append(JointStateIn(stamp_ns, "", tuple(parts), tuple(parts.values())))
        return given

    def _scaled(self, message: JointStateIn, wanted: tuple[str, ...], values: list[float]) -> JointStateIn:
        if not self.readings.neutral:
            n = len(wanted) // 2
            if self._matrices is None or len(self._matrices[1]) != n:
                self._matrices = self.readings.matrices(n)
            A, a, B, b = self._matrices
            row = np.array(values)
            with np.errstate(invalid="ignore", over="ignore"):
                values = [*(A @ row[:n] + a).tolist(), *(B @ row[n:] + b).tolist()]
        return JointStateIn(message.stamp_ns, message.frame_id, wanted, tuple(values))

    # -- names --

    def _plan(self, names: tuple[str, ...], count: int) -> dict[str, int]:
        """Place in the message of every joint that it holds; empty where it holds none."""
        if self.readings.rotation_names:
            return self._declared(names, count)
        found: dict[str, int] = {}
        prefixes: set[str] = set()
        tubes: list[tuple[int, str, int]] = []
        for place, name in enumerate(names):
            match = _CANONICAL.fullmatch(name)
            if match is not None:
                prefixes.add(match["prefix"] or "")
                tubes.append((int(match["tube"]), match["kind"], place))
        if "" in prefixes:  # joints of that very name beside those of another robot
            prefixes = {""}
            tubes = [item for item in tubes if names[item[2]].startswith("tube")]
        if len(prefixes) > 1:
            return {}
        if any(tube == 0 for tube, _, _ in tubes):
            self._from_zero = True
        for tube, kind, place in tubes:
            found.setdefault(f"tube{tube + self._from_zero}_{kind}", place)
        if len(found) < len(tubes):
            return {}
        most = max((tube + self._from_zero for tube, _, _ in tubes), default=0)
        if 0 < self.n < most:
            self.surplus = (
                f"joint states name {most} tubes, the robot has {self.n}: what belongs to tube{self.n + 1} and beyond is left out; "
                "give the robot file of the robot that was recorded"
            )
            self._note(self.surplus)
        for name, place in list(found.items())[:1]:
            if names[place] != name:
                self._note(f"joint '{names[place]}' is taken for {name}, and so on")
        return found

    def _declared(self, names: tuple[str, ...], count: int) -> dict[str, int]:
        given = (*self.readings.rotation_names, *self.readings.translation_names)
        wanted = joint_names(len(given) // 2)
        if names:
            return {name: names.index(g) for name, g in zip(wanted, given, strict=True) if g in names}
        if all(g.isdecimal() for g in given):
            return {name: int(g) for name, g in zip(wanted, given, strict=True) if int(g) < count}
        if count == len(given):
            self._note(f"joints without names are taken in the order {', '.join(given)}")
            return {name: place for place, name in enumerate(wanted)}
        return {}

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)


def joint_names(n: int) -> tuple[str, ...]:
    """``tube1_rotation``.. and then ``tube1_translation``.. of ``n`` tubes."""
    return tuple(f"tube{tube}_{kind}" for kind in ("rotation", "translation") for tube in range(1, n + 1))
