"""What may be done about findings of :mod:`pmutools.measure.diagnoses`, by id, beyond what their sentences say."""

from __future__ import annotations

REMEDIES = {
    "receiver-clock": "discipline the receiver's clock (chrony, PTP, GPS); till then trust differences of delays only",
    "negative-delays": "compare both clocks with UTC: the receiver's sources of time, lock and antenna at the sender",
    "tai-utc": "set the UTC offset where the stamps are made: the PMU's clock settings, or phc2sys -O at the receiver",
    "locked-but-off": "check date and GPS week of the sender's clock, and the receiver's date; do not trust MSG_TQ",
    "unsynchronised": "look to the sender's clock: its antenna, its cable, its holdover",
    "leap-second": "measure again away from the leap second",
    "leap-smear": "take time from servers that do not smear, or measure again a day later",
    "clock-skew": "discipline both clocks; PDV and inter-arrival times hold meanwhile",
    "latency-step": "look what was changed at that time: routes, filters (P or M class), clocks",
    "delay-of-a-period": "ask the vendor for the reporting latency; a higher rate, or P class filters, shorten it",
    "reconnects": "look into the log for when, and at the sender for why",
    "tcp-losses": "look for the lossy link on the path; over UDP a loss delays no other frame",
    "pauses": "look into the sender's and the network's logs at that time",
    "periodic-delay": "look for what runs at this period: polling, schedulers, resampling concentrators",
    "stale-frames": "none is needed if they come at the start only; else look for what stores frames on the way",
    "stopped": "look to the sender and its link; the log says when it fell silent",
    "frozen-stamp": "restart the sender, and look to its source of time; use none of these values",
    "rate-mismatch": "make DATA_RATE of the configuration and the device's setting agree",
    "unexpected-rate": "correct the initialisation file, or the device",
    "config-changed": "restart what keeps the old configuration; find out who changes the device's settings",
    "off-grid": "have the device stamp reporting instants, or correct its rate",
    "two-senders": "find the second sender by its address; give each stream its own IDCODE",
    "host-stalls": "measure on a quieter machine, with a core of its own, or by kernel stamps",
    "coarse-stamps": "a larger TIME_BASE, or a source that keeps arrivals to the microsecond",
    "tcp-batching": "UDP, or TCP_NODELAY at the sender, or a capture on the wire",
    "uneven-arrival": "hold the last input for a window, or step later; ask the vendor for even departures",
    "late-frames": "let the concentrator wait longer, or shorten the way",
    "concentrator": "measure at the PMU too, if its own delay matters",
}
