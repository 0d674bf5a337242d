"""Every fault on real sockets, as a receiver sees it that shares nothing with pmutools, and as the ledger tells it.

One player has a stream for each row of :data:`FAULTS`, and plays all of them at once: over UDP, then over TCP. The
receivers (:mod:`support.ear`) are plain sockets in another process, with the kernel's arrival stamps. What a fault does
to the bytes is computed here from the recording, by hand.
"""

from __future__ import annotations

import statistics
import struct
import sys
import threading
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from support.chain import EarlyClock, playing
from support.ear import CFG2, Chunk, Ear, Heard, good, listening, sealed, undisturbed, word
from support.live import free_ports
from support.playing import MS, interleaved, recording, reel_of, stream

from pmutools.impair.profile import parse_profile
from pmutools.net.endpoint import parse_endpoint
from pmutools.timebase import NS
from pmutools.tools.player.cast import as_recorded
from pmutools.tools.player.ledger import LedgerWriter
from pmutools.tools.player.play import Options, Player

pytestmark = [
    pytest.mark.alone,
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="receivers ask for Linux's arrival stamps"),
]

FRAMES = 100
PERIOD_NS = 20 * MS
SIZE = 26
"""SYNC FRAMESIZE IDCODE SOC FRACSEC, STAT (14), one phasor (16), FREQ (20), DFREQ (22), CHK."""
Row = dict[str, Any]
Numbers = Callable[[int], bool]
"""Of frames, by their number in the recording."""


class Copy(NamedTuple):
    """A copy that the ledger says was sent, and what came in its place."""

    row: Row
    at_ns: int
    wire: bytes
    plain: bytes
    """As it would be without faults."""

    @property
    def k(self) -> int:
        return int(self.row["index"])

    @property
    def delay_ms(self) -> float:
        """As the ledger tells it."""
        return sum(float(mark[6:-2]) for mark in self.row["faults"].split(",") if mark.startswith("delay:"))

    @property
    def latency_ms(self) -> float:
        """From when it was due by the recording to its arrival."""
        return (self.at_ns - self.row["time_ns"] - PHASES[self.row["stream"]]) / MS

    @property
    def stream_ms(self) -> float:
        return (self.k * PERIOD_NS + PHASES[self.row["stream"]]) / MS


@dataclass
class Seen:
    """One stream: what the ledger says, what was heard (times on the player's clock)."""

    transport: str
    rows: list[Row]
    heard: Heard
    moved_ns: int
    """By how much the player's UTC was ahead of the kernel's."""
    copies: list[Copy] = field(default_factory=list)
    configs: list[tuple[int, bytes]] = field(default_factory=list)
    """(how many data frames had come before, frame)."""
    rest: bytes = b""
    """What came and belongs to no row."""

    @property
    def numbers(self) -> list[int]:
        return [copy.k for copy in self.copies]

    def fates(self, fate: str) -> list[int]:
        return [row["index"] for row in self.rows if row["fate"] == fate]


Judge = Callable[[Seen], None]


# --- what is to be seen


def only(lost: Numbers, fate: str) -> Judge:
    """Frames that never come, with their fate; all others as they were recorded, in order."""

    def judge(seen: Seen) -> None:
        gone = [k for k in range(FRAMES) if lost(k)]
        assert 0 < len(gone) < FRAMES
        assert seen.numbers == [k for k in range(FRAMES) if not lost(k)]
        assert seen.fates(fate) == gone
        assert all(copy.wire == copy.plain for copy in seen.copies)

    return judge


def some(least: int, most: int) -> Judge:
    """A random part is lost, the one that the ledger names."""

    def judge(seen: Seen) -> None:
        lost = seen.fates("lost")
        assert least <= len(lost) <= most
        assert sorted([*lost, *seen.numbers]) == [*range(FRAMES)]
        assert seen.numbers == sorted(seen.numbers)
        assert all(copy.wire == copy.plain for copy in seen.copies)

    return judge


def spoilt(where: Numbers | None, fits: Callable[[bytes, bytes], bool], *, chk_good: bool) -> Judge:
    """Some frames (None: those that the ledger names) differ as ``fits(wire, plain)`` says; the others do not."""

    def judge(seen: Seen) -> None:
        assert seen.numbers == [*range(FRAMES)]
        touched = [copy for copy in seen.copies if "corrupt" in copy.row["faults"]]
        assert len(touched) > 0
        if where is not None:
            assert [copy.k for copy in touched] == [k for k in range(FRAMES) if where(k)]
        for copy in touched:
            assert copy.wire != copy.plain
            assert fits(copy.wire, copy.plain), (copy.wire.hex(), copy.plain.hex())
            assert good(copy.wire) is chk_good
        assert all(copy.wire == copy.plain for copy in seen.copies if "corrupt" not in copy.row["faults"])

    return judge


def flipped(count: int, first: int = 0, last: int = SIZE - 1) -> Callable[[bytes, bytes], bool]:
    """So many bits, all in the bytes ``first`` to ``last``."""

    def fits(wire: bytes, plain: bytes) -> bool:
        bits = [bin(a ^ b).count("1") for a, b in zip(wire, plain, strict=True)]
        return sum(bits) == sum(bits[first : last + 1]) == count

    return fits


