"""The figures of an analysed session, as marks that page and files are drawn from alike."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from dcon.analysis.analysis import Analysis, delta_f_of
from dcon.analysis.course import Stretch
from dcon.analysis.disturbances import Floats
from dcon.analysis.numbers import delays_ms
from dcon.analysis.ringdowns import Comparison, Mode, Ringdown
from dcon.columns.tables import INSTANCE_STATES, UNKNOWN
from dcon.core.values import words_of
from pmutools.modal.matrix_pencil import ANALYSIS_HZ, ringdown
from pmutools.report import theme
from pmutools.report.figures import (
    Axis,
    Dash,
    Dots,
    Figure,
    Heat,
    Line,
    Mark,
    Panel,
    Rule,
    Spans,
    time_axis,
)
from pmutools.report.text import utc

MOST_POINTS: Final = 12_000
"""Of one line: beyond, pairs of least and largest values, so that no peak is lost."""
MOST_FLAGS: Final = 16
MOST_INSTANCES: Final = 16
MOST_RINGDOWNS: Final = 8
"""With a figure of their own."""
MOST_STRETCHES: Final = 3000
SHADES: Final = 400
"""Cells of a row of the timeline, some three pixels each: what is shorter is drawn as a shade of its cell."""
TINTS: Final = ((0.02, 0.35), (0.1, 0.5), (0.4, 0.65), (math.inf, 0.8))
"""Up to this share of a cell: how much of the colour."""
CELLS: Final = 900
BEFORE_S, AFTER_S = 3.0, 4.0
"""Shown around a fit."""
STATE_COLORS: Final = {
    "OFF": theme.MUTED,
    "INIT": theme.SKY,
    "STANDBY": theme.BLUE,
    "ARMED": theme.ORANGE,
    "ACTIVE": theme.GREEN,
    "RAMPDOWN": theme.PURPLE,
    "FAULT": theme.VERMILION,
    "ESTOP": theme.INK,
}
INSTANCE_COLORS: Final = (
    ("READY", "#cfe8df"),
    ("HELD", "#fec44f"),
    ("INITIALISING", "#56b4e9"),
    ("DISABLED", "#d55e00"),
)
WORST: Final = tuple(name for name, _ in INSTANCE_COLORS)


def session_figures(session: Analysis, stem: str) -> list[Figure]:
    """All figures of one session; ``stem`` begins their names."""
    shown_ms = (session.begin_ns / 1e6, session.end_ns / 1e6)
    figures = [_timeline(session, stem, shown_ms), _signals(session, stem, shown_ms)]
    if session.columns.instance.state.shape[1]:
        figures.append(_instances(session, stem, shown_ms))
    drawn = sorted(session.ringdowns, key=lambda each: (each.mode is None, -each.peak_mhz))[:MOST_RINGDOWNS]
    figures += [
        _ringdown(session, each, f"{stem}-ringdown-{number}", number)
        for number, each in enumerate(session.ringdowns, 1)
        if each in drawn
    ]
    if any(pmu.delay_ms.p50 is not None for pmu in session.pmus):
        figures.append(_delays(session, stem))
    if session.timing.compute_us.p50 is not None:
        figures.append(_timing(session, stem, shown_ms))
    return figures


def comparison_figure(rows: Sequence[Comparison]) -> Figure:
    """Damping against gain; the open loop is at gain 0."""
    gain = np.array([row.gain_mw_per_mhz if row.closed else 0.0 for row in rows])
    damping = np.array([row.damping_percent for row in rows])
    words = [
        f"{'closed' if row.closed else 'open'} loop, {row.gain_mw_per_mhz:g} MW/mHz: {row.damping_percent:z.2f} %, "
        f"{row.frequency_hz:.4f} Hz"
        for row in rows
    ]
    ranges = [(at, row.damping_low_percent, row.damping_high_percent) for at, row in zip(gain, rows, strict=True)]
    x = np.array([value for at, _, _ in ranges for value in (at, at, math.nan)])
    y = np.array([value for _, low, high in ranges for value in (low, high, math.nan)])
    return Figure(
        "comparison",
        "Damping against gain",
        "; ".join(words),
        Axis("gain in force (MW/mHz); 0 is open loop"),
        [
            Panel(
                Axis("damping ratio (%)", range=(min(0.0, *y[::3]), 1.15 * max(0.1, *y[1::3]))),
                [
                    Line("middle 80 % of the fits", x, y, theme.SKY, width=5),
                    Dots("median", gain, damping, theme.BLUE, hover=words),
                ],
            )
        ],
        "Median over ringdowns, orders and windows.",
        300,
    )


def _timeline(session: Analysis, stem: str, shown_ms: tuple[float, float]) -> Figure:
    names: list[str] = []
    marks: list[Mark] = _gap_marks(session)
    for name, found, color in _rows(session):
        marks += bars(name, found, len(names), color, shown_ms)
        names.append(name)
    if orders := session.columns.orders[:MOST_STRETCHES]:
        marks.append(
            Dots(
                "operator's orders",
                np.array([order.tick_ns / 1e6 for order in orders]),
                np.full(len(orders), float(len(names))),
                theme.INK,
                "diamond",
                [f"{utc(o.tick_ns, 3)}: {words_of(o.name, o.given, o.text, o.who)}" for o in orders],
            )
        )
        names.append("orders")
    many = len({each.name for each in session.actives if each.name}) > MOST_INSTANCES
    told = ", then ".join(dict.fromkeys(each.name for each in session.states))
    return Figure(
        f"{stem}-timeline",
        "Timeline",
        f"States: {told}; {len(session.flags)} kinds of flags, {len(session.gaps)} gaps",
        time_axis("time", shown_ms),
        [Panel(Axis("", names=names), marks)],
        "Point at a bar for its name and times. Flags are drawn in the order in which they first rose"
        + (f", the first {MOST_FLAGS}." if len(session.flags) > MOST_FLAGS else ".")
        + (f" Of the instances, the first {MOST_INSTANCES} that were active." if many else "")
        + f" Stretches too short to be seen are pale bars of {(shown_ms[1] - shown_ms[0]) / SHADES / 1e3:.2g} s each, "
        "the darker the more of it they fill; zoom in to see them one by one."
        + (" Shaded: ticks that are not in the log." if session.gaps else ""),
        110 + 26 * len(names),
        wide=True,
    )


def _rows(session: Analysis) -> Iterator[tuple[str, list[Stretch], str]]:
    """A row for each state, mode, active instance and flag: its name, when, and a colour that says no more."""
    for name, found in _by_name(session.states).items():
        yield f"state {name}", found, STATE_COLORS.get(name, theme.MUTED)
    for name, found in _by_name(session.modes).items():
        yield f"mode {name}", found, theme.MUTED
    active = {name: found for name, found in _by_name(session.actives).items() if name}
    for name, found in list(active.items())[:MOST_INSTANCES]:
        yield f"active {name}", found, theme.INK
    for name, found in sorted(session.flags.items(), key=lambda item: item[1][0].begin_ns)[:MOST_FLAGS]:
        yield name, found, theme.VERMILION


def bars(name: str, found: Sequence[Stretch], row: int, color: str, shown_ms: tuple[float, float]) -> list[Line]:
    """Stretches as thick broken lines: below, what is too short to be seen, as shades; above, every stretch itself."""
    begin_ms, cell_ms = shown_ms[0], (shown_ms[1] - shown_ms[0]) / SHADES
    short = [each for each in found if (each.end_ns - each.begin_ns) / 1e6 < cell_ms]
    cells: dict[int, list[float]] = {}
    for each in short:
        middle_ms = (each.begin_ns + each.end_ns) / 2e6
        cells.setdefault(math.floor((middle_ms - begin_ms) / cell_ms), []).append((each.end_ns - each.begin_ns) / 1e6)
    shades: dict[float, list[Stretch]] = {}
    for cell, times_ms in sorted(cells.items()):
        tint = next(tint for most, tint in TINTS if sum(times_ms) <= most * cell_ms)
        from_ns, to_ns = (round((begin_ms + number * cell_ms) * 1e6) for number in (cell, cell + 1))
        words = f"{name}: {len(times_ms)} times, {sum(times_ms) / 1e3:.3f} s in all"
        shades.setdefault(tint, []).append(Stretch(words, from_ns, to_ns))
    drawn = [_bar(name, each, row, theme.tint(color, tint)) for tint, each in sorted(shades.items())]
    lost = set(short) if len(found) > MOST_STRETCHES else set()
    exact = [each for each in found if each not in lost]
    return [*drawn, _bar(name, exact[:MOST_STRETCHES], row, color)] if exact else drawn


def _bar(name: str, found: Sequence[Stretch], row: int, color: str) -> Line:
    """Stretches as one thick broken line."""
    x = [value for each in found for value in (each.begin_ns / 1e6, each.end_ns / 1e6, math.nan)]
    words = [
        text
        for each in found
        for text in (*(f"{each.name}: {utc(each.begin_ns, 3)}, {(each.end_ns - each.begin_ns) / 1e9:.3f} s",) * 2, "")
    ]
    return Line(name, np.array(x), np.full(len(x), float(row)), color, width=11, hover=words, listed=False)


def _by_name(found: Iterable[Stretch]) -> dict[str, list[Stretch]]:
    names: dict[str, list[Stretch]] = {}
    for each in found:
        names.setdefault(each.name, []).append(each)
    return names


def _gap_marks(session: Analysis) -> list[Mark]:
    ranges = [(gap.begin_ns / 1e6, gap.end_ns / 1e6) for gap in session.gaps if gap.end_ns > gap.begin_ns][:60]
    return [Spans("not in the log", ranges, theme.SILENT)] if ranges else []


def thinned(x: Floats, y: Floats, most: int = MOST_POINTS) -> tuple[Floats, Floats]:
    """(x, y) of at most about ``most`` points: of each stretch its least and its largest value, in their order."""
    if len(x) <= most:
        return x, y
    size = math.ceil(2 * len(x) / most)
    blocks = np.append(y, np.full(-len(y) % size, np.nan)).reshape(-1, size)
    known = np.isfinite(blocks)
    low = np.where(known, blocks, np.inf).argmin(axis=1)
    high = np.where(known, blocks, -np.inf).argmax(axis=1)
    at = np.stack((np.minimum(low, high), np.maximum(low, high)), 1) + np.arange(len(blocks))[:, np.newaxis] * size
    rows = np.minimum(at.ravel(), len(x) - 1)
    return x[rows], y[rows]


def _line(
    session: Analysis, name: str, y: npt.NDArray[Any], color: str, dash: Dash = Dash.SOLID, most: int = 0
) -> Line:
    """A signal (T,) over time, broken where ticks are missing."""
    x = session.columns.tick.tick_ns / 1e6
    y = np.asarray(y, np.float64)
    if session.gaps:
        rows = np.searchsorted(x, [gap.end_ns / 1e6 for gap in session.gaps])
        x, y = np.insert(x, rows, x[np.maximum(rows - 1, 0)]), np.insert(y, rows, np.nan)
    return Line(name, *thinned(x, y, most or MOST_POINTS), color, dash, width=1.2)


def _signals(session: Analysis, stem: str, shown_ms: tuple[float, float]) -> Figure:
    tick = session.columns.tick
    marks = _gap_marks(session)
    command: list[Mark] = [*marks, _line(session, "command", tick.command_mw, theme.BLUE)]
    if np.any(tick.output_v):
        command.append(_line(session, "output × 12.5 MW/V", tick.output_v * 12.5, theme.ORANGE, Dash.DOTTED))
    if np.nan_to_num(tick.probe_mw).any():
        command.append(_line(session, "probing signal", tick.probe_mw, theme.PURPLE))
    command += [
        Rule(
            f"limit, {'−' if side < 0 else ''}{session.limit_mw:g} MW",
            side * session.limit_mw,
            theme.VERMILION,
            upright=False,
        )
        for side in (1, -1)[: 2 if np.abs(tick.command_mw).max() > session.limit_mw / 2 else 0]
    ]
    count = tick.f_hz.shape[1]
    each = max(1500, MOST_POINTS // max(count, 1))
    names = [*session.columns.pmus, *map(str, range(len(session.columns.pmus), count))]
    frequencies: list[Mark] = [
        _line(session, names[k], tick.f_hz[:, k], theme.CYCLE[k % 7], Dash.DASHED if k >= 7 else Dash.SOLID, each)
        for k in range(count)
    ]
    panels = [
        Panel(Axis("Δf (mHz)"), [*marks, _line(session, "Δf", delta_f_of(session.columns), theme.BLUE)], 1.3),
        Panel(Axis("power (MW)"), command, 1.3),
        Panel(Axis("f (Hz)"), [*marks, *frequencies], 1.2),
        Panel(Axis("K (MW/mHz)"), [_line(session, "gain K", tick.gain_mw_per_mhz, theme.GREEN)], 0.8),
    ]
    thin = (
        f" Of every {len(tick.tick_ns) * 2 // MOST_POINTS + 1} ticks or so the least and the largest value are drawn."
    )
    return Figure(
        f"{stem}-signals",
        "Signals",
        "Δf, command, frequencies of all PMUs and gain over time",
        time_axis("time", shown_ms),
        panels,
        "Drag to zoom." + (thin if len(tick.tick_ns) > MOST_POINTS else " Every tick is drawn."),
        640,
        wide=True,
    )


def _instances(session: Analysis, stem: str, shown_ms: tuple[float, float]) -> Figure:
    tick_ns, state = session.columns.tick.tick_ns, session.columns.instance.state
    order = np.array([WORST.index(name) for name in INSTANCE_STATES], np.int8)
    levels = np.append(order, np.int8(-1))[np.where(state == UNKNOWN, len(order), state)]
    cells = min(CELLS, len(tick_ns))
    edges = np.linspace(0, len(tick_ns), cells, endpoint=False).astype(np.int64)
    worst = np.maximum.reduceat(levels, edges, axis=0).T
    x = tick_ns[edges] / 1e6 + (shown_ms[1] - shown_ms[0]) / cells / 2
    names = list(session.columns.instances)
    return Figure(
        f"{stem}-instances",
        "Instances",
        "State of every instance over time",
        time_axis("time", shown_ms),
        [Panel(Axis("", names=names), [Heat(x, worst, worst.astype(np.float64), "", INSTANCE_COLORS)])],
        "The worst state within each cell; which one is active is in the timeline.",
        120 + 18 * len(names),
        wide=True,
    )


def _ringdown(session: Analysis, found: Ringdown, name: str, number: int) -> Figure:
    tick = session.columns.tick
    rate = session.rate_hz
    begin = int(np.searchsorted(tick.tick_ns, found.begin_ns))
    start = int(np.searchsorted(tick.tick_ns, found.disturbed_ns))
    window_s = min(found.length_s, 14.0)
    end = begin + round(window_s * rate)
    part = slice(max(0, start - round(BEFORE_S * rate)), min(len(tick.tick_ns), end + round(AFTER_S * rate)))
    x = tick.tick_ns[part] / 1e6
    delta = delta_f_of(session.columns)
    spans: list[Mark] = [
        Spans("fitted", [(found.begin_ns / 1e6, found.begin_ns / 1e6 + 1e3 * window_s)], theme.DOUBTFUL)
    ]
    swing: list[Mark] = [*spans, Line("Δf", x, delta[part], theme.BLUE)]
    if found.mode is not None:
        at, fitted = _fitted(delta[begin:end], rate)
        swing.append(Line("fit", found.begin_ns / 1e6 + at * 1e3, fitted, theme.VERMILION, Dash.DASHED))
    power: list[Mark] = [
        *spans,
        Line("command", x, tick.command_mw[part], theme.BLUE),
        Line("output × 12.5 MW/V", x, tick.output_v[part] * 12.5, theme.ORANGE, Dash.DOTTED),
    ]
    told = mode_words(found.mode) if found.mode is not None else found.why
    loop = f"closed loop, {found.gain_mw_per_mhz:g} MW/mHz" if found.closed else "open loop"
    return Figure(
        name,
        f"Ringdown {number}: {loop}",
        f"Ringdown {number} in {loop}: {told}",
        time_axis("time", None),
        [Panel(Axis("Δf (mHz)"), swing, 1.4), Panel(Axis("power (MW)"), power)],
        f"{told}. Disturbed at {utc(found.disturbed_ns, 2)}; shaded: the longest window. "
        "The dashed line is one fit of many.",
        360,
    )


def mode_words(mode: Mode) -> str:
    f, z = mode.frequency_hz, mode.damping_percent
    return (
        f"{f.median:.4f} Hz ({f.low:.4f} to {f.high:.4f}), damping {z.median:z.2f} % ({z.low:z.2f} to {z.high:z.2f}), "
        f"R² {mode.r2:.3f}"
    )


def _fitted(signal: Floats, rate_hz: float) -> tuple[Floats, Floats]:
    """(seconds from the window's begin, value) of one fit, order 12, over the whole of ``signal``."""
    factor = max(1, math.floor(rate_hz / ANALYSIS_HZ))
    fit = ringdown(signal, rate_hz, 0.0, len(signal) / rate_hz, order=12)
    late_s = 5 * factor / rate_hz if factor > 1 else 0.0  # the decimating filter begins where it fits whole
    t = np.arange(0.0, len(signal) / rate_hz - 2 * late_s, factor / rate_hz)
    value = np.zeros_like(t)
    for mode in fit.modes:
        w = 2 * math.pi * mode.frequency_hz
        decay = mode.damping * w / math.sqrt(max(1e-12, 1 - mode.damping**2)) if w else 0.0
        if abs(mode.damping) < 1:
            value += mode.amplitude * np.exp(-decay * t) * np.cos(w * t + mode.phase_rad)
    return t + late_s, value + float(signal.mean())


def _delays(session: Analysis, stem: str) -> Figure:
    lines: list[Mark] = []
    shares = np.linspace(0, 1, 201)
    for place, (name, frames) in enumerate(session.columns.pmu.items()):
        delay = delays_ms(frames)
        if (known := delay[np.isfinite(delay)]).size:
            dash = Dash.DASHED if place >= 7 else Dash.SOLID
            lines.append(Line(name, np.quantile(known, shares), 100 * shares, theme.CYCLE[place % 7], dash))
    return Figure(
        f"{stem}-delays",
        "Delay of each PMU",
        "Distribution functions of the delay from stamp to arrival, a line for each PMU",
        Axis("stamp to arrival (ms)"),
        [Panel(Axis("share of frames (%)"), lines)],
        "Of the frames that ticks took. Clock errors of PMU and controller are in it.",
        320,
    )


def _timing(session: Analysis, stem: str, shown_ms: tuple[float, float]) -> Figure:
    tick = session.columns.tick
    return Figure(
        f"{stem}-timing",
        "Loop timing",
        "Time that each tick took, and how late it began",
        time_axis("time", shown_ms),
        [
            Panel(Axis("computing (µs)"), [_line(session, "start to command", tick.compute_us, theme.BLUE)]),
            Panel(Axis("late (µs)"), [_line(session, "nominal time to start", tick.late_us, theme.ORANGE)]),
        ],
        "",
        320,
    )
