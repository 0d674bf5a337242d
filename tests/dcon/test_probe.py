"""Probing signals: their shapes, and how they run beside the feedback without a step."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from support.rig import Rig, Signal, constant, steady

from dcon.core.command import Command, form
from dcon.core.params import Params
from dcon.core.probe import IDLE, Probe, Probing, Waveform, advance, started, tones_hz, waveform
from dcon.core.state import initial_state
from dcon.core.values import Event, Mode, Order, Surroundings, SystemState
from dcon.limiter import SLEW_MW_PER_S
from pmutools.errors import SettingsError


def test_a_square_pulse() -> None:
    signal = waveform(Probing("square", 125.0, 0.4, 3), 60)
    assert signal.ticks == len(signal.samples) == 450 and not signal.ramped
    halves = [signal.samples[k * 75 : (k + 1) * 75] for k in range(6)]
    assert halves == [(125.0,) * 75, (-125.0,) * 75] * 3
    assert (signal.at(-1), signal.at(450)) == (0.0, 0.0)


def test_a_multisine() -> None:
    """Equal tones on whole periods, as far apart as octaves allow, crest far below that of aligned phases."""
    probing = Probing("multisine", 50.0)
    signal = waveform(probing, 60)
    assert len(signal.samples) == 2400 and signal.ticks == 72_000
    values = np.array(signal.samples)
    assert np.max(np.abs(values)) == pytest.approx(50.0)
    spectrum = np.abs(np.fft.rfft(values)) / 1200
    lines = [round(hz * 40) for hz in tones_hz(probing)]
    assert lines == sorted(set(lines)) and lines[0] == 4 and lines[-1] == 200 and len(lines) >= 20
    assert np.allclose(spectrum[lines], spectrum[lines[0]]) and np.max(np.delete(spectrum, lines)) < 1e-9
    crest = 50.0 / np.sqrt(np.mean(values**2))
    assert crest < 3.0 < math.sqrt(2 * len(lines))
    assert signal.at(2400 + 17) == signal.samples[17]
    assert waveform(probing, 60) == signal != waveform(Probing("multisine", 50.0, seed=2), 60)


def test_a_chirp() -> None:
    signal = waveform(Probing("chirp", 30.0, low_hz=0.1, high_hz=5.0, duration_s=60.0), 60)
    values = np.array(signal.samples)
    assert len(values) == signal.ticks == 3600 and np.max(np.abs(values)) <= 30.0
    ups = np.flatnonzero((values[:-1] < 0) & (values[1:] >= 0)) / 60
    middles = (ups[:-1] + ups[1:]) / 2
    assert np.allclose(1 / np.diff(ups), 0.1 * 50 ** (middles / 60), rtol=0.1)  # octave by octave


def test_what_cannot_be() -> None:
    with pytest.raises(SettingsError, match="kind = 'sine': must be one of"):
        Probing("sine")
    with pytest.raises(SettingsError, match=r"x.csv: every value must be within ±125 MW"):
        Probing("file", samples=(126.0,), file="x.csv")
    with pytest.raises(SettingsError, match="high_hz = 10: must be below half of 20 ticks/s"):
        Params.paired(("N",), ("S",), tick_hz=20, probing=Probing("chirp", high_hz=10))


def course(signal: Waveform, ramp_s: float = 1.0, stop: int | None = None, ticks: int = 400) -> list[float]:
    probe = started(signal)
    out = []
    for k in range(ticks):
        probe = advance(probe._replace(stopping=probe.stopping or k == stop), signal, ramp_s, 500.0, 60)
        out.append(probe.mw)
        if probe == IDLE:
            return out
    raise AssertionError("it does not end")


@pytest.mark.parametrize("stop", [None, 0, 1, 37, 75, 149])
def test_no_signal_moves_faster_than_its_slew(stop: int | None) -> None:
    for signal in (
        waveform(Probing("square", 125.0, 0.4, 1), 60),
        waveform(Probing("chirp", 125.0, low_hz=1, high_hz=9, duration_s=2.5), 60),
        Waveform((125.0, -125.0) * 75, 150),
    ):
        values = [0.0, *course(signal, stop=stop)]
        assert max(abs(b - a) for a, b in pairwise(values)) <= 500 / 60 + 1e-9
        assert values[-1] == 0.0
        if stop is not None:
            assert len(values) <= stop + 80


def test_ramps_in_and_out() -> None:
    flat = Waveform((10.0,), 300, ramped=True)
    values = course(flat)
    assert values[29] == pytest.approx(5.0) and values[59:240] == [pytest.approx(10.0)] * 181
    assert values[269] == pytest.approx(5.0, abs=0.4) and len(values) <= 302
    assert advance(IDLE, flat, 1.0, 500.0, 60) is IDLE and not Probe().is_on


# --- beside the feedback -----------------------------------------------------------------------------------------

SQUARE = "[probing]\nkind = square\namplitude_mw = 100\nfrequency_hz = 1\ncycles = 2\n"
BIASED = {name: Signal(hz=constant(0.0025 if name[0] == "N" else -0.0025)) for name in ("N1", "N2", "S1", "S2")}


def probed(extra: str = SQUARE, *orders: Order, signals: dict[str, Signal] = BIASED) -> Rig:
    rig = Rig(signals, extra=extra)
    rig.run(12)
    for order in orders:
        rig.tick(order)
    rig.tick(Order("arm"))
    rig.tick(Order("activate"))
    return rig.run(70)


def test_it_is_added_to_the_command_clipped_with_it_and_logged_apart() -> None:
    """45 MW of feedback, ±100 MW of signal: the sum is clipped to 125, and the command goes on as it would."""
    rig, quiet = probed(), probed()
    rig.tick(Order("probe_start", who="Ada"))
    assert Event("probe_start", "system", "square by Ada") in rig.records[-1].events
    rig.run(150)
    quiet.run(151)
    assert [r.command_mw for r in rig.records] == [r.command_mw for r in quiet.records]
    volts = [record.output_v * 12.5 for record in rig.records]
    assert max(volts) == 125.0 and min(volts) == pytest.approx(45 - 100, abs=1e-3)
    assert [v - r.command_mw for v, r in zip(volts, rig.records, strict=True)] == pytest.approx(
        [record.probe_mw for record in rig.records]
    )
    assert max(abs(b - a) for a, b in pairwise(volts)) <= SLEW_MW_PER_S / 60 + 1e-9
    ends = [k for k, record in enumerate(rig.records) if Event("probe_end", "system") in record.events]
    assert len(ends) == 1 and rig.records[ends[0]].probe_mw == 0.0 and rig.records[ends[0] - 1].probe_mw != 0.0


def test_open_loop_drives_no_signal_unless_it_is_set_to() -> None:
    for extra, driven in ((SQUARE, False), (f"{SQUARE}open_loop = yes\n", True)):
        rig = probed(extra, Order("open_loop"))
        rig.tick(Order("probe_start"))
        rig.run(60)
        assert max(record.probe_mw for record in rig.records) == pytest.approx(100.0 if driven else 80.0, abs=1e-2)
        assert max(record.output_v for record in rig.records) == (pytest.approx(8.0) if driven else 0.0)
        assert rig.records[-1].command_mw == pytest.approx(45.0, abs=1e-3)


@pytest.mark.parametrize("how", ["probe_stop", "disarm", "estop", "gps"])
def test_how_it_ends(how: str) -> None:
    rig = probed()
    rig.tick(Order("probe_start"))
    rig.run(27)
    assert rig.records[-1].output_v == 10.0
    told = Surroundings(gps_age_s=9.0 if how == "gps" else None)
    rig.tick(*(() if how == "gps" else (Order(how),)), told=told)
    if how == "estop":
        assert rig.records[-1].output_v == 0.0 == rig.records[-1].probe_mw
        return
    rig.run(70)
    volts = [record.output_v * 12.5 for record in rig.records]
    assert max(abs(b - a) for a, b in pairwise(volts)) <= SLEW_MW_PER_S / 60 + 1e-9
    assert rig.records[-1].probe_mw == 0.0 and not rig.engine.state.probe.is_on
    assert rig.records[-1].state == ("ACTIVE" if how == "probe_stop" else "STANDBY")


def test_a_switch_while_probing_is_as_bumpless_as_without() -> None:
    """N1 falls silent: the transfer starts from the feedback's command, not from what is driven with the signal."""
    signals = {**BIASED, "N2": Signal(hz=constant(0.0))}
    rig, quiet = (probed(signals=signals) for _ in range(2))
    rig.tick(Order("probe_start"))
    quiet.tick()
    for each in (rig, quiet):
        each.run(15)
        each.signals = {**signals, "N1": Signal(hz=constant(0.0025), lost=lambda _: True)}
        each.run(90)
        active = {record.active for record in each.records}
        assert 0 in active and 2 in active
    switched = next(k for k, record in enumerate(rig.records) if record.active == 2)
    assert rig.records[switched].probe_mw == pytest.approx(80.0, abs=0.1)
    commands = [record.command_mw for record in rig.records]
    assert commands == [record.command_mw for record in quiet.records]
    assert commands[switched] == pytest.approx(45.0, abs=1e-3) and commands[-1] == pytest.approx(22.5, abs=1e-3)
    assert max(abs(b - a) for a, b in pairwise(commands[switched - 1 :])) < 0.376  # 22.5 MW in 1 s


