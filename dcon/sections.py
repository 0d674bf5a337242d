"""Sections of the initialisation file that are not the control law's: one class each, its fields the keys."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from dcon.places import Destination, LineSource, destination, line_source
from dcon.watchdog.codec import LOOPS
from dcon.watchdog.limits import BOUNDS, Limits, Rules
from pmutools.clocksources.gpsd import GPSD, Gpsd
from pmutools.net.endpoint import Endpoint, Scheme
from pmutools.parsers import boolean, choice, number, parsed_by, words
from pmutools.sites import endpoint

TIME_SOURCES = ("auto", "kernel", "chrony", "gpsd", "ptp", "none")


def listening(text: str) -> Endpoint:
    """A parser: where operators are listened to, over TCP."""
    try:
        where = endpoint(text if "://" in text else f"tcp://{text}")
    except ValueError:
        where = None
    if where is None or where.scheme is not Scheme.TCP or not where.port:
        port = text if text.isdecimal() else 4790
        remedy = f"write HOST:PORT, as in 127.0.0.1:{port}; an IPv6 address stands in brackets"
        raise ValueError(f"{text}: operators connect over TCP; {remedy}")
    return where


def _gpsd(text: str) -> Gpsd:
    try:
        where = endpoint(f"tcp://{text}")
    except ValueError:
        raise ValueError(f"{text}: write HOST:PORT, as in {GPSD}; an IPv6 address stands in brackets") from None
    return Gpsd(where.host, where.port)


@dataclass(frozen=True, slots=True)
class Output:
    """``[output]``: where the command goes."""

    url: Destination | None = field(default=None, metadata=parsed_by(destination))
    """``udp://HOST:PORT`` of a plant or gateway, ``iio://FOLDER?...`` or ``modbus://HOST:PORT?...`` (see the page on
    outputs); nothing is driven without it."""
    hold_ms: float = field(default=100.0, metadata=parsed_by(number(20, 1000)))
    """``iio://`` and ``modbus://``: the output goes to 0 V by itself when no command has come for so long."""

    @property
    def needs_process(self) -> bool:
        """Whether ``dcon output`` drives it; the watchdog sends datagrams itself."""
        return self.url is not None and not isinstance(self.url, Endpoint)


@dataclass(frozen=True, slots=True)
class LineInput:
    """``[pdci]``: where the line's status comes from. What it is judged by is :class:`~dcon.core.params.Line`."""

    url: LineSource | None = field(default=None, metadata=parsed_by(line_source))
    """``udp://ADDRESS:PORT?source=...``, where its datagrams are awaited, or ``modbus://HOST:PORT?...``, a device to be
    asked (see the page on outputs); without it the status is not known."""
    required: bool = field(default=True, metadata=parsed_by(boolean))
    """The line's status must be known: without it no arming, and a loss disarms."""


@dataclass(frozen=True, slots=True)
class Platform:
    """``[platform]``: the 60 Hz loop."""

    run_dir: Path | None = field(default=None, metadata=parsed_by(Path))
    """Folder of the sockets by which control process, watchdog, server and output meet; mode 0700, so that nobody else
    may enter. ``--run-dir`` goes over it; without one ``dcon platform`` is alone and ``dcon run`` takes a temporary
    one."""

    phase_ms: float = field(default=4.0, metadata=parsed_by(number(0, 1000)))
    """Ticks are this long after each 1/60 s of UTC."""
    fifo: bool = field(default=True, metadata=parsed_by(boolean))
    """Ask for the FIFO scheduling policy; without the privilege the loop runs on, with a warning."""
    judge_overruns: bool = field(default=False, metadata=parsed_by(boolean))
    """Tell the checks of ticks that were not done in time: one warns, three in a second trip. An ordinary machine
    pauses now and then, and the loop makes up for it; a real-time system must not pause."""
    gps_required: bool = field(default=False, metadata=parsed_by(boolean))
    """The GPS lock of the controller's clock must be known: without it no arming, and a loss disarms."""
    time_source: str = field(default="auto", metadata=parsed_by(choice(*TIME_SOURCES)))
    """Whose word on this machine's clock counts as its GPS lock: ``kernel`` (adjtimex), ``chrony``, ``gpsd``, ``ptp``,
    the best promise among them (``auto``: the lock is not known until somebody promises something), or nobody's
    (``none``: it is not known)."""
    gpsd: Gpsd = field(default=GPSD, metadata=parsed_by(_gpsd))
    """``HOST:PORT`` of gpsd, where it is asked."""
    time_bound_ms: float = field(default=5.0, metadata=parsed_by(number(1e-3, 1000)))
    """The clock has its lock while that word is that it is no further than this from UTC."""


