"""From a run to a bag: encoder readings, tracker poses with coloured noise, the known load."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ctr_dynamics.io.bag_writer import write_bag
from ctr_dynamics.io.messages.encode import encode_joint_state, encode_pose_stamped, encode_wrench_stamped
from ctr_dynamics.io.messages.topics import JOINT_STATES, TIP_LOAD, TRACKER_TIP
from ctr_dynamics.robot.schema import Robot

from .motion import CUT_S, Motion
from .world import Run, Sensing

START_S = 1_700_000_000
FRAME = "ctr_base"
JOINTS_HZ = 100
TRACKER_HZ = 40
ENCODER_HALF_WIDTH_RAD = math.radians(0.02)
TRACKER_FIRST_S = 0.0125


def _mean_pose(run: Run, t: np.ndarray, window_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Pose at t, averaged over the window before it."""
    if window_s <= 0:
        return run.pose(t)
    nodes, weights = np.polynomial.legendre.leggauss(12)
    poses = [run.pose(t - window_s * 0.5 * (1 - x)) for x in nodes]
    p = sum(0.5 * w * pose[0] for w, pose in zip(weights, poses, strict=True))
    # the chordal mean of rotations a few degrees apart
    total = sum(0.5 * w * pose[1] for w, pose in zip(weights, poses, strict=True))
    return p, Rotation.from_matrix(total).as_matrix()


def readings(run: Run, sensing: Sensing, stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Noise-free tracker readings (n, 3) m and (n, 3, 3) at stamps (n,) s after the start."""
    t = stamps / (1.0 + sensing.skew)
    p, rotation = _registered(*_mean_pose(run, t - sensing.delay_s, sensing.window_s), sensing)
    return p + sensing.drift * t[:, None], rotation


def realised(run: Run, sensing: Sensing, t: np.ndarray) -> np.ndarray:
    """Tip position (n, 3) m at times t (n,) s as the tracker realises it: registration and lever arm in, delay and drift out."""
    return _registered(*run.pose(t), sensing)[0]


def _registered(p: np.ndarray, rotation: np.ndarray, sensing: Sensing) -> tuple[np.ndarray, np.ndarray]:
    registration = Rotation.from_rotvec(sensing.rotation).as_matrix()
    p = sensing.scale * (p + rotation @ sensing.lever)
    return p @ registration.T + sensing.translation, registration @ rotation


def tracker_stamps(motion: Motion) -> np.ndarray:
    """Stamps (n,) of the tracker, s after the start."""
    return np.arange(TRACKER_FIRST_S, motion.duration_s - 1e-9, 1.0 / TRACKER_HZ)


def write(path: Path, run: Run, sensing: Sensing, robot: Robot, rng: np.random.Generator) -> None:
    """Write the bag of one run; the same generator state gives the same bytes."""
    motion, noise = run.motion, robot.tracker.noise
    n = robot.n_tubes
    messages: list[tuple[int, str, bytes]] = []

    def stamp_of(t: float) -> int:
        return START_S * 1_000_000_000 + round(t * 1e9)

    t = np.arange(round(motion.duration_s * JOINTS_HZ)) / JOINTS_HZ
    angles = motion.angles(t) + rng.uniform(-ENCODER_HALF_WIDTH_RAD, ENCODER_HALF_WIDTH_RAD, (len(t), n))
    names = [f"tube{i}_{kind}" for i in range(1, n + 1) for kind in ("rotation", "translation")]
    beta = robot.rest.beta.value
    for x, row in zip(t, angles, strict=True):
        positions = [y for pair in zip(row.tolist(), beta, strict=True) for y in pair]
        messages.append((stamp_of(x), JOINT_STATES, encode_joint_state(stamp_of(x), names, positions)))

    t = tracker_stamps(motion)
    p, rotation = readings(run, sensing, t)
    keep = math.exp(-1.0 / (TRACKER_HZ * noise.drift_time.value))
    wander = noise.drift.value * rng.standard_normal(3)
    p = p + noise.position.value * rng.standard_normal(p.shape)
    for row in p:
        row += wander
        wander = keep * wander + math.sqrt(1 - keep * keep) * noise.drift.value * rng.standard_normal(3)
    turns = Rotation.from_rotvec(noise.rotation.value * rng.standard_normal(p.shape))
    if sensing.glitch is not None:
        p = p + sensing.glitch(rng, t)
    quaternions = (Rotation.from_matrix(rotation) * turns).as_quat()
    for x, position, quaternion in zip(t, p, quaternions, strict=True):
        data = encode_pose_stamped(stamp_of(x), FRAME, position.tolist(), quaternion.tolist())
        messages.append((stamp_of(x), TRACKER_TIP, data))

    if motion.hung_kg:
        slow, fast = np.arange(0.0, motion.duration_s - 1e-9, 0.1), CUT_S + 0.01 * np.arange(-1, 4)
        times = np.unique(np.round(np.concatenate([slow, fast]), 6))
        for x in times[times < motion.duration_s - 1e-9]:
            wrench = float(motion.load_share(x)) * run.wrench
            data = encode_wrench_stamped(stamp_of(x), FRAME, wrench[:3].tolist(), wrench[3:].tolist())
            messages.append((stamp_of(x), TIP_LOAD, data))
    messages.sort(key=lambda m: m[:2])
    with write_bag(path, {"robot": robot.name, "motion": motion.name}) as bag:
        for log_ns, topic, data in messages:
            bag.write(topic, log_ns, data)
