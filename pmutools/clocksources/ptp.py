"""PTP by linuxptp: ``pmc`` asks ptp4l for its data sets; the network card's clock is compared with the system's here.

ptp4l steers the clock of the network card, or, with software time stamps, the system's. In the first case phc2sys
brings the system's after it and says how far it is only to its log; so the two clocks are read side by side instead.
"""

from __future__ import annotations

import os
import re
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

from pmutools.clocksources.asking import NoAnswer, Patience, ask, shortened
from pmutools.measure.clocks import PtpClock
from pmutools.timebase import NS

SOCKETS = ("/var/run/ptp/ptp4lro", "/var/run/ptp4lro", "/var/run/ptp/ptp4l", "/var/run/ptp4l")
"""Where ptp4l takes questions; the first two, of version 4 on, from anyone, the others from root only."""
DATA_SETS = (
    "TIME_STATUS_NP",
    "CURRENT_DATA_SET",
    "PARENT_DATA_SET",
    "TIME_PROPERTIES_DATA_SET",
    "PORT_DATA_SET",
    "PORT_PROPERTIES_NP",
)
_ACCURACIES_NS = (25, 100, 250, 1_000, 2_500, 10_000, 25_000, 100_000, 250_000, 1_000_000, 2_500_000, 10_000_000)
ACCURACY_NS = dict(enumerate((*_ACCURACIES_NS, 25_000_000, 100_000_000, 250_000_000, NS, 10 * NS), 0x20))
"""clockAccuracy of IEEE 1588-2008, table 6; other codes promise nothing."""
PATIENCE_S = 2.0
TRIES = 5
_HEAD = re.compile(r"^\s+\S+ seq \d+ RESPONSE MANAGEMENT (\w+)")
_VALUE = re.compile(r"^\s+(\S+)\s+(\S.*?)\s*$")

DataSet = dict[str, str]


def ask_ptp(pmc: str, socket: str | None, patience: Patience) -> PtpClock:
    """Ask ptp4l at ``socket`` (None: the first of :data:`SOCKETS` that is there) by ``pmc``, a path.

    Raises NoAnswer.
    """
    where = socket or next((path for path in SOCKETS if os.path.exists(path)), None)
    if where is None or not os.path.exists(where):
        raise NoAnswer("ptp4l does not run" if socket is None else f"no ptp4l at {socket}")
    if not os.access(where, os.W_OK):
        raise NoAnswer(f"ptp4l takes questions from root only ({where})")
    questions = [f"GET {name}" for name in DATA_SETS]
    with tempfile.TemporaryDirectory(prefix="pmc-", ignore_cleanup_errors=True) as folder:
        command = [pmc, "-u", "-b", "0", "-i", os.path.join(folder, "pmc"), "-s", where, *questions]
        answer = ask(command, patience.at_most(PATIENCE_S))
    sets = parse_pmc(answer)
    if not sets:
        raise NoAnswer(f"ptp4l does not answer at {where}")
    try:
        return ptp_clock(sets, system_offset_ns)
    except ValueError as error:
        raise NoAnswer(f"pmc: {error}") from None


def parse_pmc(text: str) -> list[tuple[str, DataSet]]:
    """The data sets in what ``pmc`` writes, by name, in order; a set may come once a port. All else is passed over."""
    found: list[tuple[str, DataSet]] = []
    inside: DataSet | None = None
    for line in text.splitlines():
        if head := _HEAD.match(line):
            inside = {}
            found.append((head[1], inside))
        elif inside is not None and (value := _VALUE.match(line)):
            inside[value[1]] = value[2]
    return found


