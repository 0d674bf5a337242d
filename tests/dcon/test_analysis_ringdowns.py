"""Ringdowns: found where a known swing begins, fitted to what it is, and left alone where nothing is free."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dcon.analysis.disturbances import disturbances
from dcon.analysis.ringdowns import AFTER_S, FORCED_S, SETTLE_S, Loop, compare, ringdowns

RATE = 60.0
Floats = npt.NDArray[np.float64]


@dataclass
class Swing:
    """A swing that begins at ``at_s`` out of noise."""

    at_s: float = 10.0
    frequency_hz: float = 0.43
    damping: float = 0.09
    mhz: float = 20.0
    noise_mhz: float = 0.0
    seconds: float = 40.0

    def signal(self, seed: int = 1) -> Floats:
        t = np.arange(round(self.seconds * RATE)) / RATE - self.at_s
        w = 2 * math.pi * self.frequency_hz
        decay = self.damping * w / math.sqrt(1 - self.damping**2)
        swing = np.where(t > 0, self.mhz * np.exp(-decay * np.maximum(t, 0)) * np.sin(w * t), 0.0)
        return swing + self.noise_mhz * np.random.default_rng(seed).normal(size=len(t))


def loop(delta: Floats, **given_: Floats | npt.NDArray[np.int64]) -> Loop:
    nothing = np.zeros_like(delta)
    tick_ns = 10**18 + np.round(np.arange(len(delta)) * 1e9 / RATE).astype(np.int64)
    made = {
        "tick_ns": tick_ns,
        "command_mw": nothing,
        "output_v": nothing,
        "probe_mw": nothing,
        "gain_mw_per_mhz": nothing,
        "situation": nothing.astype(np.int64),
    } | given_
    return Loop(delta_f_mhz=delta, rate_hz=RATE, limit_mw=125.0, **made)  # type: ignore[arg-type]


def seconds(loop_: Loop, time_ns: int) -> float:
    return (time_ns - int(loop_.tick_ns[0])) / 1e9


@settings(max_examples=20, deadline=None)
@given(st.floats(0.25, 0.8), st.floats(0.03, 0.15), st.floats(12, 20))
def test_a_known_mode_is_found_and_fitted(frequency_hz: float, damping: float, at_s: float) -> None:
    given_ = loop(Swing(at_s, frequency_hz, damping, noise_mhz=0.02).signal())
    (found,) = ringdowns(given_)
    assert at_s < seconds(given_, found.disturbed_ns) < at_s + 0.5
    assert found.mode is not None and not found.closed
    assert found.mode.frequency_hz.median == pytest.approx(frequency_hz, abs=0.002)
    assert found.mode.damping_percent.median == pytest.approx(100 * damping, abs=0.5)
    assert found.mode.damping_percent.low <= found.mode.damping_percent.median <= found.mode.damping_percent.high


def test_more_noise_is_more_spread() -> None:
    def width(noise_mhz: float) -> float:
        (found,) = ringdowns(loop(Swing(noise_mhz=noise_mhz).signal()))
        assert found.mode is not None
        return found.mode.damping_percent.high - found.mode.damping_percent.low

    assert 0 <= width(0.001) < width(0.1) < width(0.5)


@pytest.mark.parametrize("seed", range(4))
def test_noise_alone_is_no_disturbance(seed: int) -> None:
    noise = np.random.default_rng(seed).normal(size=6000)
    slow = np.convolve(noise, np.ones(60) / 8, mode="same")
    assert disturbances(5 * noise, RATE).rows == disturbances(5 * slow, RATE).rows == []
    assert disturbances(5 * noise, RATE).noise_mhz == pytest.approx(5 * math.sqrt(2), rel=0.1)


@pytest.mark.parametrize("noise_mhz", [0.0, 0.3])
@pytest.mark.parametrize("seconds_", [15.0, 20.0, 60.0, 300.0])
@pytest.mark.parametrize("percent", [-1.0, 0.0, 0.5, 5.0, 12.0])
def test_a_swing_is_no_noise_however_long_it_lasts(percent: float, seconds_: float, noise_mhz: float) -> None:
    """Also where it fills the session from its begin to its end."""
    swing = Swing(5, 0.37, percent / 100, 12.0, noise_mhz, seconds_).signal(3)
    (found,) = ringdowns(loop(swing))
    assert found.mode is not None
    assert found.mode.frequency_hz.median == pytest.approx(0.37, abs=0.002)
    assert found.mode.damping_percent.median == pytest.approx(percent, abs=0.6 if noise_mhz else 0.01)
    assert disturbances(swing, RATE).noise_mhz == pytest.approx(noise_mhz * math.sqrt(2), rel=0.15, abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_a_swing_that_random_load_keeps_up_has_no_begin(seed: int) -> None:
    """Narrow-band noise: the grid's own mode, lightly damped, driven by white noise."""
    random = np.random.default_rng(seed).normal(size=600 * 60)
    t = np.arange(60 * 60) / RATE
    w = 2 * math.pi * 0.4
    answer = np.exp(-0.04 * w * t) * np.sin(w * t)
    swing = np.fft.irfft(np.fft.rfft(random) * np.fft.rfft(answer, len(random)))
    assert disturbances(3 * swing / swing.std(), RATE).rows == []


