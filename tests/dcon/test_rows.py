"""Every check of the table: at its threshold, below and above it, and for how long; through C37.118 bytes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from support.rig import STEADY, Rig, Signal, constant, steady
from support.swing import START_NS

from dcon.core.checks import Action, Judged, judge
from dcon.core.feedback import ringing_mw
from dcon.core.params import Params
from dcon.core.rows import CORE
from dcon.core.values import NOTHING, Order, Pdci, Surroundings

PARAMS = Params.paired(("N1",), ("S1",))
TABLES = CORE.tables(PARAMS)
JUDGED = {row.bit: row for row in (*TABLES.frame, *TABLES.pmu, *TABLES.instance, *TABLES.system[3])}


# --- the table itself --------------------------------------------------------------------------------------------


def test_every_row_that_is_not_the_engines_is_judged() -> None:
    assert set(JUDGED) == {CORE.bits[row.name] for row in CORE.rows if row.value is not None}
    assert len(CORE.names) <= 64


INF = math.inf
DESIGN = {
    "stamp_step": ("pmu", "disable"),
    "stale_frame": ("pmu", "warn"),
    "interpolated": ("pmu", "warn"),
    "unread_frame": ("pmu", "warn"),
    "slew_limited": ("system", "warn"),
    "command_invalid": ("system", "trip"),
    "internal_error": ("system", "trip"),
    "not_finite": ("pmu", "disable", -INF, 0.0, 1),
    "stat_error": ("pmu", "disable", -INF, 0.0, 1),
    "not_synchronised": ("pmu", "disable", -INF, 0.0, 1),
    "config_change": ("pmu", "disable", -INF, 0.0, 1),
    "time_quality": ("pmu", "disable", -INF, 100.0, 1),
    "latency_high": ("pmu", "warn", -INF, 90.0, 1),
    "latency": ("pmu", "disable", -5.0, 200.0, 1),
    "voltage": ("pmu", "disable", 0.8, 1.2, 1),
    "voltage_step": ("pmu", "disable", -INF, 0.1, 1),
    "unbalance": ("pmu", "disable", -INF, 5.0, 60),
    "angle_step": ("pmu", "disable", -INF, 5.0, 1),
    "frequency": ("pmu", "disable", -INF, 1.0, 1),
    "rocof": ("pmu", "disable", -INF, 5.0, 1),
    "freq_differs": ("pmu", "warn", -INF, 20.0, 30),
    "freq_wrong": ("pmu", "disable", -INF, 20.0, 120),
    "frozen": ("pmu", "disable", -INF, 2.0, 5),
    "no_data": ("pmu", "warn", -INF, 0.0, 1),
    "arrival_gap": ("pmu", "disable", -INF, 50.0, 1),
    "alignment_age": ("instance", "disable", -INF, 200.0, 1),
    "alignment_skew": ("instance", "disable", -INF, 8.0, 1),
    "stamps_differ": ("instance", "disable", -INF, 0.0, 1),
    "off_median": ("instance", "disable", -INF, 3.0, 30),
    "no_ready_instance": ("system", "disarm", 1.0, INF, 1),
    "frequency_difference": ("system", "disarm", -INF, 200.0, 1),
    "angle_difference": ("system", "disarm", -INF, 120.0, 1),
    "slipping": ("system", "disarm", -INF, 0.0, 1),
    "saturation": ("system", "disarm", -INF, 50.0, 1),
    "ringing": ("system", "disarm", -INF, 10.0, 120),
    "growing": ("system", "disarm", -INF, 1.5, 1),
    "bias": ("system", "warn", -INF, 25.0, 1),
    "overrun": ("system", "warn", -INF, 0.0, 1),
    "overruns": ("system", "trip", -INF, 2.0, 1),
    "readback": ("system", "trip", -INF, 2.0, 3),
    "gps": ("system", "disarm", -INF, 5.0, 1),
    "watchdog": ("system", "trip", 1.0, INF, 1),
    "estop": ("system", "estop", 1.0, INF, 1),
    "line_out": ("system", "disarm", 1.0, INF, 1),
    "line_refuses": ("system", "disarm", 1.0, INF, 1),
    "line_window": ("system", "disarm", 0.0, INF, 1),
    "response_gain": ("system", "warn", 0.7, 1.3, 1),
    "response_lag": ("system", "warn", -INF, 60.0, 1),
    "response_gain_lost": ("system", "disarm", 0.7, 1.3, 600),
    "response_lag_lost": ("system", "disarm", -INF, 60.0, 600),
    "server": ("system", "warn", -INF, 2.0, 1),
    "disk": ("system", "warn", 10.0, INF, 1),
    "relays_open": ("system", "disarm", 1.0, INF, 30),
}
"""Every check with its scope, action, bounds, and frames or ticks at 60/s: what the design asks for, written out."""


def test_the_table_is_that_of_the_design() -> None:
    shown = {}
    for row in CORE.rows:
        judged = JUDGED.get(CORE.bits[row.name])
        bounds = () if judged is None else (judged.low, judged.high, judged.need)
        shown[row.name] = (str(row.scope), str(row.action), *bounds)
    assert list(shown.items()) == list(DESIGN.items())


@pytest.mark.parametrize("name", [row.name for row in CORE.rows if row.value is not None])
def test_a_row_is_down_at_its_bounds_and_up_beyond_them(name: str) -> None:
    row = JUDGED[CORE.bits[name]]
    finite = [bound for bound in (row.low, row.high) if math.isfinite(bound)]
    assert finite
    for value, want in (
        *((bound, False) for bound in finite),
        *((math.nextafter(row.high, math.inf), True) for _ in finite if row.high < math.inf),
        *((math.nextafter(row.low, -math.inf), True) for _ in finite if row.low > -math.inf),
        (math.nan, True),
        (None, False),
    ):
        given = value
        one = row._replace(value=lambda given=given: given, held=0 if row.held >= 0 else -1)
        held: tuple[int, ...] = ()
        for so_far in range(1, row.need + 1):
            raised, held, found = judge((one,), held, ())
            assert (raised == row.bit) is (want and so_far >= row.need)
            assert bool(found) is bool(raised)


def test_a_condition_that_pauses_starts_again() -> None:
    row = Judged(1, lambda up: float(up), -math.inf, 0.0, 0, 3)
    ups = []
    held: tuple[int, ...] = ()
    for up in (1, 1, 0, 1, 1, 1, 1, 0, 1):
        raised, held, _ = judge((row,), held, (up,))
        ups.append(raised)
    assert ups == [0, 0, 0, 0, 0, 1, 1, 0, 0]


# --- frames and instances: what PMUs send ------------------------------------------------------------------------

Case = tuple[str, Callable[[float], dict[str, Signal]], float, float]
"""(check, signals for a level, level that it stands, level that it does not)."""


def north(change: Callable[[float], Signal]) -> Callable[[float], dict[str, Signal]]:
    return lambda level: steady(N1=change(level))


def says(mhz: float) -> Signal:
    """Turning, with a FREQ that is off by so much."""
    return Signal(hz=constant(0.005), freq_hz=constant(0.005 + mhz / 1e3))


def stepped(at: int, before: float, after: float) -> Callable[[int], float]:
    return lambda k: after if k >= at else before


FRAME_CASES: dict[str, Case] = {
    "V1 absent": ("not_finite", north(lambda x: Signal(pu=stepped(30, 1, x))), 1, math.nan),
    "STAT data error": ("stat_error", north(lambda x: Signal(stat=stepped(30, 0, x))), 0x0800, 0x4000),
    "STAT not synchronised": ("not_synchronised", north(lambda x: Signal(stat=stepped(30, 0, x))), 0x0800, 0x2000),
    "STAT configuration": ("config_change", north(lambda x: Signal(stat=stepped(30, 0, x))), 0x0800, 0x0400),
    "MSG_TQ 100 us": ("time_quality", north(lambda x: Signal(time_quality=stepped(30, 0, x))), 6, 7),
    "PMU_TQ 100 us": ("time_quality", north(lambda x: Signal(stat=stepped(30, 0, x))), 4 << 6, 5 << 6),
    "late, warning": ("latency_high", north(lambda x: Signal(delay_ms=constant(x))), 90.0, 90.001),
    "late": ("latency", north(lambda x: Signal(delay_ms=stepped(30, 60, x))), 200.0, 200.001),
    "early": ("latency", north(lambda x: Signal(delay_ms=constant(x))), -5.0, -5.001),
    "high voltage": ("voltage", north(lambda x: Signal(pu=constant(x))), 1.1999, 1.2001),
    "low voltage": ("voltage", north(lambda x: Signal(pu=constant(x))), 0.8001, 0.7999),
    "voltage step up": ("voltage_step", north(lambda x: Signal(pu=stepped(30, 1, 1 + x))), 0.0999, 0.1001),
    "voltage step down": ("voltage_step", north(lambda x: Signal(pu=stepped(30, 1, 1 - x))), 0.0999, 0.1001),
    "unbalance": ("unbalance", north(lambda x: Signal(v2_percent=constant(x))), 4.999, 5.001),
    "angle step": ("angle_step", north(lambda x: Signal(deg=stepped(30, 0, x))), 4.999, 5.001),
    "frequency": ("frequency", north(lambda x: Signal(hz=constant(x))), 0.9999, 1.0001),
    "low frequency": ("frequency", north(lambda x: Signal(hz=constant(x))), -0.9999, -1.0001),
    "ROCOF": ("rocof", north(lambda x: Signal(hz=lambda k: -0.9 + x * max(0, k - 30) / 60)), 4.9, 5.1),
    "FREQ, warning": ("freq_differs", north(lambda x: says(x)), 19.99, 20.02),
    "FREQ": ("freq_wrong", north(lambda x: says(-x)), 19.99, 20.02),
    "frozen": ("frozen", north(lambda x: Signal(freq_hz=constant(x / 1e3))), 1.99, 2.01),
    "frozen without FREQ": ("frozen", north(lambda x: Signal(freq_hz=constant(x))), 0.0, math.nan),
    "silence": ("arrival_gap", north(lambda x: Signal(lost=lambda k: 40 <= k < 40 + x)), 2, 3),
    "skew": (
        "alignment_skew",
        lambda x: steady(**dict.fromkeys(("S1", "S2"), Signal(delay_ms=constant(60 + x * 50 / 3)))),
        8,
        9,
    ),
    "stamps apart": ("stamps_differ", north(lambda x: Signal(shift_us=constant(x))), 10, 11),
    "one against the others": (
        "off_median",
        lambda x: steady(("N1", "N2", "N3", "S1"), N3=Signal(hz=constant(x / 1e3))),
        2.99,
        3.01,
    ),
}
SLACK = {"skew": "[supervisor]\nlatency_max_ms = 300", "late": "[supervisor]\nlatency_warn_ms = 199\ngap_ms = 500"}


@pytest.mark.parametrize("case", FRAME_CASES)
def test_what_pmus_send_at_the_thresholds(case: str) -> None:
    name, signals, stands, falls = FRAME_CASES[case]
    extra = SLACK.get(case, "")
    assert name not in Rig(signals(stands), extra=extra).run(170).seen(30)
    rig = Rig(signals(falls), extra=extra).run(170)
    assert name in rig.seen(30)
    flags = [flag for (found, _), flag in rig.engine.state.flags.items() if found == name]
    row = JUDGED[CORE.bits[name]]
    for flag in flags:
        assert flag.times >= 1 and not flag.latched
        assert math.isnan(flag.value) or not row.low <= flag.value <= row.high
        assert flag.limit in (row.low, row.high)
    assert flags


def test_every_row_of_pmus_and_instances_has_a_case() -> None:
    tested = {name for name, *_ in FRAME_CASES.values()} | {"no_data", "alignment_age"}
    assert tested == {row.name for row in (*CORE.frame, *CORE.pmu, *CORE.instance)}


@pytest.mark.parametrize(
    ("case", "frames"),
    [("unbalance", 60), ("FREQ, warning", 30), ("FREQ", 120), ("frozen", 5), ("one against the others", 30)],
)
def test_how_long_a_condition_must_hold(case: str, frames: int) -> None:
    """The bad frames are as many as the row needs, or one less."""
    name, signals, _, falls = FRAME_CASES[case]
    for count in (frames - 1, frames):
        bad = signals(falls)
        changed = next(key for key, signal in bad.items() if signal is not STEADY)
        rig = Rig(bad)
        held = 0
        for _ in range(200):
            rig.tick()
            state = rig.engine.state
            memory = state.pmus[0].held if name != "off_median" else state.instances[2].held
            held = max(held, max(memory, default=0))
            if held == count:
                break
        rig.signals = steady(bad, **{changed: STEADY})
        assert (name in rig.seen(0)) is (count == frames)


def test_nothing_arrived_yet_is_said_until_something_does() -> None:
    rig = Rig(steady(N1=Signal(lost=lambda k: k < 20)))
    assert "no_data" in rig.run(20).up
    assert "no_data" not in rig.run(1).up


@pytest.mark.parametrize(("late_ms", "up"), [(128.999, False), (129.0, False), (129.001, True)])
def test_age_of_the_newest_common_stamp(late_ms: float, up: bool) -> None:
    rig = Rig(steady(), extra="[supervisor]\ngap_ms = 1000").run(30)
    rig.signals = steady(**dict.fromkeys(("N1", "N2", "S1", "S2"), Signal(lost=constant(True))))  # type: ignore[arg-type]
    rig.slot -= 1
    rig.tick(late_ns=round(late_ms * 1e6))
    assert ("alignment_age" in rig.up) is up


@pytest.mark.parametrize("silent", ["N1", "S1"])
def test_one_side_that_is_stale_is_enough(silent: str) -> None:
    rig = Rig(steady(("N1", "S1")), extra="[supervisor]\ngap_ms = 1000\nalignment_skew_frames = 31").run(30)
    rig.signals = steady(("N1", "S1"), **{silent: Signal(lost=constant(True))})  # type: ignore[arg-type]
    up = ["alignment_age" in rig.run(1).up for _ in range(12)]
    assert up == [False] * 7 + [True] * 5  # 71 ms and 7 frames are 188 ms


@pytest.mark.parametrize("ms", [50.0, 50.001])
def test_fifty_ms_to_the_nanosecond(ms: float) -> None:
    rig = Rig(steady()).run(30)
    rig.signals = steady(N1=Signal(lost=constant(True)))  # type: ignore[arg-type]
    rig.slot -= 1
    rig.tick(late_ns=round((ms - 11) * 1e6))
    assert ("arrival_gap" in rig.up) is (ms > 50)


def test_one_phase_that_fails_is_unbalance_before_it_is_low_voltage() -> None:
    """A phase at 80 %: V1 0.933 pu, V2 0.067 pu."""
    v1 = 2.8 / 3
    rig = Rig(steady(N1=Signal(pu=constant(v1), v2_percent=constant(-100 * 0.2 / 3 / v1)))).run(100)
    assert rig.seen() == {"unbalance"}
    assert rig.flag("unbalance", "N1").value == pytest.approx(7.143, abs=1e-3)


def test_freq_that_lags_through_the_same_filter_is_no_difference() -> None:
    """A large swing and a brake-like step of ROCOF: FREQ and angle agree, whatever the differentiator's delay."""
    swing = Signal(hz=lambda k: 0.2 * math.sin(2 * math.pi * 0.4 * k / 60) + 0.1 * (k > 100) * math.sin(k / 7))
    rig = Rig(steady(N1=swing)).run(400)
    assert not {"freq_differs", "freq_wrong"} & rig.seen()
    new = rig.engine.state.pmus[0]
    assert abs(new.filter.f_hz - new.freq.y1) < 1e-3