def _loops(text: str) -> tuple[str, ...]:
    return tuple(map(choice(*LOOPS), words(text)))


def _limit(name: str) -> float:
    """A field for a limit of the watchdog, which has its own defaults and bounds."""
    default: float = field(default=getattr(Limits(), name), metadata=parsed_by(number(*BOUNDS[name])))
    return default


@dataclass(frozen=True, slots=True)
class Watchdog:
    """``[watchdog]``. Files are such as GPIO value files, on a local disk."""

    required: bool = field(default=False, metadata=parsed_by(boolean))
    """Watchdog and emergency stop must be known to be healthy and released: without them no arming, a loss trips."""
    beats: tuple[str, ...] = field(default=Rules().beats, metadata=parsed_by(_loops))
    """Loops whose beats must come; others are judged from their first beat on."""
    readback: str = field(default="auto", metadata=parsed_by(choice("auto", "required")))
    """``required``: without a readback of the output the relays open; ``auto``: from the first readback on."""
    status: tuple[str, ...] = field(default=("control.in", "status.in"), metadata=parsed_by(words))
    """Sockets of the run folder that are told each 20 ms; one that nobody holds does no harm."""
    estop_a: str = field(default="", metadata=parsed_by(str))
    """File of line a of the emergency stop: ``1`` is released, anything else is pressed; "" is no such line."""
    estop_b: str = field(default="", metadata=parsed_by(str))
    """The same of line b."""
    relay_a: str = field(default="", metadata=parsed_by(str))
    """File that drives relay a: ``1`` closes it. It must be there; one that cannot be written trips."""
    relay_b: str = field(default="", metadata=parsed_by(str))
    """The same of relay b, in series with a."""
    contact_a: str = field(default="", metadata=parsed_by(str))
    """File that shows the contact of relay a: ``1`` closed, ``0`` open, anything else is wrong either way."""
    contact_b: str = field(default="", metadata=parsed_by(str))
    """The same of relay b."""
    drive: str = field(default="level", metadata=parsed_by(choice("level", "pulse")))
    """``pulse``: what drives a closed relay turns each 10 ms, so that a monostable lets it go when the process dies."""
    fifo: bool = field(default=True, metadata=parsed_by(boolean))
    """Ask for the FIFO scheduling policy, above the controller's; without the privilege it runs on, with a warning."""
    log: str = field(default="", metadata=parsed_by(str))
    """File for its lines (JSON); without one they go to stderr."""
    log_mb: float = field(default=10.0, metadata=parsed_by(number(0.01, 1e4)))
    """A log file of so many megabytes becomes ``FILE.1``, over the one before."""
    status_timeout_ms: float = field(default=100.0, metadata=parsed_by(number(40, 5000)))
    """The controller takes a watchdog that has said nothing for so long as dead, and trips."""
    fast_timeout_ms: float = _limit("fast_timeout_ms")
    """Longest time without a beat of control, udp and parse, or with beats whose counter stands."""
    slow_timeout_ms: float = _limit("slow_timeout_ms")
    """The same of gps, gui, pdci and output."""
    server_timeout_ms: float = _limit("server_timeout_ms")
    """The same of the server, which is only told."""
    control_rate_max_hz: float = _limit("control_rate_max_hz")
    """Largest advance of the counter of control in a second; it makes 60 rounds, and may catch up."""
    front_rate_max_hz: float = _limit("front_rate_max_hz")
    """The same of udp and parse."""
    slow_rate_max_hz: float = _limit("slow_rate_max_hz")
    """The same of all others."""
    command_timeout_ms: float = _limit("command_timeout_ms")
    """Longest time without a command."""
    malformed_max: float = _limit("malformed_max")
    """So many datagrams with a wrong size, magic, CRC or value are forgiven, until none came for a second."""
    range_max_v: float = _limit("range_max_v")
    """Largest volts of a command, either way."""
    mismatch_max_mw: float = _limit("mismatch_max_mw")
    """Largest difference of a command's MW from 12.5 MW/V times its volts."""
    stamp_max_ms: float = _limit("stamp_max_ms")
    """Largest difference of a command's time from the watchdog's UTC, either way."""
    unasked_max_v: float = _limit("unasked_max_v")
    """Largest volts, either way, of a command that does not ask for closed relays."""
    readback_max_percent: float = _limit("readback_max_percent")
    """Largest difference of a readback from what was forwarded, in percent of 10 V."""
    readback_count: float = _limit("readback_count")
    """So many in a row beyond it trip."""
    readback_timeout_ms: float = _limit("readback_timeout_ms")
    """Longest time without a readback, where they came or are required."""
    estop_discrepancy_ms: float = _limit("estop_discrepancy_ms")
    """Longest time for which one line of the emergency stop may be pressed and the other not."""
    contact_timeout_ms: float = _limit("contact_timeout_ms")
    """Longest time that a contact may take to be as ordered."""
    late_max_ms: float = _limit("late_max_ms")
    """How late a round of the watchdog itself may come; they are 10 ms apart."""
    close_max_v: float = _limit("close_max_v")
    """Largest volts, either way, at which the relays close."""

    @property
    def rules(self) -> Rules:
        """What the watchdog judges by."""
        limits = Limits(*(getattr(self, name) for name in Limits._fields))
        return Rules(limits, self.beats, self.readback == "required")


