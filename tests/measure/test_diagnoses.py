"""Each diagnosis: a stream that it must be made of, and ones that it must not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.measured import MS, START_NS, arranged, batch, config, measured, stamps

from pmutools.c37118.config import AnalogChannel, DigitalWord, PhasorChannel
from pmutools.c37118.constants import Format
from pmutools.flow import StampSource
from pmutools.measure.clockquality import ClockLog, ClockQuality, KernelClock
from pmutools.measure.diagnoses import ROWS, diagnose
from pmutools.measure.scene import Peer, Scene, peers_of
from pmutools.measure.stream import Identity, StreamMeter, StreamResult
from pmutools.measure.summary import summary
from pmutools.timebase import NS

RNG = np.random.default_rng(11)
GOOD = KernelClock(0, 0.0, 200, 100, 0x2001)
TCP, MULTICAST = Identity("N1", 101, "tcp"), Identity("N1", 101, "udp", multicast=True)
COUNT = 12_000


def clock(kernel: KernelClock = GOOD, step_ns: int = 0) -> ClockLog:
    log = ClockLog()
    log.add(ClockQuality(kernel))
    if step_ns:
        log.stepped(step_ns)
    return log


def noise(count: int = COUNT, mean_ms: float = 1.0) -> np.ndarray:
    """A floor and a tail above it."""
    return np.random.default_rng(count).exponential(mean_ms, count)


def stream(count: int = COUNT, delay_ms: Any = 44.0, *, rate: int = 60, **options: Any) -> StreamResult:
    keys = ("identity", "end_ns", "wait_ns")
    of_meter = {key: options.pop(key) for key in keys if key in options}
    of = options.pop("of", config(rate))
    instants = options.pop("time_ns", None)
    times = stamps(range(count), rate) if instants is None else instants
    return measured(arranged(batch(times, delay_ms + noise(len(times)), of=of, **options)), **of_meter)


def slots(chosen: Any, **options: Any) -> StreamResult:
    return stream(time_ns=stamps(np.asarray(chosen).tolist()), **options)


def with_events(**counted: Any) -> StreamResult:
    result = stream()
    for name, value in counted.items():
        setattr(result.counts.events, name, value)
    return result


def dropped(datagrams: int) -> StreamResult:
    """300 frames in a row are missing, and the socket dropped so many datagrams."""
    result = slots(np.append(np.arange(6000), np.arange(6300, COUNT)))
    result.counts.events.own_drops = datagrams
    return result


def frozen(repeated: int, after: int = 0) -> StreamResult:
    """600 frames, then one stamp so often, then ``after`` more."""
    instants = [*range(600), *[600] * repeated, *range(600 + repeated, 600 + repeated + after)]
    come = START_NS + np.arange(len(instants)) * NS // 60 + 20 * MS
    times = stamps(instants)
    frames = batch(times, (come - times) / MS, values=np.arange(len(instants)))
    return measured(frames, end_ns=int(come[-1]))


def stepped(by_s: float, count: int = 3600) -> StreamResult:
    """The sender's clock is set in the middle; frames go on at their pace."""
    come = START_NS + np.arange(count) * NS // 60
    times = stamps((np.arange(count) + np.where(np.arange(count) >= count // 2, round(by_s * 60), 0)).tolist())
    return measured(batch(times, (come - times) / MS + 20 + noise(count), values=np.arange(count)))


def peers(*results: StreamResult) -> tuple[Peer, ...]:
    return peers_of(results)


def silent_after(seconds: float) -> StreamResult:
    count = int(seconds * 60)
    return stream(count, identity=MULTICAST, end_ns=START_NS + round((seconds + 120) * NS))


def repeated() -> StreamResult:
    """An inserted leap second, on both clocks: a second of stamps and arrivals comes twice."""
    instants = np.append(np.arange(6000), np.arange(5940, 12_000))
    return measured(batch(stamps(instants.tolist()), 44.0, values=np.arange(12_060), time_quality=0x20))


def leapt(by_s: float = 1.0) -> StreamResult:
    """A leap second that the sender's stamps do not follow for a while."""
    times = stamps(range(COUNT))
    delay = 44 + noise() + np.where((np.arange(COUNT) > 6000) & (np.arange(COUNT) < 6600), by_s * 1000, 0)
    return measured(batch(times, delay))


def nothing(**counted: Any) -> StreamResult:
    meter = StreamMeter(Identity("N1", 101, "udp", where="udp://192.0.2.1:4713"), config())
    for name, value in counted.items():
        setattr(meter.events, name, value)
    return meter.result()


def quirky(**said: Any) -> StreamResult:
    """A stream whose station says something odd."""
    of = config()
    return stream(600, of=replace(of, stations=(replace(of.stations[0], **said),)))


def reconfigured(cfgcnt: int) -> StreamResult:
    """Another phasor from half of the run on."""
    frames = batch(stamps(range(1200)), 44 + noise(1200))
    other = batch(stamps(range(1200, 2400)), 44 + noise(1200), of=config(phasors=2, cfgcnt=cfgcnt))
    return measured([arranged(frames), arranged(other)])


def stored() -> StreamResult:
    """A link that holds frames back for 12 s and then sends them all."""
    delay = 44 + noise()
    held = np.arange(720)
    delay[3000:3720] += (720 - held) * 1000 / 60
    return measured(arranged(batch(stamps(range(COUNT)), delay)))


def smeared() -> StreamResult:
    """A leap second that the receiver's time server spreads over a day, seen for 400 s of it."""
    count = 24_000
    return stream(count, delay_ms=44 + np.arange(count) / 60 * 0.0116, time_quality=0x20)


HEALTHY: dict[str, Scene] = {
    "plain": Scene(stream(), clock()),
    "tcp": Scene(stream(identity=TCP), clock()),
    "some loss": Scene(slots(np.flatnonzero(RNG.random(COUNT) > 0.01)), clock()),
    "some copies": Scene(slots(np.sort(np.append(np.arange(COUNT), np.arange(0, COUNT, 20)))), clock()),
    "heavy tail": Scene(
        measured(arranged(batch(stamps(range(COUNT)), 44 + RNG.pareto(3, COUNT) * 3), )), clock()
    ),
    "slow": Scene(stream(rate=10), clock()),
    "short": Scene(stream(20), clock()),
    "no arrivals": Scene(measured(batch(stamps(range(600)), None)), clock()),
    "a PMU alone at two rates": Scene(stream(), clock(), peers(stream(), stream(rate=30))),
}  # fmt: skip


def at_rates(own: int, delays_ms: dict[int, float]) -> Scene:
    """One stream a rate, of so much delay, and the scene of that at ``own``."""
    results = {rate: stream(1200, ms - 1, rate=rate) for rate, ms in delays_ms.items()}
    return Scene(results[own], clock(), peers(*results.values()))


sawtooth = np.where(np.arange(COUNT) % 2 == 0, 16.0, 0.0)
at_30 = stream(rate=30, delay_ms=1.5 * 1000 / 30)
SICK: dict[str, tuple[Scene, str]] = {
    "receiver-clock": (Scene(stream(), clock(replace(GOOD, status=0x40))), "not disciplined"),
    "receiver-clock set": (Scene(stream(), clock(step_ns=5 * MS)), "set 1 time"),
    "negative-delays": (Scene(stream(delay_ms=-3.0), clock()), "down to -3 ms"),
    "tai-utc": (Scene(stream(delay_ms=-37_000 + 44.0), clock()), "the sender's stamps run on TAI"),
    "tai-utc receiver": (Scene(stream(delay_ms=37_000 + 44.0), clock()), "the receiver's clock"),
    "tai-utc gps": (Scene(stream(delay_ms=-18_000 + 44.0), clock()), "GPS time is 18 s"),
    "locked-but-off": (Scene(stream(delay_ms=4.8 * 86_400_000), clock()), "4.8 days behind"),
    "locked-but-off ahead": (Scene(stream(delay_ms=-29_000), clock()), "29.0 s ahead"),
    "clock-off": (Scene(stream(delay_ms=-8.04 * 3_600_000, time_quality=0xF), clock()), "8.04 h ahead; it says itself"),
    "whole-second": (Scene(stream(delay_ms=-1000 + 21), clock()), "is 1 s ahead of the receiver's"),
    "whole-second behind": (Scene(stream(delay_ms=1000 + 21), clock()), "is 1 s behind the receiver's"),
    "unsynchronised": (Scene(stream(stat=0x21F0, time_quality=0xF), clock()), "100%"),
    "leap-second": (Scene(leapt(), clock()), "2 time(s)"),
    "leap-second repeated": (
        Scene(repeated(), clock()),
        "stamps came twice",
    ),
    "clock-skew": (
        Scene(stream(delay_ms=44 + np.arange(COUNT) / 60 * 0.05), clock()),
        "+50.",
    ),
    "latency-step": (
        Scene(measured(arranged(batch(stamps(range(COUNT)), 44 + noise() + 8.0 * (np.arange(COUNT) > 7000)))), clock()),
        "+8",
    ),
    "about-a-period": (
        Scene(measured(batch(stamps(range(COUNT)), 1000 / 60 + noise(mean_ms=0.1))), clock()),
        "may be a device that waits for its window before it sends, or chance",
    ),
    "about-a-period network": (Scene(stream(delay_ms=15.6), clock(), peers(stream(delay_ms=15.6))), "another rate"),
    "delay-of-a-period": (
        at_rates(60, {10: 102, 30: 1000 / 30 + 2, 60: 1000 / 60 + 2, 120: 1000 / 120 + 2}),
        "1.00 periods and 1.7",
    ),
    "delay-of-a-period everywhere": (
        Scene(stream(delay_ms=1.5 * 1000 / 60), clock(), peers(stream(delay_ms=1.5 * 1000 / 60), at_30)),
        "a third would tell",
    ),
    "stale-frames": (
        Scene(
            measured(
                batch(
                    np.concatenate((stamps([0, 1]) - 63 * 86_400 * NS, stamps(range(600)))),
                    np.concatenate(([63 * 86_400_000.0] * 2, 44 + np.arange(600) % 7 * 0.1)),
                )
            ),
            clock(),
        ),
        "2 frame(s) were stale",
    ),
    "rate-mismatch": (Scene(slots(np.arange(0, COUNT, 2)), clock()), "sends 30/s, its configuration says 60/s"),
    "rate-mismatch faster": (
        Scene(stream(time_ns=stamps(range(COUNT), 100), values=np.arange(COUNT)), clock()),
        "sends about 100 frames/s",
    ),
    "rate-mismatch irregular": (
        Scene(slots(np.cumsum(np.random.default_rng(1).integers(3, 6, 40))), clock()),
        "the device sends about",
    ),
    "rate-mismatch none": (Scene(stream(of=config(0)), clock()), "names no rate"),
    "off-grid": (Scene(stream(time_ns=stamps(range(COUNT)) + RNG.integers(0, 8 * MS, COUNT)), clock()), "%"),
    "two-senders": (Scene(slots(np.repeat(np.arange(COUNT), 2)), clock()), "byte for byte the same"),
    "own-drops": (Scene(with_events(own_drops=96), clock()), "dropped 96 datagrams"),
    "own-drops of some": (Scene(dropped(200), clock()), "up to 200 of the 300 missing frames"),
    "host-stalls": (Scene(with_events(stalls=3, longest_stall_ms=80.0), clock()), "3 time(s), for up to 80 ms"),
    "multicast-ageing": (Scene(silent_after(260), clock()), "silent 260 s"),
    "tcp-batching": (Scene(stream(source=StampSource.KERNEL_BATCHED), clock()), "100%"),
    "tcp-batching bursts": (Scene(stream(identity=TCP, delay_ms=44 + sawtooth), clock()), "Nagle"),
    "coarse-stamps": (
        Scene(measured(batch(stamps(range(0, 60_000, 60)), 20.0 + np.arange(1000) % 5)), clock()),
        "whole multiples of 1 ms",
    ),
    "coarse-stamps base": (Scene(stream(of=replace(config(), time_base=1000)), clock()), "told to 1 ms"),
    "uneven-arrival": (Scene(stream(delay_ms=44 + sawtooth), clock()), "arrival is uneven"),
    "sender-clock-step": (Scene(stepped(5), clock()), "ahead by 5.0 s"),
    "sender-clock-step back": (Scene(stepped(-5), clock()), "back by 5.0 s"),
    "sender-clock-step far": (Scene(stepped(-300), clock()), "back by 5.0 minutes"),
    "leap-second inserted": (Scene(stepped(-1), clock()), "jumped by a whole second 1 time(s)"),
    "leap-smear": (Scene(smeared(), clock()), "smears the leap second"),
    "silent": (Scene(nothing(), clock()), "not a single frame came at udp://192.0.2.1:4713"),
    "silent unconfigured": (Scene(nothing(before_config=7), clock()), "7 data frames came"),
    "silent corrupt": (Scene(nothing(corrupt=7), clock()), "7 frames with a wrong CHK"),
    "stopped": (
        Scene(stream(600, end_ns=START_NS + 20 * NS), clock()),
        "it stopped 10.0 s before the end, and",
    ),
    "corrupt": (Scene(with_events(corrupt=600), clock()), "600 frames (4.76%)"),
    "frozen-stamp": (Scene(frozen(3000), clock()), "3000 frames in a row over 50.0 s"),
    "frozen-stamp for a while": (Scene(frozen(120, 1000), clock()), "120 frames in a row over 2.0 s"),
    "unexpected-rate": (
        Scene(stream(rate=30, identity=Identity("N1", 101, wanted_hz=60)), clock()),
        "60 frames/s are expected",
    ),
    "config-changed": (Scene(reconfigured(cfgcnt=0), clock()), "CFGCNT did not tell"),
    "config-changed counted": (Scene(reconfigured(cfgcnt=1), clock()), "each counted by CFGCNT"),
    "odd-time-base": (Scene(stream(of=replace(config(), time_base=0xFFFFFF)), clock()), "16777215"),
    "trigger-stuck": (Scene(stream(stat=0x0803), clock()), "in 100% of the frames (reason 3)"),
    "concentrator": (Scene(quirky(idcode=61), clock()), "the stream is 101, the PMU in it 61"),
    "unmasked-digitals": (
        Scene(quirky(digitals=(DigitalWord(("",) * 16, valid=0),)), clock()),
        "1 digital word(s) are sent",
    ),
    "zero-scale": (Scene(quirky(format=Format(0)), clock()), "PHUNIT of 1 phasor(s)"),
    "zero-scale analogs": (Scene(quirky(analogs=(AnalogChannel("P", 0x46000000),)), clock()), "ANUNIT of 1 analog(s)"),
    "idle-scale": (Scene(quirky(phasors=(PhasorChannel("V", 756),)), clock()), "PHUNIT of 1 phasor(s) (756)"),
    "idle-scale analogs": (
        Scene(quirky(analogs=(AnalogChannel("P", 5), AnalogChannel("Q", 0))), clock()),
        "ANUNIT of 1 analog(s) (5)",
    ),
    "two-senders at once": (Scene(with_events(senders=2), clock()), "2 senders feed this stream at once"),
    "reconnects": (Scene(with_events(disconnects=2, connects=3), clock()), "2 time(s), and 3 were made"),
    "tcp-losses": (Scene(with_events(out_of_order=50), clock()), "50 segments of TCP came while"),
    "tcp-losses sent": (Scene(with_events(retransmits=50), clock()), "and 50 had to be sent again"),
    "pauses": (Scene(slots(np.append(np.arange(6000), np.arange(6300, COUNT))), clock()), "300 frames in a row"),
    "pauses stored": (Scene(stored(), clock()), "forwards them later"),
    "periodic-delay": (
        Scene(stream(delay_ms=44 + 6 * np.sin(np.arange(COUNT) * 2 * np.pi / 30)), clock()),
        "a period of 0.5 s",
    ),
    "late-frames": (Scene(stream(delay_ms=199.0, wait_ns=200 * MS), clock()), "99.9 %"),
}


@pytest.mark.parametrize("case", SICK)
def test_made_of_what_has_it(case: str) -> None:
    scene, words = SICK[case]
    found = {diagnosis.id: diagnosis.text for diagnosis in diagnose(scene)}
    assert case.split()[0] in found
    assert words in found[case.split()[0]]


@pytest.mark.parametrize("case", HEALTHY)
def test_not_made_of_the_healthy(case: str) -> None:
    assert diagnose(HEALTHY[case]) == []


def test_a_note_is_told_as_one_and_last() -> None:
    of = replace(config(), time_base=0xFFFFFF)
    noted = replace(of, stations=(replace(of.stations[0], phasors=(PhasorChannel("V", 756),)),))
    found = diagnose(Scene(stream(600, of=noted), clock()))
    assert [(diagnosis.id, diagnosis.level) for diagnosis in found] == [
        ("odd-time-base", "finding"),
        ("idle-scale", "note"),
    ]


def test_every_row_has_a_case() -> None:
    ids = [row.id for row in ROWS]
    assert len(set(ids)) == len(ids)
    assert {case.split()[0] for case in SICK} == set(ids)


@pytest.mark.parametrize(
    ("case", "near"),
    [
        ("tai-utc", Scene(stream(delay_ms=-35_000.0), clock())),
        ("leap-second", Scene(leapt(0.8), clock())),
        ("clock-skew", SICK["latency-step"][0]),
        ("clock-skew", Scene(stream(delay_ms=44 + np.arange(COUNT) / 60 * 0.0005), clock())),
        ("latency-step", SICK["clock-skew"][0]),
        ("delay-of-a-period", Scene(stream(delay_ms=44.0), clock(), peers(stream(), stream(rate=30)))),
        ("delay-of-a-period", at_rates(50, dict.fromkeys((10, 50, 60, 100), 20.0))),
        ("about-a-period", at_rates(50, dict.fromkeys((10, 50, 60, 100), 20.0))),
        ("delay-of-a-period", at_rates(60, {10: 100, 30: 33.3, 60: 40, 120: 8.3})),
        ("delay-of-a-period", at_rates(60, {30: 61, 60: 44})),  # two that differ, as two networks do
        ("delay-of-a-period", at_rates(60, {10: 77, 30: 30.3, 60: 18.7})),  # of no window
        ("delay-of-a-period", Scene(stream(delay_ms=15.6), clock(), peers(stream(delay_ms=15.6)))),
        ("about-a-period", Scene(stream(delay_ms=17 + 9 * np.sin(np.arange(COUNT))), clock())),
        ("rate-mismatch", Scene(slots(np.flatnonzero(RNG.random(COUNT) > 0.4)), clock())),
        ("two-senders", SICK["rate-mismatch faster"][0]),
        ("multicast-ageing", Scene(silent_after(60), clock())),
        ("multicast-ageing", Scene(stream(260 * 60, end_ns=START_NS + 400 * NS), clock())),
        ("tcp-batching", Scene(stream(delay_ms=44 + sawtooth), clock())),
        ("uneven-arrival", Scene(slots(np.flatnonzero(RNG.random(COUNT) > 0.1)), clock())),
        ("locked-but-off", Scene(stream(delay_ms=4.8 * 86_400_000, time_quality=0xF), clock())),
        ("locked-but-off", SICK["tai-utc"][0]),
        ("unsynchronised", Scene(stream(stat=0x0800), clock())),
        ("leap-smear", SICK["clock-skew"][0]),
        ("leap-smear", SICK["leap-second repeated"][0]),
        ("unexpected-rate", Scene(stream(identity=Identity("N1", 101, wanted_hz=60)), clock())),
        (
            "config-changed",
            Scene(measured([batch(stamps(range(9))), batch(stamps(range(9, 99)), of=config())]), clock()),
        ),
        ("trigger-stuck", Scene(stream(stat=np.where(np.arange(COUNT) < 600, 0x0800, 0)), clock())),
        ("concentrator", SICK["odd-time-base"][0]),
        ("zero-scale", Scene(quirky(analogs=(AnalogChannel("P", 0),)), clock())),
        ("zero-scale", Scene(quirky(format=Format(0), phasors=(PhasorChannel("V", 100),)), clock())),
        ("idle-scale", Scene(quirky(format=Format(0), phasors=(PhasorChannel("V", 756),)), clock())),
        ("idle-scale", Scene(quirky(analogs=(AnalogChannel("P", 1),)), clock())),
        ("idle-scale", Scene(quirky(format=Format(2), analogs=(AnalogChannel("P", 5),)), clock())),
        ("tcp-losses", Scene(with_events(retransmits=3), clock())),
        ("two-senders", Scene(with_events(senders=1), clock())),
        ("reconnects", Scene(with_events(connects=1), clock())),
        ("pauses", Scene(slots(np.append(np.arange(6000), np.arange(6030, COUNT))), clock())),
        ("pauses", Scene(dropped(300), clock())),
        ("stopped", Scene(stream(600, end_ns=START_NS + 12 * NS), clock())),
        ("stopped", Scene(frozen(3000), clock())),
        ("clock-off", Scene(stream(time_quality=0xF), clock())),
        ("clock-off", SICK["locked-but-off"][0]),
        ("whole-second", Scene(stream(delay_ms=600.0), clock())),
        ("whole-second", Scene(stream(delay_ms=-100.0), clock())),
        ("whole-second", Scene(stream(delay_ms=20 + noise(mean_ms=1500.0)), clock())),
        ("late-frames", Scene(stream(delay_ms=1021.0), clock())),
        ("late-frames", Scene(stream(delay_ms=6021.0, time_quality=0xF), clock())),
        ("corrupt", Scene(with_events(corrupt=5), clock())),
        ("frozen-stamp", Scene(frozen(4, 1000), clock())),
        ("frozen-stamp", Scene(slots(np.sort(np.append(np.arange(COUNT), [500] * 20))), clock())),
        ("pauses", Scene(frozen(120, 1000), clock())),
        *((row, Scene(stepped(5), clock())) for row in ("pauses", "latency-step", "late-frames")),
        *((row, Scene(stepped(-5), clock())) for row in ("two-senders", "latency-step", "late-frames")),
        *((row, Scene(stepped(-1), clock())) for row in ("sender-clock-step", "latency-step", "late-frames")),
        ("sender-clock-step", SICK["pauses"][0]),
        ("sender-clock-step", SICK["pauses stored"][0]),
        ("sender-clock-step", Scene(leapt(5), clock())),
        ("sender-clock-step", SICK["stale-frames"][0]),
        ("periodic-delay", Scene(stream(delay_ms=44 + 0.3 * np.sin(np.arange(COUNT) * 2 * np.pi / 30)), clock())),
    ],
)
def test_not_made_of_what_is_only_near(case: str, near: Scene) -> None:
    assert case not in {diagnosis.id for diagnosis in diagnose(near)}


def skew_ppm(result: StreamResult) -> float | None:
    (told,) = summary([result], clock(), may_fit=lambda: False)["streams"]
    found: float | None = told["skew_ppm"]
    return found


def test_skew_is_a_line_s_and_nothing_else_s() -> None:
    count = 18_000 + 3  # ends with a few frames of a stretch of their own
    assert skew_ppm(stream(count, delay_ms=44 + np.arange(count) / 60 * 0.05)) == pytest.approx(50, abs=0.1)
    ragged = np.where(np.arange(count) >= 18_000, 60.0, 44.0)
    assert skew_ppm(stream(count, delay_ms=ragged)) == pytest.approx(0, abs=0.1)
    for result in (stepped(5), stepped(-1), SICK["latency-step"][0].result):
        assert skew_ppm(result) is None