def test_a_grid_at_rest_is_not_frozen_and_a_frozen_pmu_is() -> None:
    """Identical frames of a noise-free plant at nominal pass; a PMU that stops measuring off nominal does not."""
    assert not Rig(steady()).run(300).seen() - {"no_data"}
    moving = Signal(hz=constant(0.02))
    stuck = replace(moving, hz=stepped(60, 0.02, 0.0), freq_hz=constant(0.02))
    rig = Rig(steady(N1=stuck, N2=moving, S1=moving, S2=moving)).run(80)
    assert "frozen" in rig.up and rig.flag("frozen", "N1").value == pytest.approx(20, abs=0.01)
    assert rig.engine.state.active is not None and rig.engine.params.instance_names[rig.engine.state.active] == "N2-S1"


# --- the active instance and its command -------------------------------------------------------------------------


def apart(mhz: Callable[[int], float], deg: float = 0.0) -> dict[str, Signal]:
    """North against south."""
    half = Signal(hz=lambda k: mhz(k) / 2e3, deg=constant(deg / 2))
    other = Signal(hz=lambda k: -mhz(k) / 2e3, deg=constant(-deg / 2))
    return steady(N1=half, N2=half, S1=other, S2=other)


def disarmed(rig: Rig, name: str) -> bool:
    """Whether ``name`` is what took ACTIVE away."""
    fell = [r for r in rig.records if any(e.name == "rampdown" for e in r.events)]
    return bool(fell) and any(e.detail == name for e in fell[0].events)


