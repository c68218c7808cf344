"""Signals as requests."""

from __future__ import annotations

import signal

import pytest

from crptpro.training.stop_request import StopRequest


def test_a_signal_asks_and_a_second_one_insists() -> None:
    before = signal.getsignal(signal.SIGINT)
    with StopRequest() as stop:
        assert stop.signal is None
        signal.raise_signal(signal.SIGINT)
        assert stop.signal == signal.SIGINT
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_sigterm_leaves_with_its_exit_status() -> None:
    with StopRequest() as stop:
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(SystemExit) as left:
            stop.leave()
    assert left.value.code == 143