def test_a_swing_that_is_there_when_data_come_back_did_not_begin_then() -> None:
    delta = Swing(at_s=1.0, damping=0.001).signal()
    assert disturbances(delta, RATE).rows == []  # too early to know
    delta[: 12 * 60] = np.nan
    assert disturbances(delta, RATE).rows == []


def test_a_second_disturbance_ends_the_first_swing() -> None:
    delta = Swing(10).signal() + Swing(22).signal()
    given_ = loop(delta)
    first, second = ringdowns(given_)
    assert seconds(given_, second.disturbed_ns) == pytest.approx(22, abs=0.5)
    assert first.length_s == pytest.approx(12 - SETTLE_S, abs=0.5)


@pytest.mark.parametrize("noise_mhz", [0.0, 0.02])
@pytest.mark.parametrize("later_s", [2.5, 3.0, 4.0, 5.0, 5.9])
def test_a_large_disturbance_soon_after_a_small_one_is_found(later_s: float, noise_mhz: float) -> None:
    """The fit of neither runs across the second."""
    delta = Swing(10, 0.43, 0.078, 2.5, noise_mhz).signal() + Swing(10 + later_s, 0.43, 0.078, 30.0).signal()
    given_ = loop(delta)
    first, second = ringdowns(given_)
    assert seconds(given_, first.disturbed_ns) == pytest.approx(10, abs=0.5)
    assert seconds(given_, second.disturbed_ns) == pytest.approx(10 + later_s, abs=0.3)
    assert first.mode is None and "s are needed" in first.why
    assert second.mode is not None
    assert second.mode.damping_percent.median == pytest.approx(7.8, abs=0.2)


def test_one_that_grows_at_once_is_fitted_from_its_growth() -> None:
    given_ = loop(Swing(10, 0.43, 0.078, 2.5).signal() + Swing(11.5, 0.43, 0.078, 30.0).signal())
    (found,) = ringdowns(given_)
    assert seconds(given_, found.disturbed_ns) == pytest.approx(11.5, abs=0.3)
    assert found.mode is not None


@pytest.mark.parametrize("frequency_hz", [0.2, 0.43, 0.8])
@pytest.mark.parametrize("other_hz", [0.15, 0.6, 1.1])
def test_a_swing_of_two_modes_is_one_disturbance(frequency_hz: float, other_hz: float) -> None:
    delta = Swing(10, frequency_hz, 0.03).signal() + Swing(10, other_hz, 0.05, -15.0).signal()
    assert len(ringdowns(loop(delta))) == 1


def test_the_answer_to_a_probing_signal_is_no_disturbance_beside_it() -> None:
    delta = Swing(10.4).signal()
    probe = np.where((np.arange(len(delta)) >= 10 * RATE) & (np.arange(len(delta)) < 15 * RATE), 20.0, 0.0)
    assert len(ringdowns(loop(delta, probe_mw=probe))) == 1