@pytest.mark.parametrize(("mhz", "up"), [(199.9, False), (-199.9, False), (200.1, True), (-200.1, True)])
def test_frequency_difference(mhz: float, up: bool) -> None:
    rig = Rig(apart(constant(mhz)), gain=0.1).run(40)
    assert ("frequency_difference" in rig.up) is up


@pytest.mark.parametrize(("deg", "up"), [(119.99, False), (120.01, True), (-120.01, True), (-119.99, False)])
def test_angle_difference(deg: float, up: bool) -> None:
    rig = Rig(apart(constant(0), deg)).run(20)
    rig.tick(Order("arm"))
    assert ("angle_difference" in rig.up) is up
    assert rig.tick(Order("activate")).state == ("STANDBY" if up else "ACTIVE")


def test_slipping() -> None:
    """0.1 Hz apart with the angle check at its widest: the slip itself disarms."""
    rig = Rig(apart(constant(100.0), 150.0), extra="[supervisor]\nangle_max_deg = 180", gain=0.1).arm().run(60)
    assert disarmed(rig, "slipping") and rig.flag("slipping").times == 1
    assert "angle_difference" not in rig.seen()


def test_saturation_duty() -> None:
    """At the limit for half of ten seconds stands; a tick more does not."""
    rig = Rig(apart(stepped(60, 0.0, 16.0))).arm().run(400)
    assert disarmed(rig, "saturation")
    full = [record.command_mw == 125.0 for record in rig.records]
    fell = next(k for k, r in enumerate(rig.records) if r.state == "RAMPDOWN")
    assert sum(full[:fell]) == 301
    assert rig.flag("saturation").value == pytest.approx(100 * 301 / 600) and rig.flag("saturation").latched


