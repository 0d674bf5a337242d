"""Sessions made at random: ticks with every kind of float, and the names that go with them."""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from dcon.core.values import (
    NOTHING,
    Event,
    Flag,
    InstanceRecord,
    InstanceState,
    Mode,
    Order,
    Pdci,
    Record,
    Surroundings,
    SystemState,
)
from dcon.session.codec import Timing, Watchdog
from dcon.session.encode import tick_entries, watchdog_entry
from dcon.session.head import Head
from dcon.session.rolling import RollingWriter
from dcon.session.writer import SessionWriter
from pmutools.flow import StampSource
from pmutools.schema.pmu_log import Loggable, PmuFrame

PMUS = ("N1", "N2", "S1", "S2")
INSTANCES = ("N1-S1", "N1-S2", "N2-S1", "N2-S2")
FLAGS = ("stat", "timestamp_step", "arrival_gap")
INI = "[controller]\ngain_mw_per_mhz = 9   ; Δf\n"
CONFIGS = {name: b"\xaa\x31\x00\x10 cfg " + name.encode() for name in PMUS}
METADATA = {"seed": "7", "plant": "modal", "scenario": "cjb"}
HEAD = Head(INI, PMUS, INSTANCES, FLAGS, METADATA)
T0 = 1_473_354_311_000_000_000
PERIOD_NS = 16_666_667


class Tick(NamedTuple):
    """What :func:`log_tick` logs."""

    record: Record
    frames: tuple[PmuFrame, ...]
    orders: tuple[Order, ...]
    timing: Timing | None
    pdci: Pdci | None
    surroundings: Surroundings


def random_ticks(count: int, seed: int = 1) -> list[Tick]:
    """``count`` consecutive ticks of four PMUs and four instances."""
    rng = random.Random(seed)
    return [_tick(rng, T0 + k * PERIOD_NS) for k in range(count)]


def write_session(path: Path, ticks: list[Tick]) -> Path:
    with open_session(path) as session:
        for tick in ticks:
            write_tick(session, tick)
    return path


def write_tick(session: SessionWriter, tick: Tick) -> None:
    log_tick(session, *tick[:3], timing=tick.timing, pdci=tick.pdci, surroundings=tick.surroundings)


def log_tick(
    log: SessionWriter | RollingWriter,
    record: Record,
    frames: Iterable[Loggable] = (),
    orders: Iterable[Order] = (),
    *,
    instances: Sequence[str] = INSTANCES,
    timing: Timing | None = None,
    pdci: Pdci | None = None,
    surroundings: Surroundings = NOTHING,
) -> None:
    """Log one tick, as a controller with these ``instances`` does."""
    told = {"foreign": 3, "held": 0}
    entries = tick_entries(
        instances, record, frames, orders, timing=timing, pdci=pdci, counts=told, surroundings=surroundings
    )
    log.write(entries, record.tick_ns)


def log_watchdog(log: SessionWriter | RollingWriter, watchdog: Watchdog) -> None:
    log.write([watchdog_entry(watchdog)], watchdog.time_ns)


def log_configs(log: RollingWriter, configs: Mapping[str, bytes]) -> None:
    """What came before the first tick."""
    for name, frame in configs.items():
        log.config(name, frame, 0)


def open_session(path: Path) -> SessionWriter:
    return SessionWriter(path, HEAD, CONFIGS)


def bits(value: object) -> object:
    """``value`` with every float replaced by its eight bytes: equal exactly where every bit is."""
    if isinstance(value, float):
        return struct.pack(">d", value)
    if isinstance(value, complex):
        return struct.pack(">dd", value.real, value.imag)
    return tuple(map(bits, value)) if isinstance(value, tuple) else value


