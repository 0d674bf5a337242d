"""Real recordings: what the meters say of devices with quirks."""

from __future__ import annotations

import json
from typing import Any

import pytest
from support.captures import capture_path

from pmutools.formats import open_source
from pmutools.formats.source import Block
from pmutools.measure.clockquality import ClockLog
from pmutools.measure.stream import Identity, StreamMeter
from pmutools.measure.summary import summary


def told(name: str) -> list[dict[str, Any]]:
    meters: dict[tuple[Any, int], StreamMeter] = {}
    for item in open_source(capture_path(name)).blocks():
        if isinstance(item, Block):
            config = item.batch.config
            key = (item.flow, config.idcode)
            if key not in meters:
                meters[key] = StreamMeter(Identity(str(config.idcode), config.idcode, item.flow.transport), config)
            meters[key].add(item.batch)
    found = summary([meter.result() for meter in meters.values()], ClockLog())
    json.dumps(found, allow_nan=False)
    streams: list[dict[str, Any]] = found["streams"]
    return streams


def ids(stream: dict[str, Any]) -> set[str]:
    return {diagnosis["id"] for diagnosis in stream["diagnoses"]}


def test_a_device_that_claims_to_be_locked_and_is_days_behind() -> None:
    (stream,) = told("C37.118_1PMU_TCP.pcap")
    assert (stream["expected"], stream["received"], stream["lost"]) == (252, 252, 0)
    assert stream["delay_ms"]["p50"] / 86_400_000 == pytest.approx(4.79, abs=0.01)
    assert stream["pdv_ms"]["max"] < 40
    assert ids(stream) == {"locked-but-off", "odd-time-base", "trigger-stuck", "idle-scale"}
    assert stream["fit"]["of"] == "pdv"


def test_a_concentrator_over_tcp_that_sends_in_lumps() -> None:
    (stream,) = told("C37.118_4in1PMU_TCP.pcap")
    assert (stream["received"], stream["duplicated"], stream["reordered"]) == (1342, 0, 0)
    assert {"tcp-batching", "uneven-arrival", "pauses", "unmasked-digitals", "zero-scale"} <= ids(stream)


def test_a_concentrator_that_numbers_its_stream_otherwise() -> None:
    (stream,) = told("C37.118_1PMU_UDP.pcap")
    assert ids(stream) == {"locked-but-off", "concentrator", "unmasked-digitals", "idle-scale"}


def test_an_unsynchronised_device_with_usable_values() -> None:
    (stream,) = told("c37_1100_fullclean.pcap")
    assert (stream["expected"], stream["received"]) == (422, 422)
    assert stream["quality"]["time_quality"] == {"F": 1.0}
    assert stream["delay_locked_ms"]["count"] == 0
    assert stream["uncertainty_ms"] is None
    assert stream["per_window"] == {"0": 0, "1": 422, "2+": 0}
    assert ids(stream) == {"unsynchronised", "clock-off", "idle-scale"}