@dataclass(frozen=True, slots=True)
class Server:
    """``[server]``."""

    required: bool = field(default=False, metadata=parsed_by(boolean))
    """The server must be heard: without it no arming; a loss warns."""
    listen: Endpoint = field(default=Endpoint(Scheme.TCP, "127.0.0.1", 4790), metadata=parsed_by(listening))
    """``HOST:PORT`` for operators. Orders are signed, what is told is not secret to who can connect."""
    keys: str | None = field(default=None, metadata=parsed_by(str))
    """File of operators and their keys (``dcon keys``); without it nobody orders anything."""
    window_s: float = field(default=5.0, metadata=parsed_by(number(0.1, 60)))
    """An order's time may differ so much from the platform's clock."""


@dataclass(frozen=True, slots=True)
class Log:
    """``[log]``."""

    path: str = field(default="session.mcap", metadata=parsed_by(str))
    """Of the first part; the others are ``session.part2.mcap``, ``session.part3.mcap``, ... beside it."""
    max_mb: float = field(default=1000.0, metadata=parsed_by(number(1, 1e6)))
    """A part of so many megabytes is ended at the next checkpoint, and another begun."""
    max_minutes: float = field(default=60.0, metadata=parsed_by(number(1, 1e6)))
    """So is one that spans so much time."""
    backfill_s: float = field(default=120.0, metadata=parsed_by(number(1, 3600)))
    """The controller keeps so much of its log for a server that is away ..."""
    backfill_mb: float = field(default=64.0, metadata=parsed_by(number(1, 4096)))
    """... and at most so many megabytes: memory that is locked."""
