"""Signals whose exception was lost on the way."""

import contextlib
import os
import signal

import pytest

from chargetune.runtime.interrupts import handled_interrupts, raise_lost_interrupt


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
