"""How a diagnosis is carried out, apart from what it computes: progress reports, workers and time."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any

from joblib import Parallel, delayed

_here = threading.local()  # whether this thread is one of several at work


def _silent(stage: str) -> None:
    pass


@dataclass(frozen=True)
class RunContext:
    """What travels through every stage.

    Attributes:
        progress: is told of every stage as it begins.
        workers: simulations at once, as threads of this process: the kernels release the interpreter.
        time_budget_s: s after which no further optional part of the search begins; a note of the diagnosis then says so.
        started: reading of `time.perf_counter` at which the time begins to count.
    """

    progress: Callable[[str], None] = _silent
    workers: int = 2
    time_budget_s: float = math.inf
    started: float = field(default_factory=time.perf_counter)

    @property
    def elapsed_s(self) -> float:
        """s since the beginning."""
        return time.perf_counter() - self.started

    @property
    def out_of_time(self) -> bool:
        """Whether the time budget is used up."""
        return self.elapsed_s > self.time_budget_s

    def report(self, stage: str) -> None:
        """Say that ``stage`` begins."""
        self.progress(stage)

    def within(self, stage: str) -> RunContext:
        """The same with ``stage`` before every report."""
        return replace(self, progress=lambda text: self.progress(f"{stage}: {text}"))

    def run(self, jobs: Iterable[Any]) -> list[Any]:
        """Results of ``jobs`` (`joblib.delayed` calls), in their order."""
        return run_jobs(jobs, self.workers)


def run_jobs(jobs: Iterable[Any], workers: int) -> list[Any]:
    """Results of ``jobs`` (`joblib.delayed` calls), in their order, by as many threads as ``workers``; by this one where it is one of several."""
    todo = list(jobs)
    if len(todo) == 1 or count_workers(workers) == 1:
        return [function(*given, **named) for function, given, named in todo]
    return list(Parallel(workers, prefer="threads")(delayed(_at_work)(*job) for job in todo))


def count_workers(workers: int) -> int:
    """``workers``, or 1 where this thread is one of several at work."""
    return 1 if getattr(_here, "at_work", False) else workers


def _at_work(function: Callable[..., Any], given: tuple[Any, ...], named: dict[str, Any]) -> Any:
    _here.at_work = True
    try:
        return function(*given, **named)
    finally:
        _here.at_work = False
