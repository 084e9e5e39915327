"""Fixtures of the estimator's tests: the shipped bags replayed once a session, and short pieces of them as loose messages."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import pytest
from estimation_cases import Message, Run, bag_messages, replay_bag


@pytest.fixture(scope="session")
def replayed():
    """Replays of shipped bags by name and settings, each made once."""
    runs: dict[tuple, Run] = {}

    def get(name: str, **settings: object) -> Run:
        key = (name, *sorted(settings.items()))
        if key not in runs:
            runs[key] = replay_bag(name, {k.replace("__", "."): v for k, v in settings.items()})
        return runs[key]

    return get


@pytest.fixture(scope="session")
def sweep() -> list[Message]:
    """Messages of the first 1.2 s of a bag in which both tubes move."""
    return bag_messages("clean_sweep", 1.2)


@pytest.fixture(scope="session")
def release() -> list[Message]:
    """Messages of the first 1.5 s of a bag with a load that is cut at 1 s."""
    return bag_messages("clean_release", 1.5)