def _tick(rng: random.Random, tick_ns: int) -> Tick:
    active = rng.choice((None, *range(len(INSTANCES))))
    instances = tuple(
        InstanceRecord(
            rng.choice(list(InstanceState)), at == active, _float(rng), _float(rng), rng.choice(("", "STAT"))
        )
        for at in range(len(INSTANCES))
    )
    record = Record(
        tick_ns,
        rng.choice(list(SystemState)),
        rng.choice(list(Mode)),
        active,
        9.0,
        _float(rng),
        rng.uniform(-125, 125),
        rng.choice((0.0, -0.0, rng.uniform(-10, 10))),
        _float(rng),
        rng.choice((0, 1, 5, 2**64 - 1)),
        tuple(_float(rng) for _ in PMUS),
        tuple(_float(rng) for _ in PMUS),
        instances,
        tuple(Event("gain", "system", f"{k} → 9, ok") for k in range(rng.choice((0, 0, 0, 1, 2)))),
        tuple(_flag(rng, tick_ns) for _ in range(rng.choice((0, 0, 0, 1, 2)))),
    )
    pdci = rng.choice((None, _pdci(rng, tick_ns)))
    return Tick(
        record,
        tuple(_frame(rng, rng.choice(PMUS), tick_ns) for _ in range(rng.randint(0, 6))),
        tuple(
            Order(
                rng.choice(("arm", "gain")),
                _float(rng),
                rng.choice(("", "frozen N1")),
                rng.choice(("", "Δ")),
                rng.choice(("", "τ")),
            )
            for _ in range(rng.choice((0, 0, 1, 2)))
        ),
        rng.choice((None, Timing(_float(rng), _float(rng)))),
        pdci,
        rng.choice((NOTHING, _surroundings(rng, pdci))),
    )


def _flag(rng: random.Random, tick_ns: int) -> Flag:
    yes = (True, False)
    counted = (tick_ns - rng.getrandbits(40), tick_ns, rng.getrandbits(20), _float(rng), _float(rng))
    return Flag("voltage", rng.choice(PMUS), rng.choice(yes), *counted, rng.choice(yes), rng.choice(("", "A. B.")))


def _pdci(rng: random.Random, tick_ns: int) -> Pdci:
    return Pdci(tick_ns - 5, _float(rng), rng.random() < 0.5, rng.random() < 0.5, _float(rng))


def _surroundings(rng: random.Random, pdci: Pdci | None) -> Surroundings:
    """Any of it fitted or not; the line's status is that beside the tick, since it would be logged as that too."""
    yes_no = (None, True, False)
    return Surroundings(
        *(rng.choice((None, _float(rng))), rng.choice(yes_no), rng.choice(yes_no), pdci),
        *(rng.choice((None, _float(rng))), rng.choice(yes_no)),
        *(rng.choice((None, _float(rng))) for _ in range(4)),
        rng.choice(((), (0, 3, 0, 1))),
        rng.choice(yes_no),
    )


def _frame(rng: random.Random, name: str, tick_ns: int) -> PmuFrame:
    return PmuFrame(
        name,
        rng.randbytes(40),
        tick_ns - 40_000_000,
        tick_ns - rng.randrange(20_000_000),
        rng.choice(list(StampSource)),
        rng.getrandbits(16),
        rng.getrandbits(8),
        _float(rng),
        _float(rng),
        complex(_float(rng), _float(rng)),
        tuple(complex(_float(rng), _float(rng)) for _ in range(2)),
        tick_ns=tick_ns,
        time_base=rng.choice((1_000_000, 0xFFFFFF)),
    )


def _float(rng: random.Random) -> float:
    """Any double there is, the awkward ones often; one NaN, since there is no promise about its payload."""
    kind = rng.randrange(6)
    if kind == 0:
        return rng.choice((0.0, -0.0, math.nan, math.inf, -math.inf, 5e-324, 1.7976931348623157e308))
    if kind == 1:
        value = float(struct.unpack(">d", rng.randbytes(8))[0])
        return math.nan if math.isnan(value) else value
    return rng.gauss(0, 10)
