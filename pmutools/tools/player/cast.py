"""Who plays what of a reel: each track as itself, or N emulated PMUs that share the tracks.

An emulated PMU has its own IDCODE, name and phase: the share of a reporting interval by which it sends later than its
track did, as no two devices send in the same microsecond. With a spread, its values differ a little too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools import draws, parsers
from pmutools.c37118.batch import decode_batch, encode_batch
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import LAST_IDCODE, NAME_SIZE, PREFIX_SIZE
from pmutools.errors import SettingsError
from pmutools.parsers import bind, call, parsed_by
from pmutools.timebase import NS
from pmutools.tools.player.reel import I64, Reel, Track, of_tracks

AHEAD_NS = 20_000_000
"""Frames are looked up this far ahead at once."""


@dataclass(frozen=True, slots=True)
class Spread:
    """How much emulated PMUs differ: standard deviations of a factor on magnitudes (percent), of an angle (degrees)
    and of a frequency offset (mHz), each drawn once a PMU."""

    mag: float = field(default=0.0, metadata=parsed_by(parsers.number(0, 100)))
    deg: float = field(default=0.0, metadata=parsed_by(parsers.number(0, 360)))
    mhz: float = field(default=0.0, metadata=parsed_by(parsers.number(0, 1000)))


def parse_spread(text: str) -> Spread:
    """``mag=1,deg=5,mhz=2``; raises ValueError."""
    return bind(Spread, call(f"spread({text})"))


@dataclass(frozen=True, slots=True)
class Part:
    """One PMU of the player, playing ``track``; ``gain`` and ``turn_rad`` change phasors, ``offset_hz`` frequencies."""

    track: int
    name: str
    idcode: int
    phase_ns: int = 0
    gain: float = 1.0
    turn_rad: float = 0.0
    offset_hz: float = 0.0
    emulated: bool = False

    @property
    def aliases(self) -> tuple[str, ...]:
        """Other names that patterns may mean."""
        return (str(self.idcode),)

    @property
    def altered(self) -> bool:
        """Whether its values differ from its track's."""
        return (self.gain, self.turn_rad, self.offset_hz) != (1.0, 0.0, 0.0)


class Cut(NamedTuple):
    """Frames (N,) in order of position: row of the reel, part that plays it, ns from the first frame of the reel."""

    row: I64
    part: npt.NDArray[np.int32]
    position_ns: I64


class Cast:
    """The parts of a reel, and which of them each row of it is for.

    ``configs`` knows what a part announces for an edition of its track.
    """

    def __init__(self, reel: Reel, parts: Sequence[Part]) -> None:
        self.reel, self.parts = reel, tuple(parts)
        self.phases = np.array([part.phase_ns for part in parts], np.int64)
        self.idcodes = np.array([part.idcode for part in parts], np.uint16)
        self.emulated = any(part.emulated for part in parts)
        self.altered = np.array([part.altered for part in parts])
        tracks = np.array([part.track for part in parts], np.int64)
        self._by_track = np.argsort(tracks, kind="stable").astype(np.int32)
        self._count = np.bincount(tracks, minlength=len(reel.tracks))
        self._first = np.concatenate(([0], np.cumsum(self._count)[:-1]))
        self.latest_ns = int(self.phases.max())
        """The greatest phase."""
        self._from_ns = self._to_ns = -1
        self._ahead = self._cut(-1, -1)
        first_rows = self._first_rows()
        self.editions = reel.rows.edition[first_rows]
        """(P,) the edition that each part begins with."""
        self.first_numbers = reel.rows.number[first_rows]
        """(P,) the number, in the recording, of the first frame that each part plays."""
        self._configs: dict[tuple[int, int], StreamConfig] = {}
        self._others: dict[StreamConfig, int] = {}

    def between(self, low_ns: int, high_ns: int) -> Cut:
        """The frames at positions ``low_ns`` to below ``high_ns``."""
        if not self._from_ns <= low_ns <= high_ns <= self._to_ns:
            self._look_up(low_ns, high_ns)
        ahead = self._ahead
        first, last = ahead.position_ns.searchsorted((low_ns, high_ns))
        return Cut(ahead.row[first:last], ahead.part[first:last], ahead.position_ns[first:last])

    def next_position(self, low_ns: int) -> int | None:
        """The position of the first frame at ``low_ns`` or later; None where there is none."""
        due, zero_ns = self.reel.rows.due_ns, self.reel.first_due_ns
        while True:
            if not self._from_ns <= low_ns < self._to_ns:
                self._look_up(low_ns, low_ns)
            ahead = self._ahead.position_ns
            if (place := int(ahead.searchsorted(low_ns))) < len(ahead):
                return int(ahead[place])
            row = int(due.searchsorted(zero_ns + self._to_ns - self.latest_ns))
            if row == len(due):
                return None
            low_ns = max(self._to_ns, int(due[row]) - zero_ns)

    def _look_up(self, low_ns: int, high_ns: int) -> None:
        self._from_ns, self._to_ns = low_ns, max(high_ns, low_ns + AHEAD_NS)
        self._ahead = self._cut(self._from_ns, self._to_ns)

    def _cut(self, low_ns: int, high_ns: int) -> Cut:
        due, zero_ns = self.reel.rows.due_ns, self.reel.first_due_ns
        first, last = due.searchsorted((zero_ns + low_ns - self.latest_ns, zero_ns + high_ns))
        rows = np.arange(first, last)
        tracks = self.reel.rows.track[first:last]
        if not self.emulated:
            return Cut(rows, tracks, due[first:last] - zero_ns)
        counts = self._count[tracks]
        rows = np.repeat(rows, counts)
        ends = np.cumsum(counts)
        within = np.arange(len(rows)) - np.repeat(ends - counts, counts)
        parts = self._by_track[np.repeat(self._first[tracks], counts) + within]
        position = due[rows] - zero_ns + self.phases[parts]
        kept = np.flatnonzero((position >= low_ns) & (position < high_ns))
        kept = kept[np.argsort(position[kept], kind="stable")]
        return Cut(rows[kept], parts[kept], position[kept])

    def config(self, part: int, edition: int) -> StreamConfig:
        """What ``part`` announces for data of ``edition``."""
        found = self._configs.get((part, edition))
        if found is None:
            found = self.reel.editions[edition]
            if self.reel.fps is not None:
                found = replace(found, data_rate=self.reel.fps)
            if self.parts[part].emulated:
                found = _renamed(found, self.parts[part])
            self._configs[part, edition] = found
        return found

    def names(self, part: int) -> tuple[str, ...]:
        """What patterns may call a part: its name, its IDCODE, its stations."""
        own = self.parts[part]
        first = self.config(part, int(self.editions[part]))
        return (own.name, *own.aliases, *(station.name for station in first.stations))

    def _first_rows(self) -> npt.NDArray[np.int64]:
        """(P,) the row that each part begins with."""
        tracks, firsts = np.unique(self.reel.rows.track, return_index=True)
        rows = np.zeros(len(self.reel.tracks), np.int64)
        rows[tracks] = firsts
        return rows[[part.track for part in self.parts]]

    def edition_of(self, part: int, config: StreamConfig | None, edition: int) -> int:
        """The number of the configuration that a fault gives ``part``'s data; ``edition`` for None."""
        if config is None:
            return edition
        number = self._others.setdefault(config, len(self.reel.editions) + len(self._others))
        self._configs[part, number] = config
        return number

    def alter(self, wire: bytes, config: StreamConfig, parts: npt.NDArray[np.int32], stamps_ns: I64) -> bytes:
        """Frames of ``config`` end to end, each with the values that its part (N,) makes of them."""
        batch = decode_batch(wire, config, check=False)
        gain = np.array([self.parts[part].gain for part in parts])
        offset_hz = np.array([self.parts[part].offset_hz for part in parts])
        turn = np.array([self.parts[part].turn_rad for part in parts])
        seconds = (stamps_ns % (3600 * NS)) / NS  # an angle that turns with the offset, without a jump for an hour
        turn = turn + math.tau * offset_hz * seconds
        batch = replace(
            batch,
            phasors=batch.phasors * (gain * np.exp(1j * turn))[:, None],
            frequency=batch.frequency + offset_hz[:, None],
            wire=None,
        )
        fresh, _ = encode_batch(batch)
        old = np.frombuffer(wire, np.uint8).reshape(fresh.shape)
        fresh[:, :PREFIX_SIZE] = old[:, :PREFIX_SIZE]
        return fresh.tobytes()


