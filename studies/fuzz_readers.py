"""Damaged files for every reader: bags, robot files, parameter files, scenarios, CSV logs, layouts, pose tables, messages.

    python -m studies.fuzz_readers --files 10000 --output fuzz.json

A reader may take a damaged file or reject it with one line (InputError, or CdrError for a message); anything else, more than `LIMIT_S` for one
file, or more memory than `MEMORY_BYTES` is a failure. Files are read in child processes, so that a crash of the interpreter is counted too. A seed
and a number name a file; `--only N` reads that one again and shows the traceback. Exit code 1 when anything failed.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from ctr_dynamics.csv_import.column_layout import Layout, read_layout
from ctr_dynamics.csv_import.convert import read_log
from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_info import inspect
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.messages import cdr, topics
from ctr_dynamics.io.messages.schemas import schema
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.pose_table import read_poses
from ctr_dynamics.parameters import read_parameter_file
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.simulation import load_scenario

LIMIT_S = 20.0
MEMORY_BYTES = (
    2 * 2**30
)  # of address space beyond what the interpreter has: twice the largest chunk that is read, and its copy
BATCH = 500
ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path(str(resources.files("ctr_dynamics")))
CSV = "time [s],tube1_rotation [deg],tube1_translation [mm],x [mm],y [mm],z [mm],qx,qy,qz,qw\n" + "".join(
    f"{0.01 * k:.3f},{k},-{20 + k},1.5,2.5,{100 + k},0,0,0.6,0.8\n" for k in range(30)
)
LAYOUT = """joints:
  time: {column: when, unit: s, start_s: 1000}
  values:
    tube1_rotation: {column: m1, unit: deg, scale: -1, offset: 90}
tracker:
  time: {column: when, unit: ms}
  frame: camera
  registration_rotation_rad: [0.0, 0.1, 0.2]
  registration_translation_m: [1, 2, 3]
  values:
    x: {column: Tx, unit: mm}
