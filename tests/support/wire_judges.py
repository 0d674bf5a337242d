"""What a receiver must have seen of a stream with a fault: a judge for each, by the ledger and by the recording."""

from __future__ import annotations

import statistics
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import pytest
from support.ear import Heard, good, sealed, word
from support.playing import MS

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
    phase_ns: int
    """How long after its stamp a frame of the stream is due."""

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
        return (self.at_ns - self.row["time_ns"] - self.phase_ns) / MS

    @property
    def stream_ms(self) -> float:
        return (self.k * PERIOD_NS + self.phase_ns) / MS


@dataclass
class Seen:
    """One stream: what the ledger says, what was heard (times on the player's clock)."""

    transport: str
    rows: list[Row]
    heard: Heard
    moved_ns: int
    """By how much the player's UTC was ahead of the kernel's."""
    plain_of: Callable[[Row], bytes]
    """A row's frame without faults."""
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
    assert seen.rest == seen.plain_of(seen.rows[40])[: SIZE // 2]
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


def every(n: int, offset: int = 0) -> Numbers:
    return lambda k: k % n == offset and k >= offset


def among(low: int, high: int) -> Numbers:
    return lambda k: low <= k < high


def always(k: int) -> bool:
    return True