def put(at: int, octets: bytes, *, fit: bool = True) -> Callable[[bytes, bytes], bool]:
    """Other bytes in one place; with ``fit`` the CHK that is right for them."""

    def fits(wire: bytes, plain: bytes) -> bool:
        expected = plain[:at] + octets + plain[at + len(octets) :]
        return wire == (sealed(expected[:-2]) if fit else expected)

    return fits


def restamped(by_us: Callable[[Copy], float]) -> Judge:
    """Stamps moved by some µs; all else as it was."""

    def judge(seen: Seen) -> None:
        assert seen.numbers == [*range(FRAMES)]
        for copy in seen.copies:
            soc, fracsec = struct.unpack(">II", copy.wire[6:14])
            was = struct.unpack(">II", copy.plain[6:14])
            moved = (soc - was[0]) * 10**6 + fracsec - was[1]
            assert moved == pytest.approx(by_us(copy), abs=2)
            assert copy.wire == sealed(copy.plain[:6] + copy.wire[6:14] + copy.plain[14:-2])

    return judge


def repeated_stamps(seen: Seen) -> None:
    for copy in seen.copies:
        last = seen.copies[copy.k - 1] if copy.k % 5 == 2 else copy
        assert copy.wire == sealed(copy.plain[:6] + last.plain[6:14] + copy.plain[14:-2])


def frozen_values(seen: Seen) -> None:
    for copy in seen.copies:
        then = seen.copies[49] if 50 <= copy.k < 60 else copy
        assert copy.wire == sealed(copy.plain[:16] + then.plain[16:-2])


