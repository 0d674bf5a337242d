"""What the words of a characterizer's report mean, and where they are defined. ``docs/metrics.md`` has the formulas."""

from __future__ import annotations

from typing import NamedTuple


class Term(NamedTuple):
    """``anchor`` is its place on the page."""

    anchor: str
    name: str
    source: str
    meaning: str


TERMS = (
    Term(
        "term-slot",
        "Slot",
        "",
        "The reporting instant nearest to a stamp: C37.118 frames have no sequence number.",
    ),
    Term(
        "term-expected",
        "Expected, received, lost",
        "RFC 7680",
        "Slots from the first to the last received one; those for which a frame came within Tmax; those for which "
        "none came. Silence after the last frame is not loss.",
    ),
    Term(
        "term-duplicated",
        "Duplicated",
        "RFC 5560",
        "Copies beyond the first. They are in no delay and no reordering.",
    ),
    Term(
        "term-reordered",
        "Reordered",
        "RFC 4737",
        "Frames whose slot is below one that came before.",
    ),
    Term(
        "term-late",
        "Late",
        "",
        "Frames that came later after their stamp than the concentrator's wait.",
    ),
    Term(
        "term-delay",
        "Delay (stamp to arrival)",
        "RFC 7679",
        "Arrival less stamp: the PMU's estimation, the network, every concentrator's wait, and the receiver's "
        "clock error less the sender's. It is not the network's delay alone. Below zero it is a clock's error, "
        "and kept.",
    ),
    Term(
        "term-percentile",
        "Percentile",
        "RFC 2330",
        "The smallest delay that so many of the frames do not exceed. Of received frames.",
    ),
    Term(
        "term-expected-percentile",
        "Percentile of expected frames",
        "RFC 7679",
        "The same where lost frames rank behind all others, infinitely late: ∞ where that is the answer.",
    ),
    Term(
        "term-uncertainty",
        "± (uncertainty)",
        "OWAMP",
        "Worst case of a delay's error: receiver's clock, sender's clock and the place of the arrival stamp, "
        "added up. It is the same for all delays of a stream, so differences of delays are better than that.",
    ),
    Term(
        "term-ipdv",
        "IPDV",
        "RFC 3393, RFC 5481",
        "Delay of a frame less the delay of the frame one slot before. Offsets of clocks cancel.",
    ),
    Term(
        "term-pdv",
        "PDV",
        "RFC 5481",
        "Delay above the least delay of the last minute: what a concentrator has to wait for.",
    ),
    Term(
        "term-jitter",
        "Jitter",
        "RFC 3550",
        "Running mean of the size of changes of delay, at the last frame. It remembers some 50 frames, so it is "
        "no summary of a run.",
    ),
    Term(
        "term-interarrival",
        "Inter-arrival time",
        "",
        "Time from one arrival to the next. It needs the receiver's clock alone.",
    ),
    Term(
        "term-window",
        "Control window",
        "",
        "A period 1/Fs of UTC. A controller that steps at Fs finds no, one or more frames in each; without one it "
        "holds its last input.",
    ),
    Term(
        "term-completeness",
        "Completeness against wait",
        "IEEE C37.244",
        "Share of what is expected that is there after a wait: from the stamp (absolute), or from the first frame "
        "of that stamp (relative). Of all streams together, a stamp counts when all its frames are there.",
    ),
    Term(
        "term-availability",
        "Availability, completeness",
        "NASPI-2016-TR-002",
        "Received of expected frames; usable of expected frames. Usable: CHK right, STAT data valid, "
        "synchronised, no value absent.",
    ),
    Term(
        "term-locked",
        "Time quality locked",
        "IEEE C37.118.2",
        "Share of frames whose message time quality (MSG_TQ) is 0. Devices that have no clock at all send 0, too.",
    ),
    Term(
        "term-loss-period",
        "Loss period",
        "RFC 3357",
        "A run of lost slots, one after the other.",
    ),
    Term(
        "term-loss-distance",
        "Loss distance",
        "RFC 3357",
        "Slots from one loss to the next; 1 within a loss period. A loss is noticeable where that is 99 or less.",
    ),
    Term(
        "term-burst",
        "Burst",
        "RFC 3611",
        "The longest span from loss to loss with fewer than Gmin = 16 frames received in between; its density is "
        "the share lost within.",
    ),
    Term(
        "term-straggler",
        "Straggler",
        "",
        "The stream whose frame came last, and by how much later than the last but one.",
    ),
    Term(
        "term-budget",
        "Delay budget",
        "Table I of the paper",
        "From a receiver alone, PMU is the floor of the delay, with the least of the network, and Communication "
        "what comes above; Control processing is the wait for the next control window and an assumed time to "
        "compute.",
    ),
    Term(
        "term-ks",
        "KS",
        "",
        "Kolmogorov-Smirnov distance: the largest difference of two distribution functions, 0 to 1.",
    ),
    Term(
        "term-furthest-off",
        "furthest off",
        "",
        "Which of p50, p90, p99, p99.9 and the largest a fit misses most, by what is allowed there, and by how much: "
        "5 % of what lies between p1 and there, or what chance leaves open. KS does not see a tail; this does.",
    ),
)
"""In the order of the page."""