def test_the_fit_begins_after_saturation_and_only_of_what_is_driven() -> None:
    delta = Swing(10).signal()
    command = np.where(np.arange(len(delta)) < 15 * 60, np.clip(12 * delta, -125, 125), 0.0)
    command[13 * 60] = 125.0
    driven = loop(delta, command_mw=command, output_v=command / 12.5, gain_mw_per_mhz=np.full_like(delta, 12.0))
    (found,) = ringdowns(driven)
    last = np.flatnonzero(np.abs(command) >= 0.98 * 125)[-1] / RATE
    assert seconds(driven, found.begin_ns) == pytest.approx(last + AFTER_S, abs=2 / RATE)
    assert found.saturated_s > 0
    (open_,) = ringdowns(loop(delta, command_mw=command))
    assert open_.saturated_s == 0 and open_.begin_ns < found.begin_ns


def test_the_fit_begins_after_the_probing_signal() -> None:
    delta = Swing(10).signal()
    probe = np.zeros_like(delta)
    probe[round(10 * RATE) : round(15 * RATE)] = 20.0
    given_ = loop(delta, probe_mw=probe)
    (found,) = ringdowns(given_)
    assert seconds(given_, found.begin_ns) == pytest.approx(15 + FORCED_S, abs=2 / RATE)
    probe[round(10 * RATE) :] = 20.0
    (forced,) = ringdowns(loop(delta, probe_mw=probe))
    assert forced.mode is None and forced.why


@pytest.mark.parametrize("closed", [True, False])
def test_a_loop_that_is_probed_to_the_end_is_as_it_was(closed: bool) -> None:
    delta = Swing(10).signal()
    probe = np.where(np.arange(len(delta)) >= 10 * RATE, 20.0, 0.0)
    (found,) = ringdowns(
        loop(
            delta,
            probe_mw=probe,
            output_v=(probe + (9 * delta if closed else 0)) / 12.5,
            gain_mw_per_mhz=np.full_like(delta, 9.0),
            situation=np.full(len(delta), int(closed)),
        )
    )
    assert found.mode is None and found.length_s == 0
    assert (found.closed, found.gain_mw_per_mhz) == ((True, 9.0) if closed else (False, 0.0))


@pytest.mark.parametrize("what", ["gain_mw_per_mhz", "situation"])
def test_a_change_of_the_loop_ends_the_window(what: str) -> None:
    delta = Swing(10).signal()
    changed = np.zeros(len(delta), np.int64 if what == "situation" else np.float64)
    changed[17 * 60 :] = 1
    (found,) = ringdowns(loop(delta, **{what: changed}))
    assert found.mode is None and "s are needed" in found.why
    changed[:] = 0
    changed[24 * 60 :] = 1
    (found,) = ringdowns(loop(delta, **{what: changed}))
    assert found.mode is not None and found.length_s < 12.1


def test_missing_ticks_and_missing_values_end_the_window() -> None:
    delta = Swing(10).signal()
    given_ = loop(delta)
    (broken,) = ringdowns(given_, breaks=[16 * 60])
    assert broken.mode is None
    delta[16 * 60] = np.nan
    (unknown,) = ringdowns(loop(delta))
    assert unknown.mode is None


def test_open_against_closed() -> None:
    delta = Swing(10, damping=0.07).signal()
    wide = np.full_like(delta, 9.0)
    opened = ringdowns(loop(delta))
    closed = ringdowns(loop(Swing(10, damping=0.1).signal(), output_v=np.ones_like(delta), gain_mw_per_mhz=wide))
    rows = compare([*closed, *opened, *opened])
    assert [(row.closed, row.gain_mw_per_mhz, row.ringdowns) for row in rows] == [(False, 0, 2), (True, 9, 1)]
    assert rows[0].gained_percent is None
    assert rows[1].gained_percent == pytest.approx(3.0, abs=0.05)
    assert compare(closed)[0].gained_percent is None


def test_nothing_known_is_nothing_found() -> None:
    assert ringdowns(loop(np.full(600, np.nan))) == [] == ringdowns(loop(np.zeros(0)))