def as_recorded(reel: Reel, idcodes: Mapping[str, int] | None = None) -> Cast:
    """Each track as itself, or by its name under another IDCODE; raises SettingsError for a name that is none."""
    new = dict(idcodes or {})
    parts = [
        Part(number, track.name, new.get(track.name, track.config.idcode), emulated=track.name in new)
        for number, track in enumerate(reel.tracks)
    ]
    for name in new.keys() - {part.name for part in parts}:
        raise SettingsError(parsers.no_such_stream(f"--idcode {name}={new[name]}", [part.name for part in parts]))
    return Cast(reel, parts)


def emulated(reel: Reel, count: int, seed: int, *, stagger: bool = True, spread: Spread | None = None) -> Cast:
    """``count`` PMUs that take the reel's tracks in turn, IDCODEs counted up from the first track's.

    ``stagger`` spreads their phases evenly over a reporting interval. Raises SettingsError for more PMUs than IDCODEs.
    """
    if not 1 <= count <= LAST_IDCODE:
        raise SettingsError(f"--emulate {count}: between 1 and {LAST_IDCODE} PMUs have IDCODEs of their own")
    if count < len(reel.tracks):
        reel = of_tracks(reel, count)
    first = reel.tracks[0].config.idcode
    parts = []
    for number in range(count):
        place = number % len(reel.tracks)
        track = reel.tracks[place]
        name = clone_name(track, number, count)
        idcode = (first - 1 + number) % LAST_IDCODE + 1
        phase_ns = int(reel.period_ns(track.config.rate) * number / count) if stagger else 0
        part = Part(place, name, idcode, phase_ns, emulated=True)
        parts.append(_spread(part, number, spread, seed) if spread else part)
    return Cast(reel, parts)


def clone_name(track: Track, number: int, count: int) -> str:
    """The track's name, cut so that a number fits behind it."""
    digits = f"-{number + 1:0{len(str(count))}d}"
    return track.name.encode()[: NAME_SIZE - len(digits)].decode(errors="ignore").rstrip() + digits


def _spread(part: Part, number: int, spread: Spread, seed: int) -> Part:
    """With the values that its number draws, however many there are."""
    mag, deg, mhz = (draws.normal(seed, "emulated", f"spread.{what}", number) for what in ("mag", "deg", "mhz"))
    return replace(
        part,
        gain=max(0.0, 1 + mag * spread.mag / 100),
        turn_rad=math.radians(deg * spread.deg),
        offset_hz=mhz * spread.mhz / 1000,
    )


def _renamed(config: StreamConfig, part: Part) -> StreamConfig:
    """The configuration of an emulated PMU: its own IDCODE and name; several stations keep theirs behind its number."""
    stations = config.stations
    if len(stations) == 1:
        stations = (replace(config.stations[0], name=part.name, wire_name=None, idcode=part.idcode),)
    return replace(config, idcode=part.idcode, stations=stations)
