"""From numbers to diagnostics: what the node itself knows (timing, clock, topics), as statuses."""

from __future__ import annotations

from collections.abc import Mapping

from ctr_dynamics.estimation.step_output import ERROR, OK, WARN, Status
from ctr_dynamics.runtime.clock_offset import LIMIT_NS, ClockOffset
from ctr_dynamics.runtime.step_loop import INBOX_BYTES, INBOX_LIMIT
from ctr_dynamics.runtime.timing import LATE_NS, VERY_LATE_NS, StepTiming

LATE_SHARE = 0.001  # of the steps may be late


def timing_status(timing: StepTiming, faults: int, last_fault: str, withheld_behind_ns: int = 0) -> Status:
    """Punctuality of the last steps: WARN when late or skipped, ERROR when stamps went back, and after a fault, which is for good: a defect."""
    report = timing.report()

    def spread(name: str) -> str:
        return " / ".join(f"{report[name][part]:.2f}" for part in ("p50", "p99", "max"))

    values = {
        "policy": timing.policy,
        "steps": str(timing.totals.steps),
        "later than 3 ms": str(timing.totals.late),
        "later than 20 ms": str(timing.totals.very_late),
        "skipped": str(timing.totals.skipped),
        "withheld": str(timing.withheld),
        "too old": str(timing.too_old),
        "restarts": str(timing.restarts),
        "lateness p50 / p99 / max (ms)": spread("lateness_ms"),
        "step p50 / p99 / max (ms)": spread("step_ms"),
        "correction p50 / p99 / max (ms)": spread("correction_ms"),
    }
    if withheld_behind_ns > LIMIT_NS:
        return Status(
            "timing",
            ERROR,
            f"nothing is published: steps are {withheld_behind_ns * 1e-9:.3f} s before the last published "
            f"stamp, limit {LIMIT_NS * 1e-9:g} s; mend the clock that stamps the joints or call ~/reset",
            values,
        )
    if faults:
        return Status(
            "timing",
            ERROR,
            f"{faults} faults inside the node, see the log; the last: {last_fault}",
            values,
        )
    recent = timing.recent
    if recent.skipped:
        message = f"{recent.skipped} steps were skipped among the last {recent.steps}, none should be"
        return Status("timing", WARN, message, values)
    if recent.very_late or recent.late > LATE_SHARE * max(recent.steps, 1000):
        return Status(
            "timing",
            WARN,
            f"{recent.late} of the last {recent.steps} steps were published later than {LATE_NS * 1e-6:g} ms, "
            f"{recent.very_late} later than {VERY_LATE_NS * 1e-6:g} ms; limits {100.0 * LATE_SHARE:g} % and 0",
            values,
        )
    return Status(
        "timing", OK, f"{timing.totals.steps} steps, the last {recent.steps} of them on time", values
    )


def clock_status(clock: ClockOffset, now_ns: int, use_sim_time: bool, limit_ns: int | None) -> Status:
    """Whether the stamps of the joints and the node's clock are of one time; ``limit_ns``: age at arrival beyond which steps lack joints, if any."""
    age_s = clock.age_ns * 1e-9
    values = {
        "offset (s)": f"{clock.offset_ns * 1e-9:.4f}",
        "age at arrival (s)": f"{age_s:.4f}",
        "use_sim_time": str(use_sim_time),
    }
    if now_ns <= 0:
        return Status(
            "clock", WARN, "use_sim_time is set, no /clock has come; steps follow the joints", values
        )
    if not clock.agrees:
        side = "behind" if clock.offset_ns > 0 else "ahead of"
        return Status(
            "clock",
            WARN,
            f"joint stamps are {abs(clock.offset_ns) * 1e-9:.3f} s {side} the node's clock, limit "
            f"{clock.limit_ns * 1e-9:g} s: steps go by the stamps; synchronise clocks or set use_sim_time",
            values,
        )
    if limit_ns is not None and clock.age_ns > limit_ns:
        return Status(
            "clock",
            WARN,
            f"joint stamps are {age_s:.3f} s behind the node's clock at arrival, limit {limit_ns * 1e-9:g} s: synchronise clocks, "
            "or raise input_timeout_s",
            values,
        )
    return Status("clock", OK, "joint stamps and the node's clock agree", values)


def topics_status(
    qos_faults: Mapping[str, str], undecodable: Mapping[str, tuple[int, str]], rejected: int = 0
) -> Status:
    """Topics whose endpoints do not fit, messages that could not be decoded, and those for which there was no room."""
    values = {
        **qos_faults,
        **{topic: f"{count} undecodable, {why}" for topic, (count, why) in undecodable.items()},
    }
    if qos_faults:
        return Status("topics", ERROR, "; ".join(qos_faults.values()), values)
    if rejected:
        values["rejected"] = str(rejected)
        return Status(
            "topics",
            ERROR,
            f"{rejected} messages were rejected: {INBOX_LIMIT} of them or {INBOX_BYTES / 2**20:g} MB were waiting already; "
            "send fewer, or give the node more of a core",
            values,
        )
    if undecodable:
        topic, (count, why) = next(iter(undecodable.items()))
        return Status(
            "topics", WARN, f"{count} messages on {topic} could not be decoded, the last: {why}", values
        )
    return Status("topics", OK, "all endpoints fit", values)