def test_orders_that_are_refused() -> None:
    rig = Rig(steady(), extra=SQUARE).run(12)
    assert Event("refused", "probe_start", "not possible in STANDBY") in rig.tick(Order("probe_start")).events
    rig = probed()
    assert Event("refused", "probe_stop", "no signal is under way") in rig.tick(Order("probe_stop")).events
    rig.tick(Order("probe_start"))
    assert Event("refused", "probe_start", "a signal is under way") in rig.tick(Order("probe_start")).events
    rig = probed("")
    why = "no signal: set kind in [probing]"
    assert Event("refused", "probe_start", why) in rig.tick(Order("probe_start")).events


def test_the_checks_of_the_command_do_not_see_it() -> None:
    """A signal that rings, grows, leans and saturates, over a command that does nothing."""
    ringing = "[probing]\nkind = chirp\namplitude_mw = 125\nlow_hz = 2\nhigh_hz = 4\nduration_s = 20\n"
    rig = probed(ringing, signals=steady())
    rig.tick(Order("probe_start"))
    rig.run(900)
    assert max(record.probe_mw for record in rig.records) > 40  # slewed
    assert rig.records[-1].state == "ACTIVE"
    assert not rig.seen(80) & {"ringing", "growing", "saturation", "bias"}


def formed(
    system: SystemState = SystemState.ACTIVE,
    mode: Mode = Mode.CLOSED_LOOP,
    own_mw: float = 0.0,
    probe: Probe = IDLE,
    transfer_s: float = 1.0,
    **probing: Any,
) -> Command:
    """The command of one tick after one of 0 MW of the same instance; the signal is a file's 100 MW."""
    params = Params.paired(
        ("N",), ("S",), transfer_s=transfer_s, probing=Probing("file", samples=(100.0,) * 600, **probing)
    )
    state = initial_state(params, mode=mode)._replace(system=SystemState.ACTIVE, active=0)
    return form(params, state, system, mode, 0, own_mw, probe)


