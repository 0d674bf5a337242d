"""Sessions at random: a large swing seen by four PMUs, with faults, orders and surroundings as they come."""

from __future__ import annotations

import cmath
import math
import random

from support.streams import MS, START_NS, VOLTS

from dcon.core.params import Params
from dcon.core.probe import Probing
from dcon.core.system import ORDERS
from dcon.core.values import NOTHING, Inputs, Order, Pdci, Sample, Surroundings

FOUR = Params.paired(
    ("N1", "N2"),
    ("S1", "S2"),
    nominal_kv=500.0,
    init_s=0.2,
    return_s=0.3,
    transfer_s=0.25,
    gain_mw_per_mhz=15.0,
    probing=Probing("square", 125.0, 2.0, 5),
)
FAULTS = ("ok", "ok", "ok", "ok", "ok", "ok", "lost", "stat", "nan", "late", "twice", "old", "jump", "tq", "same", "v2")


def told(draw: random.Random, now_ns: int) -> Surroundings:
    """Something that is mostly well."""

    def well(value: object, other: object) -> object:
        return draw.choices((None, value, other), (1, 8, 0.05))[0]

    line = Pdci(now_ns - draw.randint(0, 12) * 1000 * MS, draw.uniform(300, 3200), draw.random() < 0.99)
    return Surroundings(
        *(well(0.0, 9.0), well(True, False), well(True, False), well(line, line._replace(dcon_enabled=False))),
        *(None, well(False, True), well(1.0, 2.0), well(11.0, 90.0), well(0.1, 5.0), well(50.0, 5.0)),
        draw.choice(((), (), (), (0, 1, 0, 0))),
    )


def session(seed: int, count: int, faulty: float) -> list[tuple[Inputs, int]]:
    """Inputs and time of each tick; ``faulty`` is the share of frames with a fault."""
    draw = random.Random(seed)
    phase, size, hz = draw.random() * 6, draw.choice((2e-3, 15e-3, 60e-3)), draw.choice((0.25, 0.4, 1.0))
    waiting: list[list[Sample]] = [[], [], [], []]
    outage = [0, 0, 0, 0]
    out = []
    for k in range(count):
        stamp = START_NS + (k * 1_000_000_000 + 30) // 60
        now_ns = stamp + 64 * MS
        taken = []
        for pmu in range(4):
            turn = size / hz * math.sin(2 * math.pi * hz * k / 60 + phase) * (1 if pmu < 2 else -1)
            frame = Sample(stamp, stamp + 60 * MS, cmath.rect(VOLTS, turn), 60.0, 0, 0)
            fault = draw.choice(FAULTS) if draw.random() < faulty else "ok"
            outage[pmu] = draw.randint(5, 40) if draw.random() < faulty / 20 else max(0, outage[pmu] - 1)
            if fault == "stat":
                frame = frame._replace(stat=draw.getrandbits(16))
            elif fault == "nan":
                frame = frame._replace(v1=complex(draw.choice((math.nan, math.inf, 0.0)), 1.0))
            elif fault == "old":
                frame = frame._replace(time_ns=frame.time_ns - draw.randint(0, 10**9))
            elif fault == "jump":
                frame = frame._replace(v1=frame.v1 * cmath.rect(1, draw.random()))
            elif fault == "same" and waiting[pmu]:
                frame = frame._replace(v1=waiting[pmu][-1].v1, frequency_hz=60 + draw.choice((0, 0.003)))
            elif fault == "v2":
                frame = frame._replace(v2=frame.v1 * draw.random() / 10)
            elif fault == "tq":
                frame = frame._replace(time_quality=draw.getrandbits(8))
            if outage[pmu] == 0 and fault != "lost":
                waiting[pmu] += [frame] * (2 if fault == "twice" else 1)
            taken.append(() if fault == "late" else tuple(waiting[pmu]))
            if fault != "late":
                waiting[pmu] = []
        orders: tuple[Order, ...] = ()
        if draw.random() < 0.3:
            orders = (Order(draw.choice(("arm", "activate", "arm", "activate", "closed_loop", draw.choice(ORDERS)))),)
        if draw.random() < 0.05:
            orders += (Order("gain", draw.uniform(-1, 20)),)
        if draw.random() < 0.1:
            orders += (Order(draw.choice(("probe_start", "ack", "reset")), who="somebody"),)
        surroundings = told(draw, now_ns) if draw.random() < faulty * 3 else NOTHING
        out.append((Inputs(tuple(taken), orders, surroundings), now_ns))
    return out