@pytest.mark.parametrize(("share", "up"), [(0.98, False), (1.02, True)])
def test_ringing(share: float, up: bool) -> None:
    def ring(mhz: float) -> Rig:
        return Rig(apart(lambda k: mhz * math.sin(2 * math.pi * 4 * k / 60))).arm().run(240)

    once = ringing_mw(ring(1.0).engine.state.feedback)
    rig = ring(share * 10 / once)
    assert disarmed(rig, "ringing") is up
    if up:
        fell = next(k for k, r in enumerate(rig.records) if r.state == "RAMPDOWN")
        assert fell > 14 + 120  # two seconds of it


@pytest.mark.parametrize(("mhz", "hz"), [(30.0, 0.4), (8.0, 0.8)])
def test_a_swing_does_not_ring(mhz: float, hz: float) -> None:
    """Nor do its harmonics where it saturates."""
    rig = Rig(apart(lambda k: mhz * math.sin(2 * math.pi * hz * max(0, k - 20) / 60))).arm().run(400)
    assert "ringing" not in rig.seen() and max(abs(record.command_mw) for record in rig.records) > 60


@pytest.mark.parametrize(("growth", "up"), [(1.45, False), (1.55, True)])
def test_growth_of_a_swing(growth: float, up: bool) -> None:
    def swing(k: int) -> float:
        cycles = 0.4 * k / 60
        return 4.0 * growth ** (cycles / 3) * math.sin(2 * math.pi * cycles)

    rig = Rig(apart(swing)).arm().run(900)
    assert disarmed(rig, "growing") is up
    assert "saturation" not in rig.seen()