"""
POSES = "beta1,beta2,alpha1,alpha2,Fx,Fy,Fz\n-0.25,-0.19,1.5,1.5,0,0,0\n-0.2,-0.15,0,0.5,0,-0.1,0\n"


def plain_bag(compression: CompressionType, chunked: bool) -> bytes:
    """The first 0.3 s of the shipped bag without checksums, so that damage reaches the records."""
    stream = io.BytesIO()
    writer = Writer(stream, compression=compression, use_chunking=chunked, enable_crcs=False, chunk_size=4096)
    writer.start(profile="ros2", library="fuzz")
    channels: dict[str, int] = {}
    bag = open_bag(PACKAGE / "data" / "bags" / "clean_release.mcap")
    first = None
    for message in bag.messages():
        first = message.log_ns if first is None else first
        if message.log_ns - first > 300_000_000:
            break
        if message.topic not in channels:
            ros_type = topics.TOPIC[message.topic].ros_type
            number = writer.register_schema(ros_type, "ros2msg", schema(ros_type).text.encode())
            channels[message.topic] = writer.register_channel(message.topic, "cdr", number)
        writer.add_message(channels[message.topic], message.log_ns, message.data, message.log_ns)
    writer.finish()
    return stream.getvalue()


def read_bag(path: Path) -> None:
    """Everything that is done with a bag."""
    bag = open_bag(path)
    for _ in bag.inputs():
        pass
    for _ in bag.messages():
        pass
    str(bag.notes)
    inspect(path).to_dict()


def read_csv(path: Path) -> None:
    for kind in ("joints", "tracker"):
        read_log(kind, path, Layout(), "ctr_base")


def decode(path: Path) -> None:
    """A message by every decoder: a topic may carry another type than it says."""
    data = path.read_bytes()
    for decoder in (
        cdr.decode_joint_state, cdr.decode_pose_stamped, cdr.decode_wrench_stamped, cdr.decode_point_cloud, cdr.decode_header,
    ):  # fmt: skip
        with contextlib.suppress(cdr.CdrError):
            decoder(data)


def seeds() -> dict[str, tuple[list[bytes], str, Callable[[Path], Any]]]:
    """Reader -> (whole files, suffix, what reads them)."""
    model = Model(load_robot("till2020_tissue"), nodes=24)
    shipped = PACKAGE / "data" / "bags" / "clean_release.mcap"
    bags = [shipped.read_bytes()] + [
        plain_bag(compression, chunked)
        for compression, chunked in (
            (CompressionType.NONE, False), (CompressionType.NONE, True), (CompressionType.LZ4, True), (CompressionType.ZSTD, True),
        )
    ]  # fmt: skip
    messages = list({m.topic: m.data for m in open_bag(shipped).messages()}.values())
    config = PACKAGE / "config"
    return {
        "bag": (bags, ".mcap", read_bag),
        "message": (messages, ".cdr", decode),
        "robot": ([p.read_bytes() for p in sorted((config / "robots").glob("*.yaml"))], ".yaml", load_robot),
        "parameters": ([(config / "estimator.yaml").read_bytes()], ".yaml", read_parameter_file),
        "scenario": (
            [p.read_bytes() for p in sorted((config / "scenarios").glob("*.yaml"))],
            ".yaml",
            load_scenario,
        ),
        "log": ([CSV.encode(), CSV.replace(",", ";").encode()], ".csv", read_csv),
        "layout": ([LAYOUT.encode()], ".yaml", read_layout),
        "poses": ([POSES.encode()], ".csv", lambda path: read_poses(path, model)),
    }


SHARE = {
    "bag": 8,
    "message": 3,
    "robot": 4,
    "parameters": 1,
    "scenario": 1,
    "log": 3,
    "layout": 1,
    "poses": 1,
}
WORDS = (
    b"nan", b"1e999", b"-1", b"99999999999999999999", b"!!python/object/apply:os.system [echo]", b"&a [*a, *a]", b"{", b"\xff\xfe", b"\x00",
    b"\n", b"'", b"null", b"- - - - - -", b"0x7fffffff", b"true", b",,,,", b"\xc3\x28", b"*unknown", b"<<: *a", b"1e400",
)  # fmt: skip


def damaged(data: bytes, dice: random.Random) -> bytes:
    """One to eight faults: bits, numbers, cuts, repeats, foreign words."""
    result = bytearray(data)
    for _ in range(dice.choice((1, 1, 1, 2, 4, 8))):
        place = dice.randrange(len(result) + 1)
        kind = dice.randrange(8)
        if kind == 0 and place < len(result):
            result[place] ^= 1 << dice.randrange(8)
        elif kind == 1 and place < len(result):
            result[place] = dice.choice((0, 1, 0x7F, 0x80, 0xFF, dice.randrange(256)))
        elif kind == 2:
            size = dice.choice((4, 8))
            value = dice.choice((0, 1, 2**31 - 1, 2**32 - 1, 2**63 - 1, dice.randrange(2**32), len(data)))
            result[place : place + size] = (value % 2 ** (8 * size)).to_bytes(size, "little")
        elif kind == 3:
            del result[place:]
        elif kind == 4:
            del result[place : place + dice.randrange(1, 64)]
        elif kind == 5:
            end = place + dice.randrange(1, 512)
            result[place:place] = result[place:end] * dice.randrange(1, 4)
        elif kind == 6:
            result[place : place + dice.choice((0, 1, 4))] = dice.choice(WORDS)
        else:
            result[place : place + dice.randrange(1, 64)] = dice.randbytes(dice.randrange(1, 64))
    return bytes(result)


class TookTooLong(BaseException):
    """Raised by the alarm; no reader may catch it."""


def _alarm(number: int, frame: Any) -> None:
    raise TookTooLong


def read_one(number: int, seed: int, kinds: dict, folder: Path) -> tuple[str, str, str]:
    """Kind, outcome (taken, rejected, failed, too long, memory) and what was said of one file."""
    dice = random.Random(f"{seed}/{number}")
    kind = dice.choices(list(SHARE), list(SHARE.values()))[0]
    files, suffix, reader = kinds[kind]
    path = folder / f"file{suffix}"
    path.write_bytes(damaged(dice.choice(files), dice))
    signal.setitimer(signal.ITIMER_REAL, LIMIT_S)
    try:
        reader(path)
        return kind, "taken", ""
    except InputError as error:
        text = str(error)
        return kind, ("rejected" if "\n" not in text and len(text) < 4000 else "failed"), text
    except TookTooLong:
        return kind, "too long", ""
    except MemoryError:
        return kind, "memory", traceback.format_exc(limit=-3)
    except Exception:
        return kind, "failed", traceback.format_exc(limit=-4)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def work(first: int, count: int, seed: int) -> None:
    """In a child process: read files and tell each outcome on a line of standard output."""
    kinds = seeds()
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES, used + MEMORY_BYTES))
    signal.signal(signal.SIGALRM, _alarm)
    with tempfile.TemporaryDirectory() as name:
        for number in range(first, first + count):
            begin = time.perf_counter()
            kind, outcome, text = read_one(number, seed, kinds, Path(name))
            line = {
                "number": number,
                "kind": kind,
                "outcome": outcome,
                "seconds": round(time.perf_counter() - begin, 4),
            }
            if outcome not in ("taken", "rejected"):
                line["text"] = text
            line["peak_bytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
            print(json.dumps(line), flush=True)


def fuzz(files: int, seed: int) -> dict[str, Any]:
    """Read `files` damaged files; returns counts by kind and outcome, the worst time and memory, and every failure."""
    counts: dict[str, Counter[str]] = {}
    failures: list[dict[str, Any]] = []
    slowest = peak = 0.0
    number = 0
    while number < files:
        count = min(BATCH, files - number)
        command = [
            sys.executable,
            "-m",
            "studies.fuzz_readers",
            "--worker",
            str(number),
            str(count),
            "--seed",
            str(seed),
        ]
        child = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        done = 0
        for text in child.stdout.splitlines():
            line = json.loads(text)
            done += 1
            counts.setdefault(line["kind"], Counter())[line["outcome"]] += 1
            slowest, peak = max(slowest, line["seconds"]), max(peak, line["peak_bytes"])
            if "text" in line:
                failures.append(line)
        if done < count:  # the interpreter itself has ended
            counts.setdefault("any", Counter())["crash"] += 1
            failures.append(
                {
                    "number": number + done,
                    "outcome": "crash",
                    "text": child.stderr[-2000:],
                    "code": child.returncode,
                }
            )
            done += 1
        number += done
    return {
        "files": files,
        "seed": seed,
        "counts": {kind: dict(found) for kind, found in sorted(counts.items())},
        "failures": failures,
        "slowest_s": slowest,
        "peak_bytes": peak,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--files", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path, help="JSON file for the counts")
    parser.add_argument("--only", type=int, help="read this file alone and show what happens")
    parser.add_argument("--worker", type=int, nargs=2, metavar=("FIRST", "COUNT"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        work(*options.worker, options.seed)
        return 0
    if options.only is not None:
        signal.signal(signal.SIGALRM, _alarm)
        with tempfile.TemporaryDirectory() as name:
            print(*read_one(options.only, options.seed, seeds(), Path(name)), sep="\n")
        return 0
    figures = fuzz(options.files, options.seed)
    text = json.dumps(figures, indent=1)
    print(text)
    if options.output:
        options.output.write_text(text, encoding="utf-8")
    return 1 if figures["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