def delayed(low: float, high: float, expected: Callable[[Copy], float] | None = None, spread: float = 0.0) -> Judge:
    """Every frame comes, as late as the ledger says: between ``low`` and ``high`` ms, by number where that decides.

    ``spread`` is by how much delays must differ for the distribution to be one.
    """

    def judge(seen: Seen) -> None:
        assert sorted(seen.numbers) == [*range(FRAMES)]
        delays = [copy.delay_ms for copy in seen.copies]
        assert low <= min(delays)
        assert max(delays) <= high
        assert statistics.pstdev(delays) >= spread
        if expected is not None:
            assert delays == pytest.approx([expected(copy) for copy in seen.copies], abs=1e-3)
        errors = sorted(copy.latency_ms - copy.delay_ms for copy in seen.copies)
        assert errors[0] > -1, "nothing leaves early"
        assert errors[FRAMES // 2] < 8
        assert all(copy.wire == copy.plain for copy in seen.copies)

    return judge


def ramp(copy: Copy) -> float:
    return min(50, max(0, copy.stream_ms / 20 - 25))


def kept_in_order(seen: Seen) -> None:
    assert seen.numbers == [*range(FRAMES)]
    ordered = [max(copy.stream_ms + copy.delay_ms for copy in seen.copies[: n + 1]) for n in range(FRAMES)]
    due = [(copy.row["offset_ns"] - seen.copies[0].row["offset_ns"]) / MS for copy in seen.copies]
    assert due == sorted(due)
    assert len({round(a - b) for a, b in zip(ordered, due, strict=True)}) <= 2


def burst(low: int, high: int) -> Judge:
    """Frames ``low`` to ``high - 1`` come with frame ``high``, at once and in order."""

    def judge(seen: Seen) -> None:
        assert seen.numbers == [*range(FRAMES)]
        together = [copy.at_ns for copy in seen.copies[low : high + 1]]
        assert together[-1] - together[0] < 20 * MS
        assert together[0] - seen.copies[low - 1].at_ns > (high - low) * PERIOD_NS - 10 * MS
        assert ["burst" in copy.row["faults"] for copy in seen.copies] == [low <= k < high for k in range(FRAMES)]
        assert all(copy.wire == copy.plain for copy in seen.copies), "each with its own stamp"

    return judge


def copies(count: Callable[[int], int]) -> Judge:
    def judge(seen: Seen) -> None:
        assert Counter(seen.numbers) == Counter(k for k in range(FRAMES) for _ in range(count(k)))
        assert all(copy.wire == copy.plain for copy in seen.copies)

    return judge


def own_delays(seen: Seen) -> None:
    both = [k for k, count in Counter(seen.numbers).items() if count == 2]
    assert 15 <= len(both) <= 45
    for k in both:
        first, second = (copy for copy in seen.copies if copy.k == k)
        assert abs(first.delay_ms - second.delay_ms) > 1e-4
        assert {first.row["copy"], second.row["copy"]} == {0, 1}


def overtaken(seen: Seen) -> None:
    """``reorder``, late: three others come first, whatever the delays."""
    assert sorted(seen.numbers) == [*range(FRAMES)]
    late = [copy.k for copy in seen.copies if "reorder:3" in copy.row["faults"]]
    assert len(late) >= 5
    for k in late:
        place = seen.numbers.index(k)
        assert sum(other > k for other in seen.numbers[:place]) == 3


def early(seen: Seen) -> None:
    first = [copy for copy in seen.copies if "reorder:early" in copy.row["faults"]]
    assert len(first) >= 5
    assert all(copy.delay_ms == 0 for copy in first)
    assert statistics.median(copy.latency_ms for copy in first) < 10
    assert statistics.median(copy.latency_ms for copy in seen.copies if copy not in first) > 49
    assert seen.numbers != sorted(seen.numbers) == [*range(FRAMES)]


def serialised(seen: Seen) -> None:
    """26 bytes at 8 kbit/s: 26 ms each, more than the 20 ms between them."""
    assert seen.numbers == [*range(FRAMES)]
    gaps = [(b.at_ns - a.at_ns) / MS for a, b in pairwise(seen.copies)]
    assert statistics.median(gaps) == pytest.approx(26, abs=1)
    assert seen.copies[-1].latency_ms > 400


def tail_dropped(seen: Seen) -> None:
    full = [row["index"] for row in seen.rows if row["fate"] == "lost"]
    assert len(full) >= 10
    assert {row["faults"] for row in seen.rows if row["fate"] == "lost"} == {"rate:full"}
    assert seen.numbers == [k for k in range(FRAMES) if k not in full]


def slotted(seen: Seen) -> None:
    """All that is due within 100 ms comes together."""
    assert seen.numbers == [*range(FRAMES)]
    offsets = [copy.row["offset_ns"] for copy in seen.copies]
    assert {offset % (100 * MS) for offset in offsets} == {0}
    gaps = [b.at_ns - a.at_ns for a, b in pairwise(seen.copies)]
    assert sum(gap > 50 * MS for gap in gaps) == len(set(offsets)) - 1


def one_a_slot(seen: Seen) -> None:
    assert seen.numbers == [*range(FRAMES)]
    assert len({copy.row["offset_ns"] for copy in seen.copies}) == FRAMES
    assert statistics.median((b.at_ns - a.at_ns) / MS for a, b in pairwise(seen.copies)) == pytest.approx(25, abs=1)


def hung_up(kind: str) -> Judge:
    """Frames 30 to 49 are not sent; over TCP the connection ends at the first of them, and may be made again."""

    def judge(seen: Seen) -> None:
        assert seen.fates("disabled") == [*range(30, 50)]
        assert all(copy.wire == copy.plain for copy in seen.copies)
        if seen.transport == "udp" or kind == "silence":
            assert seen.numbers == [*range(30), *range(50, FRAMES)]
            assert not seen.heard.when("fin") + seen.heard.when("rst")
            return
        came = seen.numbers
        assert came[:30] == [*range(30)]
        assert came[30:] == [*range(came[30], FRAMES)]
        assert 50 <= came[30] <= 60, "it was there again soon"
        assert seen.fates("skipped") == [*range(50, came[30])], "nobody had started it yet"
        ended = seen.heard.when("fin" if kind == "fin" else "rst")
        silent_ns = seen.copies[29].at_ns + PERIOD_NS
        assert -5 * MS < ended[0] - silent_ns < 50 * MS, "when the first frame failed to come"
        refused = seen.heard.when("refused")
        assert bool(refused) is (kind == "refuse")
        if kind == "refuse":
            back_ns = silent_ns + 20 * PERIOD_NS
            assert silent_ns - 5 * MS < refused[0] < refused[-1] < back_ns + 100 * MS
            assert len(refused) > 10
            assert not [at for at in seen.heard.when("connected") if silent_ns + 20 * MS < at < back_ns - 20 * MS]

    return judge


def at_reads(seen: Seen) -> list[list[int]]:
    """For each copy, the times of the reads that brought its bytes."""
    edges, position = [], 0
    for chunk in seen.heard.chunks:
        edges.append((position, position + len(chunk.data), chunk.at_ns))
        position += len(chunk.data)
    whole = b"".join(chunk.data for chunk in seen.heard.chunks)
    at, found = 0, []
    for copy in seen.copies:
        at = whole.index(copy.wire, at)
        end = at + len(copy.wire)
        found.append([at_ns for low, high, at_ns in edges if low < end and high > at])
        at = end
    return found


def segmented(judge_tcp: Judge) -> Judge:
    """Datagrams are whole and in time; a byte stream is cut as asked."""

    def judge(seen: Seen) -> None:
        if seen.transport == "tcp":
            judge_tcp(seen)
        else:
            assert seen.numbers == [*range(FRAMES)]
        assert all(copy.wire == copy.plain for copy in seen.copies)
        assert any("segment:" in row["faults"] for row in seen.rows)

    return judge


def in_three(seen: Seen) -> None:
    assert seen.numbers == [*range(FRAMES)]
    reads = at_reads(seen)
    cut = [reads[k] for k in range(FRAMES) if k % 5 == 0]
    assert sum(len(times) == 3 for times in cut) >= 0.9 * len(cut)
    assert {len(times) for k, times in enumerate(reads) if k % 5} == {1}
    gaps = [(b - a) / MS for times in cut for a, b in pairwise(times)]
    assert 3.9 < statistics.median(gaps) < 9, "at least; between deadlines the loop looks at its timers every 2 to 4 ms"


def by_fours(seen: Seen) -> None:
    assert seen.numbers == [*range(FRAMES)]
    times = [reads[-1] for reads in at_reads(seen)]
    assert len({*times}) == FRAMES / 4
    for first in range(0, FRAMES, 4):
        assert len({*times[first : first + 4]}) == 1


def stalled(seen: Seen) -> None:
    assert seen.numbers == [*range(FRAMES)]
    times = [reads[-1] for reads in at_reads(seen)]
    assert (times[40] - times[39]) / MS == pytest.approx(220, abs=20)
    assert times[49] - times[40] < 20 * MS, "what was due meanwhile comes with it"
    assert times[55] - times[54] > 10 * MS


def cut_off(seen: Seen) -> None:
    """Half of frame 40, then RST; the client comes back and misses some."""
    came = seen.numbers
    assert came[:40] == [*range(40)]
    assert seen.rest == plain_of(seen.rows[40])[: SIZE // 2]
    assert came[40] in range(41, 50)
    assert seen.fates("failed") == [40]
    assert seen.fates("skipped") == [*range(41, came[40])], "nobody was there"
    assert came[40:] == [*range(came[40], FRAMES)]
    (reset_ns,) = seen.heard.when("rst")
    assert -5 * MS < reset_ns - seen.copies[39].at_ns - PERIOD_NS < 50 * MS


def reconfigured(where: Numbers, grown: int, *, notice: bool, name: str = "", cfgcnt: int = 1) -> Judge:
    """Some frames are ``grown`` bytes longer; a CFG-2 that fits comes before them, or only to who asks."""

    def judge(seen: Seen) -> None:
        assert seen.numbers == [*range(FRAMES)]
        for copy in seen.copies:
            if where(copy.k) and grown:
                body = copy.plain[:2] + struct.pack(">H", SIZE + grown) + copy.plain[4:24] + bytes(grown)
                assert copy.wire == sealed(body)
            else:
                assert copy.wire == copy.plain
        inside = [k for k in range(FRAMES) if where(k)]
        changed = [(at, frame) for at, frame in seen.configs if counter(frame) == cfgcnt and at > 0]
        unasked = [at for at, _ in seen.configs if at in (inside[0], inside[-1] + 1)]
        assert unasked == ([inside[0], inside[-1] + 1] if notice else [])
        answers = [(at, frame) for at, frame in seen.configs if inside[0] < at <= inside[-1]]
        assert len(answers) == 1, "it was asked for once amid the change"
        for _, frame in [*answers, *changed[:1]] if notice else answers:
            assert good(frame)
            assert frame[20:36].decode().rstrip() == (name or seen.rows[0]["stream"])
            assert counter(frame) == cfgcnt
            assert word(frame, 42) == grown // 2, "ANNMR"

    return judge


def counter(config: bytes) -> int:
    """CFGCNT of a one-station CFG-2."""
    return word(config, len(config) - 6)


def announced(seen: Seen) -> None:
    """STAT bit 10 for half a second before the change."""
    stats = [word(copy.wire, 14) & 0x0400 for copy in seen.copies]
    assert [bool(stat) for stat in stats] == [25 <= k < 50 for k in range(FRAMES)]
    assert all(good(copy.wire) for copy in seen.copies)


# --- the table


def every(n: int, offset: int = 0) -> Numbers:
    return lambda k: k % n == offset and k >= offset


def among(low: int, high: int) -> Numbers:
    return lambda k: low <= k < high


def always(k: int) -> bool:
    return True


class Fault(NamedTuple):
    options: str
    """Lines of its section in the profile."""
    sees: Judge
    orders: tuple[str, ...] = ()
    """Lines of the timeline, as in ``0.5 disable {}``."""
    again: bool = False
    """A TCP client that is sent away comes back."""
    asks: tuple[tuple[int, int], ...] = ()
    timed: bool = True
    """Whether over TCP, too, each frame comes when the ledger says: not where its bytes are held back."""


BACK = {"again": True}
ASKING = {"asks": ((61, CFG2),)}
ISO = "2016-09-08T17:05:"
FAULTS: dict[str, Fault] = {
    # which frames
    "index": Fault("drop = 10", only(lambda k: k == 10, "dropped")),
    "index range": Fault("drop = 10,50-59", only(lambda k: k == 10 or 50 <= k < 60, "dropped")),
    "every n": Fault("drop = every 20 offset 3", only(every(20, 3), "dropped")),
    "stamp": Fault(f"drop = stamp {ISO}11.5Z..{ISO}12.25Z", only(among(25, 63), "dropped")),
    "wall time": Fault("drop = wall 0.5..0.9", only(among(25, 45), "dropped")),
    "stream time": Fault("drop = 0.5..0.9", only(among(25, 45), "dropped")),
    "second": Fault("drop = second 12", only(among(50, 100), "dropped")),
    "slot": Fault("drop = slot 0,10-12", only(lambda k: k % 50 in (0, 10, 11, 12), "dropped")),
    "after config": Fault("drop = first after config", only(lambda k: k == 0, "dropped")),
    "value": Fault("drop = value freq_hz >= 60.0695", only(among(70, 100), "dropped")),
    "expression": Fault("drop = not (every 2 or 10-19) and 1..", only(lambda k: k >= 50 and k % 2 == 1, "dropped")),
    "type": Fault("drop = type data and 5-8", only(among(5, 9), "dropped")),
    "probability": Fault("loss = list(0-99) when=30%", some(15, 45)),
    # content
    "bit": Fault("corrupt = 10%", spoilt(None, flipped(1), chk_good=False)),
    "bits": Fault("corrupt = bits(3) when=every 5", spoilt(every(5), flipped(3), chk_good=False)),
    "bits in bytes": Fault("corrupt = bits(2) bytes=14-17", spoilt(always, flipped(2, 14, 17), chk_good=False)),
    "bits in field": Fault("corrupt = bits(1) field=freq", spoilt(always, flipped(1, 20, 21), chk_good=False)),
    "bits, CHK right": Fault(
        "corrupt = bits(1) bytes=16-19 chk=fix",
        spoilt(always, lambda wire, plain: flipped(1, 16, 19)(wire[:-2] + plain[-2:], plain), chk_good=True),
    ),
    "CHK": Fault(
        "corrupt = chk when=every 4", spoilt(every(4), lambda wire, plain: wire[:-2] == plain[:-2], chk_good=False)
    ),
    "CHK 0": Fault("corrupt = chk(0) when=every 4", spoilt(every(4), put(24, b"\0\0", fit=False), chk_good=False)),
    "FRAMESIZE": Fault("corrupt = framesize(20)", spoilt(always, put(2, b"\0\x14", fit=False), chk_good=False)),
    "truncated": Fault(
        "corrupt = truncate(9) when=every 4",
        spoilt(every(4), lambda wire, plain: wire == plain[:9], chk_good=False),
    ),
    "SYNC": Fault("corrupt = sync when=every 4", spoilt(every(4), put(0, b"\xab\x01", fit=False), chk_good=False)),
    "IDCODE": Fault("corrupt = idcode(999)", spoilt(always, put(4, struct.pack(">H", 999)), chk_good=True)),
    "stale stamp": Fault("corrupt = repeat when=every 5 offset 2", repeated_stamps),
    "stamp offset": Fault("corrupt = stamp(offset=-250)", restamped(lambda copy: -250_000)),
    "stamp drift": Fault("corrupt = stamp(drift=1000)", restamped(lambda copy: copy.stream_ms)),
    "leap missed": Fault("corrupt = leap(1)", restamped(lambda copy: 10**6)),
    "leap announced": Fault("corrupt = leap(flags=pending)", spoilt(always, put(10, b"\x10"), chk_good=True)),
    "quality": Fault("corrupt = quality(0x0F)", spoilt(always, put(10, b"\x0f"), chk_good=True)),
    "data error": Fault("corrupt = stat(do_not_use) when=5-9", spoilt(among(5, 10), put(14, b"\xc0\0"), chk_good=True)),
    "PMU sync": Fault("corrupt = stat(not_synchronised)", spoilt(always, put(14, b"\x20\0"), chk_good=True)),
    "sorting": Fault("corrupt = stat(sorted_by_arrival)", spoilt(always, put(14, b"\x10\0"), chk_good=True)),
    "config bit": Fault("corrupt = stat(config_change)", spoilt(always, put(14, b"\x04\0"), chk_good=True)),
    "PMU_TQ": Fault("corrupt = stat(pmu_tq_unknown)", spoilt(always, put(14, b"\x01\xc0"), chk_good=True)),
    "unlocked": Fault("corrupt = stat(unlocked_100s)", spoilt(always, put(14, b"\0\x20"), chk_good=True)),
    "NaN": Fault("corrupt = value(nan) when=5..9,20-29", spoilt(among(20, 30), put(16, b"\x80\0" * 4), chk_good=True)),
    "zero": Fault("corrupt = value(zero) when=20-29", spoilt(among(20, 30), put(16, bytes(8)), chk_good=True)),
    "frozen": Fault("corrupt = value(frozen) when=50-59", frozen_values),
    "config, told": Fault("config = add(2) when=1..1.4", reconfigured(among(50, 70), 4, notice=True), **ASKING),
    "config, untold": Fault(
        "config = add(2) notice=no when=1..1.4", reconfigured(among(50, 70), 4, notice=False), **ASKING
    ),
    "config, CFGCNT kept": Fault(
        "config = add(1) cfgcnt=keep notice=no when=50-69",
        reconfigured(among(50, 70), 2, notice=False, cfgcnt=0),
        **ASKING,
    ),
    "config, renamed": Fault(
        "config = rename(OTHER) when=50-69", reconfigured(among(50, 70), 0, notice=True, name="OTHER"), **ASKING
    ),
    "config, counted": Fault("config = count() when=50-69", reconfigured(among(50, 70), 0, notice=True), **ASKING),
    "config, announced": Fault("config = add(2) announce=0.5 when=1..1.4", announced),
    # gate
    "silence by time": Fault("disable = 0.4..0.8", only(among(20, 40), "disabled")),
    "silence by index": Fault("disable = 30-39", only(among(30, 40), "disabled")),
    "silence by wall": Fault("disable = wall 0.4..0.8", only(among(20, 40), "disabled")),
    "silence by order": Fault("", only(among(25, 50), "disabled"), ("0.5 disable {}", "1 enable {}")),
    "burst by time": Fault("disable = 0.4..0.8 release=burst", burst(20, 40)),
    "burst by order": Fault("", burst(25, 50), ("0.5 disable {} release=burst", "1 enable {}")),
    "silence": Fault("disable = 0.6..1 tcp=silence", hung_up("silence")),
    "FIN": Fault("disable = 0.6..1 tcp=fin", hung_up("fin"), **BACK),
    "RST": Fault("disable = 0.6..1 tcp=rst", hung_up("rst"), **BACK),
    "refused": Fault("disable = 0.6..1 tcp=refuse", hung_up("refuse"), **BACK),
    "refused by order": Fault("", hung_up("refuse"), ("0.6 disable {} tcp=refuse", "1 enable {}"), again=True),
    # loss
    "random": Fault("loss = 20%", some(8, 35)),
    "Gilbert-Elliott": Fault("loss = gemodel(5%, 20%)", some(1, 60)),
    "four states": Fault("loss = state(10%, 40%, 10%, 60%, 2%)", some(1, 60)),
    "on/off": Fault("loss = onoff(0.2, 0.1)", some(1, 90)),
    "periodic": Fault("loss = periodic(0.3, 0.2)", only(lambda k: 20 * k % 500 >= 300, "lost")),
    "every": Fault("loss = every(7, 2)", only(every(7, 2), "lost")),
    "list": Fault("loss = list(3, 5-9)", only(lambda k: k == 3 or 5 <= k <= 9, "lost")),
    "trace": Fault("loss = trace(0, 0, 1)", only(every(3, 2), "lost")),
    # duplicates
    "duplicates": Fault("duplicate = 100% count=2 when=every 10", copies(lambda k: 1 if k % 10 else 3)),
    "delayed duplicates": Fault("duplicate = 30%\ndelay = normal(30, 5)", own_delays),
    # delay
    "constant": Fault("delay = constant(30)", delayed(30, 30, lambda copy: 30)),
    "uniform": Fault("delay = uniform(5, 25)", delayed(5, 25, spread=3)),
    "normal": Fault("delay = normal(30, 5)", delayed(0, 60, spread=2)),
    "truncated normal": Fault("delay = truncnormal(20, 10, 15, 30)", delayed(15, 30, spread=2)),
    "gamma": Fault("delay = gamma(20, 5)", delayed(1, 60, spread=2)),
    "lognormal": Fault("delay = lognormal(20, 5)", delayed(1, 80, spread=2)),
    "Weibull": Fault("delay = weibull(2, 20)", delayed(0, 90, spread=4)),
    "shifted exponential": Fault("delay = exponential(5, shift=10)", delayed(10, 90, spread=2)),
    "Pareto": Fault("delay = pareto(2, 10, max=60)", delayed(10, 60, spread=2)),
    "pareto-normal": Fault("delay = paretonormal(20, 4)", delayed(5, 60, spread=1)),
    "mixture": Fault("delay = mixture(80% constant(10), 20% uniform(40, 50))", delayed(10, 50, spread=5)),
    "sample": Fault("delay = empirical(5, 15, 25)", delayed(5, 25, spread=4)),
    "histogram": Fault("delay = histogram(10, 12, 5, 12, 20, 80)", delayed(10, 20, spread=1)),
    "quantiles": Fault("delay = quantiles(0% 12, 50% 16, 100% 44)", delayed(12, 44, spread=2)),
    "delay trace": Fault("delay = trace(0, 10, 20)", delayed(0, 20, lambda copy: 10 * (copy.k % 3))),
    "step": Fault("delay = step(1, 5, 35)", delayed(5, 35, lambda copy: 5 if copy.k < 50 else 35)),
    "ramp": Fault("delay = ramp(0.5, 1.5, 0, 50)", delayed(0, 50, ramp)),
    "sinusoid": Fault("delay = sinusoid(20, 10, 2)", delayed(9.9, 30.1, spread=5)),
    "diurnal": Fault("delay = diurnal(20, 10, 17)", delayed(29, 30, spread=0)),
    "correlated": Fault("delay = normal(30, 5) corr=80%", delayed(0, 60, spread=1)),
    "some delayed": Fault("delay = 25 when=every 2", delayed(0, 25, lambda copy: 0 if copy.k % 2 else 25)),
    "in order": Fault("delay = uniform(0, 60) order=keep", kept_in_order),
    # order, link
    "late": Fault("reorder = 20% depth=3", overtaken),
    "early": Fault("delay = 50\nreorder = 20% mode=early", early),
    "rate": Fault("rate = 8k", serialised),
    "full queue": Fault("rate = 16k overhead=28 queue=5", tail_dropped),
    "slots": Fault("slot = constant(100)", slotted),
    "one a slot": Fault("slot = constant(25) frames=1", one_a_slot),
    # segmentation
    "split": Fault("segment = split(parts=3, gap=4) when=every 5", segmented(in_three), timed=False),
    "coalesced": Fault("segment = coalesce(frames=4)", segmented(by_fours), timed=False),
    "stalled": Fault("segment = stall(200) when=40", segmented(stalled), timed=False),
    "reset": Fault("segment = reset() when=40", segmented(cut_off), again=True),
}
NAMES = {what: f"R{number:02}" for number, what in enumerate(FAULTS)}
"""Of the streams: no pattern may fit another's."""


# --- one run for all


def profile_text() -> str:
    sections = [f"[stream {NAMES[what]}]\n{fault.options}" for what, fault in FAULTS.items() if fault.options]
    timeline: dict[str, list[str]] = {}
    for what, fault in FAULTS.items():
        for order in fault.orders:
            at, _, verb = order.partition(" ")
            timeline.setdefault(at, []).append(verb.format(NAMES[what]))
    sections += [f"[at {at}]\ndo = " + "\n     ".join(verbs) for at, verbs in timeline.items()]
    return "\n".join(["[run]", "seed = 5", *sections])


PHASES = {name: PERIOD_NS * n // len(NAMES) for n, name in enumerate(NAMES.values())}
"""How long after their stamps the frames of each stream are due: not all at one moment, as no two devices send."""
RECORDED = {
    name: recording(stream(100 + n, name=name), FRAMES, latency_ns=PHASES[name])
    for n, name in enumerate(NAMES.values())
}


def plain_of(row: Row) -> bytes:
    """The row's frame without faults, moved by the whole seconds that the ledger says it was."""
    data = RECORDED[row["stream"]][1 + row["index"]].frame.data
    moved_s, rest_ns = divmod(row["time_ns"] - row["source_time_ns"], NS)
    assert rest_ns == 0
    return sealed(data[:6] + struct.pack(">I", int.from_bytes(data[6:10], "big") + moved_s) + data[10:-2])


class Played(NamedTuple):
    """A run that is over."""

    ears: dict[str, Ear]
    rows: dict[str, list[Row]]
    heard: dict[str, Heard]
    moved_ns: int

    def seen(self, what: str) -> Seen:
        return compared(self.ears[what].scheme, self.rows[NAMES[what]], self.heard[what], self.moved_ns)


def run(transport: str, ledger: Path, *, native: bool = True) -> Played:
    """Play all streams to ears of their own."""
    import pyarrow.parquet as pq

    reel = reel_of(interleaved(*RECORDED.values()))
    clock = EarlyClock(reel.first_due_ns)
    ears = {
        what: Ear(
            what,
            "udp+cmd" if transport == "udp" and fault.asks else transport,
            port,
            100 + number,
            later=fault.asks,
            again=fault.again,
        )
        for number, (port, (what, fault)) in enumerate(zip(free_ports(len(FAULTS)), FAULTS.items(), strict=True))
    }
    unasked = [ear for ear in ears.values() if ear.scheme == "udp"]
    asked = [ear for ear in ears.values() if ear.scheme != "udp"]
    over = threading.Event()
    options = Options(
        to=[parse_endpoint(f"udp://127.0.0.1:{ear.port}?idcode={ear.idcode}") for ear in unasked],
        listen=[parse_endpoint(f"{ear.scheme}://127.0.0.1:0?idcode={ear.idcode}") for ear in asked],
        profile=parse_profile(profile_text(), "faults.ini"),
        cfg_period_ns=0,
    )
    player = Player(as_recorded(reel), options, clock, stop=over.is_set, native=native, stamp_departures=True)
    for place, ear in enumerate(asked, len(unasked)):
        address = player.senders.local(place)
        assert address is not None
        ears[ear.name] = ear._replace(port=address.port)
    with listening(*ears.values()) as heard:
        clock.be_early(reel.first_due_ns, 300 * MS)
        with playing(player, over, LedgerWriter(ledger)):
            pass
    rows = pq.read_table(ledger).to_pylist()
    of: dict[str, list[Row]] = {name: [] for name in NAMES.values()}
    for row in rows:
        of[row["stream"]].append(row)
    return Played(ears, of, heard, clock.moved_ns)


def compared(scheme: str, rows: list[Row], heard: Heard, moved_ns: int) -> Seen:
    """Put what was heard beside the ledger's rows: every byte belongs to one of them, or to a configuration."""
    chunks = [chunk._replace(at_ns=chunk.at_ns + moved_ns) for chunk in heard.chunks]
    events = [(at_ns + moved_ns, kind) for at_ns, kind in heard.events]
    seen = Seen(scheme.removesuffix("+cmd"), rows, Heard(chunks, events), moved_ns)
    sent = [row for row in rows if row["fate"] == "sent" or is_cut_off(row)]
    pieces = list(cut_up(chunks, sent)) if scheme == "tcp" else [(chunk.at_ns, chunk.data) for chunk in chunks]
    for at_ns, piece in pieces:
        if is_config(piece):
            seen.configs.append((len(seen.copies), piece))
        elif sent and is_cut_off(sent[0]):
            sent.pop(0)
            seen.rest += piece
        else:
            assert sent, "more came than the ledger knows"
            row = sent.pop(0)
            assert len(piece) == row["nbytes"]
            seen.copies.append(Copy(row, at_ns, piece, plain_of(row)))
    assert not sent, f"{len(sent)} copies that the ledger says were sent never came"
    events = [event for event in events if event[0] < seen.copies[-1].at_ns]  # then the player ended
    return replace(seen, heard=Heard(chunks, events))


def is_cut_off(row: Row) -> bool:
    """Whether the connection was reset amid the frame: half of it comes, and the ledger does not call it sent."""
    return row["fate"] == "failed" and row["faults"].startswith("segment:reset")


def cut_up(chunks: Sequence[Chunk], sent: Sequence[Row]) -> Iterator[tuple[int, bytes]]:
    """A byte stream by the sizes that the ledger tells; a piece came when its last byte did."""
    octets = b"".join(chunk.data for chunk in chunks)
    ends = [*accumulate(len(chunk.data) for chunk in chunks)]
    sizes = [row["nbytes"] // (2 if is_cut_off(row) else 1) for row in sent]
    at = 0
    while at < len(octets):
        config = next(iter(undisturbed(octets[at : at + 4096])), None)
        size = len(config[1]) if config is not None and is_config(config[1]) else sizes.pop(0)
        at += size
        yield chunks[bisect_left(ends, at)].at_ns, octets[at - size : at]


def is_config(frame: bytes) -> bool:
    return frame[:2] in (b"\xaa\x31", b"\xaa\x52") and good(frame)


@pytest.fixture(scope="module", params=["udp", "tcp"])
def played(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Played:
    """Of three tries at most, the first in which the machine let the player keep its time."""
    for _ in range(3):
        found = run(request.param, tmp_path_factory.mktemp("wire") / "ledger.parquet")
        if median_late_ns(found) < MS:
            break
    return found


def median_late_ns(played: Played) -> float:
    sent = [row for rows in played.rows.values() for row in rows if row["sent_ns"] is not None]
    return statistics.median(row["sent_ns"] - row["scheduled_ns"] for row in sent)


@pytest.mark.parametrize("what", FAULTS)
def test_a_fault_is_seen(played: Played, what: str) -> None:
    FAULTS[what].sees(played.seen(what))


def test_the_ledger_has_every_frame_of_every_stream(played: Played) -> None:
    for what in FAULTS:
        seen = played.seen(what)
        assert {row["index"] for row in seen.rows} == {*range(FRAMES)}
        assert {row["time_ns"] - row["source_time_ns"] for row in seen.rows} == {
            seen.rows[0]["time_ns"] - seen.rows[0]["source_time_ns"]
        }
        assert all((row["sent_ns"] is None) is (row["fate"] != "sent") for row in seen.rows)


def test_frames_come_when_the_ledger_says(played: Played) -> None:
    """One by one after the call that sent them, and at the intervals that were planned."""
    after, apart = [], []
    for what in FAULTS:
        seen = played.seen(what)
        if FAULTS[what].timed or seen.transport == "udp":
            after += [copy.at_ns - copy.row["sent_ns"] for copy in seen.copies]
            apart += [
                abs(b.at_ns - a.at_ns - (b.row["offset_ns"] - a.row["offset_ns"])) for a, b in pairwise(seen.copies)
            ]
    assert len(after) > 7000
    assert min(after) > -20 * MS, "the call ends after the first of many has come"
    for errors in (list(map(abs, after)), apart):
        errors.sort()
        assert errors[len(errors) // 2] < 2 * MS
        assert errors[len(errors) * 9 // 10] < 10 * MS


def test_the_kernel_stamps_every_datagram_between_its_deadline_and_the_end_of_the_call(played: Played) -> None:
    copies = sorted(
        (copy for what in FAULTS for copy in played.seen(what).copies if played.ears[what].scheme.startswith("udp")),
        key=lambda copy: copy.row["tx_stamp_ns"],
    )
    if not copies:
        pytest.skip("TCP has no stamps of departure")
    stamps = [copy.row["tx_stamp_ns"] + played.moved_ns for copy in copies]
    early = sorted(stamp - copy.row["scheduled_ns"] for stamp, copy in zip(stamps, copies, strict=True))
    before = sorted(copy.row["sent_ns"] - stamp for stamp, copy in zip(stamps, copies, strict=True))
    arrived = sorted(copy.at_ns - stamp for stamp, copy in zip(stamps, copies, strict=True))
    for differences in (early, before, arrived):
        assert differences[0] > -MS // 2, "UTC and the monotonic clock are read one after the other"
        assert differences[len(differences) // 2] < 2 * MS
        assert differences[len(differences) * 9 // 10] < 10 * MS
    for what in FAULTS:
        own = [copy.row["tx_stamp_ns"] for copy in played.seen(what).copies]
        assert own == sorted(own)
    unsent = [row for rows in played.rows.values() for row in rows if row["fate"] != "sent"]
    assert {row["tx_stamp_ns"] for row in unsent} == {None}