def test_growth_below_30_mw_is_not_judged() -> None:
    rig = Rig(apart(lambda k: min(0.2 * 2 ** (k / 300), 3.0) * math.sin(2 * math.pi * 0.4 * k / 60))).arm().run(1500)
    assert "growing" not in rig.seen()


@pytest.mark.parametrize(("mw", "up"), [(24.9, False), (25.1, True), (-25.1, True)])
def test_bias(mw: float, up: bool) -> None:
    rig = Rig(apart(constant(mw / 9)), extra="[supervisor]\nangle_max_deg = 180", gain=9).arm().run(31 * 60 + 5)
    assert ("bias" in rig.up) is up
    assert rig.records[-1].state == "ACTIVE"  # it only warns


# --- the surroundings --------------------------------------------------------------------------------------------

STATUS = Pdci(START_NS + 12_000_000_000, 1500.0, scheduled_mw=1500.0)
TOLD_CASES: dict[str, tuple[str, Surroundings, Surroundings]] = {
    "GPS": ("gps", Surroundings(gps_age_s=5.0), Surroundings(gps_age_s=5.001)),
    "watchdog": ("watchdog", Surroundings(watchdog_healthy=True), Surroundings(watchdog_healthy=False)),
    "E-stop": ("estop", Surroundings(estop_released=True), Surroundings(estop_released=False)),
    "read back high": ("readback", Surroundings(readback_v=0.2), Surroundings(readback_v=0.2001)),
    "read back low": ("readback", Surroundings(readback_v=-0.2), Surroundings(readback_v=-0.2001)),
    "late": ("overrun", Surroundings(overrun=False), Surroundings(overrun=True)),
    "very late": ("overruns", Surroundings(overrun=False), Surroundings(overrun=True)),
    "line": ("line_out", Surroundings(pdci=STATUS), Surroundings(pdci=STATUS._replace(in_service=False))),
    "line off": ("line_refuses", Surroundings(pdci=STATUS), Surroundings(pdci=STATUS._replace(dcon_enabled=False))),
    "rating north to south": (
        "line_window",
        Surroundings(pdci=STATUS._replace(scheduled_mw=3095.0)),
        Surroundings(pdci=STATUS._replace(scheduled_mw=3095.1)),
    ),
    "rating south to north": (
        "line_window",
        Surroundings(pdci=STATUS._replace(scheduled_mw=-2975.0)),
        Surroundings(pdci=STATUS._replace(scheduled_mw=-2975.1)),
    ),
    "minimum": (
        "line_window",
        Surroundings(pdci=STATUS._replace(scheduled_mw=435.0)),
        Surroundings(pdci=STATUS._replace(scheduled_mw=-434.9)),
    ),
    "schedule by power": (
        "line_window",
        Surroundings(pdci=Pdci(STATUS.time_ns, 3095.0)),
        Surroundings(pdci=Pdci(STATUS.time_ns, 3095.1)),
    ),
    "weak": ("response_gain", Surroundings(response_gain=0.7), Surroundings(response_gain=0.699)),
    "strong": ("response_gain", Surroundings(response_gain=1.3), Surroundings(response_gain=1.301)),
    "weak for long": ("response_gain_lost", Surroundings(response_gain=0.7), Surroundings(response_gain=0.699)),
    "slow": ("response_lag", Surroundings(response_lag_ms=60.0), Surroundings(response_lag_ms=60.1)),
    "slow for long": ("response_lag_lost", Surroundings(response_lag_ms=60.0), Surroundings(response_lag_ms=60.1)),
    "server": ("server", Surroundings(server_age_s=2.0), Surroundings(server_age_s=2.1)),
    "relays": ("relays_open", Surroundings(relays_closed=True), Surroundings(relays_closed=False)),
    "disk": ("disk", Surroundings(disk_free_percent=10.0), Surroundings(disk_free_percent=9.9)),
}
STATES = {Action.WARN: "ACTIVE", Action.DISARM: "STANDBY", Action.TRIP: "FAULT", Action.ESTOP: "ESTOP"}
ROWS = {row.name: row for row in CORE.rows}


