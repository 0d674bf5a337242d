"""Measured, exported, played and measured again: the same network."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq
import pytest
from scipy.stats import ks_2samp
from support.commands import run_here
from support.playing import MS, play, recording, stream
from support.recordings import write

from pmutools.c37118 import Frame, Message
from pmutools.flow import StampSource
from pmutools.impair.profile import read_profile_file
from pmutools.measure.histogram import Histogram
from pmutools.measure.likeness import allowed

COUNT = 1200
RNG = np.random.default_rng(7)
Floats = npt.NDArray[np.float64]


def correlated(correlation: float) -> Floats:
    """Delays in ms of which each is like the one before."""
    z = np.empty(COUNT)
    last = 0.0
    for at, fresh in enumerate(RNG.normal(size=COUNT)):
        last = z[at] = correlation * last + np.sqrt(1 - correlation**2) * fresh
    return 40 + 3 * z


NETWORKS: dict[str, Floats] = {
    "normal": 44 + 1.3 * RNG.normal(size=COUNT),
    "gamma": 15 + RNG.gamma(2.0, 2.0, COUNT),
    "lognormal": 10 + RNG.lognormal(1.0, 0.6, COUNT),
    "two routes": np.where(RNG.random(COUNT) < 0.3, 60.0, 40.0) + RNG.normal(0, 0.8, COUNT),
    "correlated": correlated(0.8),
    "late": 40 + 1.3 * RNG.normal(size=COUNT) + 30 * (np.arange(COUNT) % 40 == 7),
}
"""Delays of the first transmissions."""


def histogram(delays: Floats) -> Histogram:
    return Histogram(np.rint(delays * MS).astype(np.int64))


def characterized(path: Path, out: Path, *options: object) -> tuple[dict[str, Any], Floats]:
    """A stream's summary, and its delays in ms."""
    result = run_here("characterize", path, "--out", out, "--no-report", "--json", "--quiet", *options)
    assert result.code == 0, result.err
    (found,) = json.loads(result.out)["streams"]
    table = pq.read_table(out / "samples.parquet", columns=["delay_ns", "state"])
    delays = table["delay_ns"].drop_null().to_numpy() / MS
    return found, delays


@pytest.mark.parametrize(("network", "exact"), [*((name, False) for name in NETWORKS), ("gamma", True)])
def test_the_same_distribution_losses_and_correlation(network: str, exact: bool, tmp_path: Path) -> None:
    delays = NETWORKS[network]
    messages = recording(stream(), COUNT, latency_ns=lambda k: round(delays[k] * MS))
    lost = np.zeros(COUNT, bool)
    for at in RNG.integers(1, COUNT - 10, 20):
        lost[at : at + int(RNG.integers(1, 4))] = True
    kept = [message for k, message in enumerate(messages) if not k or not lost[k - 1]]
    arrived = sorted(kept, key=lambda message: message.frame.arrival_ns or 0)
    write(tmp_path / "network.pcap", arrived)
    options = ["--export-profile", tmp_path / "measured.ini", *["--exact-profile"] * exact]
    before, first = characterized(tmp_path / "network.pcap", tmp_path / "a", *options)

    profile = read_profile_file(tmp_path / "measured.ini")
    played = play(recording(stream(), COUNT), timing="stamp", profile=profile, seed=5)
    config = played.reel.tracks[0].config
    again = [messages[0]]
    for sent in played.data:
        frame = Frame(sent.frame, played.began_ns + sent.at_ns, StampSource.KERNEL, 0)
        again.append(Message(frame, messages[0].flow, config))
    write(tmp_path / "again.pcap", again)
    after, second = characterized(tmp_path / "again.pcap", tmp_path / "b")

    assert ks_2samp(first, second).pvalue > 0.001
    assert abs(np.median(first) - np.median(second)) < 0.5
    for held, found in zip(*(allowed(histogram(each)) for each in (first, second)), strict=True):
        assert held.low <= found.high and found.low <= held.high, held.at
    losses = [found["lost"] / found["expected"] for found in (before, after)]
    assert losses[1] == pytest.approx(losses[0], rel=0.6)
    assert after["loss_runs"]["mean"] == pytest.approx(before["loss_runs"]["mean"], rel=0.4)
    assert after["delay_correlation"] == pytest.approx(before["delay_correlation"], abs=0.1)
    if not before["reordered"]:
        assert not after["reordered"]
