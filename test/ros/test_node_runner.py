"""Long work before a node serves, and the signals that come meanwhile."""

import os
import signal
import threading

import pytest

from ctr_dynamics.ros.node_runner import Stopped, run_in_thread, stop_on_signals


def test_work_apart_gives_its_result():
    with stop_on_signals() as stop:
        assert run_in_thread(lambda: threading.current_thread() is threading.main_thread(), stop) is False


@pytest.mark.parametrize("error", [ValueError("bag"), TimeoutError("disk")])
def test_work_apart_raises_what_it_raised(error):
    with stop_on_signals() as stop, pytest.raises(type(error), match=str(error)):
        run_in_thread(lambda: (_ for _ in ()).throw(error), stop)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_wait_and_not_the_work(number):
    go_on, finished = threading.Event(), threading.Event()

    def work():
        os.kill(os.getpid(), number)
        assert go_on.wait(60)
        finished.set()

    with stop_on_signals() as stop:
        with pytest.raises(Stopped):
            run_in_thread(work, stop)
        assert not finished.is_set()
        go_on.set()
        assert finished.wait(60)
