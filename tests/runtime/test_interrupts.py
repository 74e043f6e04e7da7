"""Signals whose exception was lost on the way."""

import contextlib
import os
import signal
import subprocess
import sys
import time

import pytest

from chargetune.runtime.interrupts import SAME_S, Watch, handled_interrupts, raise_lost_interrupt, unwatched


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_somebody_swallowed_is_raised_again(number):
    before = signal.getsignal(number)
    with handled_interrupts():
        raise_lost_interrupt()
        with contextlib.suppress(KeyboardInterrupt):
            os.kill(os.getpid(), number)
        with pytest.raises(KeyboardInterrupt):
            raise_lost_interrupt()
    # Afterwards the process is as it was.
    raise_lost_interrupt()
    assert signal.getsignal(number) == before


DEAF = """
import sys, time
from chargetune.runtime.interrupts import Watch, handled_interrupts

def say(text):
    return lambda: print(text, flush=True)

with handled_interrupts(Watch(say("stopping"), say("ended"))):
    said = False
    while True:
        try:
            if not said:
                said = True
                print("ready", flush=True)
            time.sleep(60)
        except KeyboardInterrupt:
            pass
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("times", [1, 2])
def test_a_process_that_does_not_end_is_ended_and_a_second_signal_does_so_at_once(number, times):
    process = subprocess.Popen([sys.executable, "-c", DEAF], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    process.send_signal(number)
    assert process.stdout.readline() == "stopping\n"
    if times == 2:
        # The same signal sent to a process and to its group is one.
        process.send_signal(number)
        time.sleep(SAME_S)
        process.send_signal(number)
    rest, _ = process.communicate(timeout=60)
    assert rest == ("ended\n" if times == 1 else "")
    assert process.returncode == 130


def test_a_server_that_handles_signals_is_not_watched():
    said = []
    with handled_interrupts(Watch(lambda: said.append("stopping"), lambda: said.append("ended"))):
        with unwatched(), pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        assert signal.set_wakeup_fd(-1) != -1
    assert said == []