def ptp_clock(sets: list[tuple[str, DataSet]], system_offset_ns: Callable[[str, int], int | None]) -> PtpClock:
    """The clock that data sets tell of.

    ``system_offset_ns`` gives, of an interface and TAI - UTC, how far the system clock is from the card's. Raises
    ValueError, which names what is missing or makes no sense.
    """
    named = dict(reversed(sets))
    status, parent = _set(named, "TIME_STATUS_NP"), _set(named, "PARENT_DATA_SET")
    times = _set(named, "TIME_PROPERTIES_DATA_SET")
    port = _following(values for name, values in sets if name == "PORT_DATA_SET")
    card = _following(values for name, values in sets if name == "PORT_PROPERTIES_NP")
    state = (port or card).get("portState", "unknown")
    if status.get("gmPresent") == "false" and state == "SLAVE":
        state = "without a master"
    utc_offset_s = _integer(times, "currentUtcOffset") if times.get("currentUtcOffsetValid") == "1" else None
    accuracy = _integer(parent, "gm.ClockAccuracy") if "gm.ClockAccuracy" in parent else 0xFE
    return PtpClock(
        grandmaster=status.get("gmIdentity", parent.get("grandmasterIdentity", "?")),
        clock_class=_integer(parent, "gm.ClockClass"),
        master_offset_ns=_integer(status, "master_offset"),
        mean_path_delay_ns=_rounded(_set(named, "CURRENT_DATA_SET"), "meanPathDelay"),
        utc_offset_s=utc_offset_s,
        system_offset_ns=_system_offset(card, utc_offset_s, system_offset_ns),
        state=state,
        accuracy_ns=ACCURACY_NS.get(accuracy),
        ptp_timescale=times.get("ptpTimescale") == "1",
        leap=(times.get("leap61") == "1") - (times.get("leap59") == "1"),
    )


def _system_offset(
    card: DataSet, utc_offset_s: int | None, system_offset_ns: Callable[[str, int], int | None]
) -> int | None:
    if card.get("timestamping") == "SOFTWARE":
        return 0
    interface = card.get("interface", "")
    return None if utc_offset_s is None or not interface else system_offset_ns(interface, utc_offset_s)


def _following(ports: Iterator[DataSet]) -> DataSet:
    """The port that follows a master; the first where none does."""
    found = list(ports)
    return next((port for port in found if port.get("portState") == "SLAVE"), found[0] if found else {})


def _set(named: dict[str, DataSet], name: str) -> DataSet:
    if name not in named:
        raise ValueError(f"no {name}")
    return named[name]


def _integer(values: DataSet, name: str) -> int:
    return _parsed(values, name, lambda text: int(text, 0))


def _rounded(values: DataSet, name: str) -> int:
    return _parsed(values, name, lambda text: round(float(text)))


def _parsed(values: DataSet, name: str, parse: Callable[[str], int]) -> int:
    try:
        return parse(values[name])
    except KeyError:
        raise ValueError(f"no {name}") from None
    except (ValueError, OverflowError):
        raise ValueError(f"{name} {shortened(values[name])!r} is no number") from None


# --- the network card's clock ------------------------------------------------------------------------------------


def system_offset_ns(
    interface: str, utc_offset_s: int, sys: Path = Path("/sys"), dev: Path = Path("/dev")
) -> int | None:
    """System clock less the clock of a network card, which runs on TAI; None where that cannot be read."""
    device = next(sys.glob(f"class/net/{interface}/device/ptp/ptp*"), None) if "/" not in interface else None
    if device is None:
        return None
    with suppress(OSError):
        fd = os.open(dev / device.name, os.O_RDONLY | os.O_CLOEXEC)
        try:
            return clock_offset_ns(~fd << 3 | 3, utc_offset_s)  # FD_TO_CLOCKID of the kernel
        finally:
            os.close(fd)
    return None


def clock_offset_ns(clock_id: int, utc_offset_s: int) -> int:
    """System clock (UTC) less another clock that is ``utc_offset_s`` ahead of UTC.

    The tightest of some readings; the time it took is added to the size of the offset, as nobody knows when within it
    the other was read. Raises OSError for a clock that there is not.
    """
    best: tuple[int, int] | None = None
    for _ in range(TRIES):
        before = time.clock_gettime_ns(time.CLOCK_REALTIME)
        other = time.clock_gettime_ns(clock_id)
        took = time.clock_gettime_ns(time.CLOCK_REALTIME) - before
        if best is None or took < best[0]:
            best = took, before + took // 2 - (other - utc_offset_s * NS)
    assert best is not None
    took, offset = best
    return offset + took // 2 if offset >= 0 else offset - took // 2