@pytest.mark.parametrize("case", TOLD_CASES)
def test_what_the_surroundings_tell(case: str) -> None:
    name, stands, falls = TOLD_CASES[case]
    rig = Rig(steady()).arm().run(90)
    rig.run(620, stands)
    assert name not in rig.seen() and rig.records[-1].state == "ACTIVE"
    need = JUDGED[CORE.bits[name]].need
    rig.run(need - 1 if need > 1 else 0, falls)
    assert name not in rig.up
    rig.run(3 if name == "overruns" else 1, falls)
    assert name in rig.up
    flag = rig.flag(name)
    assert flag.up and flag.latched is (ROWS[name].action is not Action.WARN)
    if name != "overrun":  # three of them trip
        rig.run(62, falls)
    assert rig.records[-1].state == STATES[ROWS[name].action]
    rig.run(62, NOTHING)
    assert name not in rig.up


def test_every_row_of_the_system_has_a_case() -> None:
    tested = {name for name, *_ in TOLD_CASES.values()}
    assert tested == {row.name for row in CORE.surroundings}


def test_three_late_ticks_in_a_second_trip_and_two_do_not() -> None:
    late, fine = Surroundings(overrun=True), Surroundings(overrun=False)
    rig = Rig(steady()).arm()
    for _ in range(4):
        rig.run(1, late).run(30, fine)
    assert rig.records[-1].state == "ACTIVE" and rig.flag("overrun").times == 4
    rig.run(1, late).run(1, fine)
    rig.run(1, late)
    assert rig.records[-1].state == "FAULT" and rig.flag("overruns").value == 3