@pytest.mark.parametrize(("ramp_s", "transfer_s", "stop_s"), [(3.0, 1.0, 1.0), (0.5, 1.0, 0.5), (1.0, 4.0, 1.0)])
def test_a_signal_that_is_cut_short_is_gone_when_the_feedback_is(
    ramp_s: float, transfer_s: float, stop_s: float
) -> None:
    """Disarmed, it comes down in the shorter of both times; stopped in ACTIVE, in its own."""
    on = Probe(tick=100, level=1.0, mw=100.0)
    given: dict[str, Any] = {"ramp_s": ramp_s, "transfer_s": transfer_s}
    cut = formed(SystemState.RAMPDOWN, probe=on, **given).probe
    assert cut.stopping and cut.level == pytest.approx(1 - 1 / (60 * stop_s))
    stopped = formed(probe=on._replace(stopping=True), **given).probe
    assert stopped.level == pytest.approx(1 - 1 / (60 * ramp_s))
    assert formed(probe=on, **given).probe == on._replace(tick=101)


def test_the_backstop_that_holds_either_of_feedback_and_sum_is_told() -> None:
    step = SLEW_MW_PER_S / 60
    begun = Probe(tick=0, level=1.0)
    for own_mw, probe, slewed in ((10.0, IDLE, False), (10.0, begun, True), (5.0, begun, False), (30.0, IDLE, True)):
        command = formed(own_mw=own_mw, probe=probe)
        assert command.slewed is slewed, (own_mw, probe)
        assert command.driven_mw == pytest.approx(min(own_mw + command.probe.mw, step))
    # the signal alone is driven, and the feedback that is only computed is held
    command = formed(mode=Mode.OPEN_LOOP, own_mw=30.0, probe=begun, open_loop=True)
    assert command.slewed and (command.command_mw, command.driven_mw) == pytest.approx((step, 500 / 60))