def test_relays_are_open_for_half_a_second_at_most_and_only_where_closed_ones_are_asked_for() -> None:
    """ARMED or ACTIVE: the ordinary time of closing passes; a ramp down and a disarmed controller are not judged."""
    opened, shut = Surroundings(relays_closed=False), Surroundings(relays_closed=True)
    rig = Rig(steady()).run(90, opened)
    assert rig.records[-1].state == "STANDBY" and "relays_open" not in rig.seen()
    rig.tick(Order("arm"), told=opened)
    rig.run(29, opened).run(1, shut)  # they took their time
    rig.run(29, opened)
    assert rig.records[-1].state == "ARMED" and "relays_open" not in rig.seen()
    rig.run(1, opened)
    assert rig.records[-1].state == "STANDBY" and "relays_open" in rig.up
    flag = rig.flag("relays_open")
    assert flag.latched and (flag.value, flag.limit) == (0.0, 1.0)
    rig.run(60, opened)
    assert "relays_open" not in rig.up and rig.flag("relays_open").latched
    assert rig.tick(Order("arm"), told=opened).state == "STANDBY"  # until it is acknowledged


def test_no_word_of_relays_is_no_word_against_them() -> None:
    """A watchdog that is required and tells of health only, as in sessions of before: nothing is judged."""
    told = Surroundings(watchdog_healthy=True, estop_released=True)
    rig = Rig(steady(), extra="[watchdog]\nrequired = yes").run(90, told)
    rig.tick(Order("arm"), told=told)
    rig.run(90, told)
    assert rig.records[-1].state == "ARMED" and "relays_open" not in rig.seen()


def test_late_ticks_trip_nothing_that_is_not_armed() -> None:
    rig = Rig(steady()).run(20, Surroundings(overrun=True))
    assert rig.records[-1].state == "STANDBY" and rig.up == {"overrun"}


REQUIRED: dict[tuple[str, str], tuple[str, tuple[str, ...], Surroundings, str]] = {
    ("extra", "[platform]\ngps_required = yes"): ("disarm", ("gps",), Surroundings(gps_age_s=0.0), "has no GPS lock"),
    ("extra", "[watchdog]\nrequired = yes"): (
        "trip",
        ("watchdog", "estop"),
        Surroundings(watchdog_healthy=True, estop_released=True),
        "the watchdog is not healthy; the emergency stop is pressed",
    ),
    ("extra", "[server]\nrequired = yes"): (
        "warn",
        ("server",),
        Surroundings(server_age_s=0.1),
        "the server is silent",
    ),
    ("pdci", ""): (
        "disarm",
        ("line_out", "line_refuses"),
        Surroundings(pdci=STATUS),
        "the line is out of service, does not accept the command, or its status is not known; "
        "the line's schedule leaves no room",
    ),
}


@pytest.mark.parametrize("said", REQUIRED)
def test_what_is_required_must_be_there(said: tuple[str, str]) -> None:
    """Nothing is armed without it, and losing it acts; of the line that is so unless the settings say otherwise."""
    kind, names, there, refused = REQUIRED[said]
    settings: dict[str, Any] = dict([said])
    rig = Rig(steady(), **settings)
    for _ in range(12):
        rig.tick()
    assert set(names) <= rig.up
    if rig.records[-1].state == "STANDBY":
        record = rig.tick(Order("arm"))
        assert record.state == "STANDBY" and any(refused in event.detail for event in record.events), record.events
    rig = Rig(steady(), **settings).run(12, there)
    rig.tick(Order("arm"), told=there)
    assert rig.tick(Order("activate"), told=there).state == "ACTIVE"
    rig.tick()
    assert set(names) <= rig.up
    assert rig.records[-1].state == {"disarm": "RAMPDOWN", "warn": "ACTIVE", "trip": "ESTOP"}[kind]


def test_a_status_that_is_too_old_is_not_known() -> None:
    old = Surroundings(pdci=STATUS._replace(time_ns=START_NS - 10_000_000_000, in_service=False))
    rig = Rig(steady())
    assert "line_out" not in rig.run(1, old).up
    rig = Rig(steady(), pdci="required = yes")
    assert "line_out" in rig.run(1, old).up
