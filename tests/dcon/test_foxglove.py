"""The Foxglove layout in the documentation shows topics and fields that a session log really has."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from mcap.reader import make_reader
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from support.sessions import log_configs, log_tick, log_watchdog

from dcon.limiter import MW_PER_V
from dcon.session.codec import Timing, Watchdog
from dcon.session.head import Head
from dcon.session.reader import SessionReader
from dcon.session.rolling import RollingWriter
from dcon.sim.plan import Plan
from dcon.sim.simulate import simulate
from pmutools.schema.messages import MESSAGES

LAYOUT = Path(__file__).parents[2] / "docs" / "foxglove-dcon.json"
PATH = re.compile(r"(?P<topic>/[\w/]+)(?:\.(?P<field>\w+)(?:\[(?P<place>\d+)\])?)?(?:\.@mul\((?P<factor>[\d.]+)\))?")
CONTRACT = [f"/dcon/{name}" for name in ("tick", "instance", "event", "setting", "watchdog", "timing", "pdci")]
NUMBERS = {FieldDescriptorProto.TYPE_DOUBLE, FieldDescriptorProto.TYPE_UINT64, FieldDescriptorProto.TYPE_UINT32}


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A simulated session and, of the same ticks, one in two parts with everything a platform adds."""
    folder = tmp_path_factory.mktemp("foxglove")
    simulate(Plan(duration_s=2), str(folder / "simulated.mcap"))
    reader = SessionReader(folder / "simulated.mcap")
    names = {"pmus": reader.pmus, "instances": reader.instances, "flags": reader.flags}
    head = Head(reader.ini_text, **names)
    with RollingWriter(folder / "live.mcap", head, max_minutes=1 / 60) as log:
        log_configs(log, reader.configs)
        for number, tick in enumerate(reader.ticks()):
            if number % 60 == 0:
                log_watchdog(log, Watchdog(tick.record.tick_ns, True, heartbeats=(("control", 1.0),)))
            log_tick(
                log,
                tick.record,
                tick.frames,
                tick.orders,
                timing=Timing(200.0, 50.0),
                pdci=tick.pdci,
                instances=reader.instances,
            )
    return [folder / "simulated.mcap", *log.parts]


def topics(path: Path) -> dict[str, tuple[Schema, int]]:
    """Schema and number of messages of every topic, by the mcap library's own reader; every message is decoded."""
    found: dict[str, tuple[Schema, int]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, _, proto in reader.iter_decoded_messages():
            assert schema is not None and schema.name == proto.DESCRIPTOR.full_name
            found[channel.topic] = (schema, found.get(channel.topic, (schema, 0))[1] + 1)
        summary = reader.get_summary()
    assert summary is not None and summary.statistics is not None
    announced = {channel.topic: summary.schemas[channel.schema_id] for channel in summary.channels.values()}
    assert found.keys() <= announced.keys()
    assert summary.statistics.message_count == sum(count for _, count in found.values())
    assert {channel.message_encoding for channel in summary.channels.values()} == {"protobuf"}
    assert all(schema.encoding == "protobuf" and schema.data for schema in announced.values())
    return {topic: (schema, found.get(topic, (schema, 0))[1]) for topic, schema in announced.items()}


def test_any_reader_lists_every_topic_with_its_schema(logs: list[Path]) -> None:
    expected = {f"/pmu/{name}/frame" for name in SessionReader(logs[0]).pmus}
    expected |= {message.topic for name, message in MESSAGES.items() if name != "PmuFrame"}
    for path in logs:
        listed = topics(path)
        assert set(listed) == expected, path.name
        assert listed["/dcon/tick"][1] == listed["/dcon/instance"][1] > 50
        for schema, _ in listed.values():
            names = {message.name for message in FileDescriptorSet.FromString(schema.data).file[0].message_type}
            assert schema.name.removeprefix("pmutools.") in names
    live = topics(logs[1])
    assert all(live[topic][1] for topic in CONTRACT)


def panels() -> dict[str, dict[str, Any]]:
    config: dict[str, dict[str, Any]] = json.loads(LAYOUT.read_text("utf-8"))["configById"]
    return config


def paths() -> Iterator[tuple[str, str]]:
    """(kind of panel, message path) of everything that is shown."""
    for name, panel in panels().items():
        for path in panel.get("paths", ()):
            yield name.partition("!")[0], path["value"]
        if "topicPath" in panel:
            yield name.partition("!")[0], panel["topicPath"]


def test_every_path_of_the_layout_is_in_the_log(logs: list[Path]) -> None:
    listed = topics(logs[1])
    reader = SessionReader(logs[1])
    lengths = {"f_hz": len(reader.pmus), "age_ms": len(reader.pmus), "state": len(reader.instances)}
    shown = set()
    for kind, path in paths():
        match = PATH.fullmatch(path)
        assert match, path
        schema, _ = listed[match["topic"]]
        shown.add(match["topic"])
        if match["field"] is None:
            assert kind == "RawMessages"
            continue
        file = FileDescriptorSet.FromString(schema.data).file[0]
        (message,) = [m for m in file.message_type if m.name == schema.name.rpartition(".")[2]]
        (field,) = [field for field in message.field if field.name == match["field"]]
        assert (field.label == FieldDescriptorProto.LABEL_REPEATED) == (match["place"] is not None), path
        assert match["place"] is None or int(match["place"]) < lengths[field.name], path
        assert kind != "Plot" or field.type in NUMBERS, path
        assert match["factor"] is None or float(match["factor"]) == MW_PER_V
    assert shown >= {*CONTRACT, *(topic for topic in listed if topic.startswith("/pmu/"))}


def test_labels_are_those_of_the_controllers_pmus_and_instances(logs: list[Path]) -> None:
    reader = SessionReader(logs[0])
    config = panels()
    assert [path["label"] for path in config["StateTransitions!instances"]["paths"]] == list(reader.instances)
    for panel in ("Plot!frequency", "Plot!filtered", "Plot!age"):
        assert [path["label"] for path in config[panel]["paths"]] == list(reader.pmus)


def leaves(node: Any) -> Iterator[str]:
    if isinstance(node, str):
        yield node
    else:
        assert node["direction"] in ("row", "column") and 0 < node["splitPercentage"] < 100
        yield from leaves(node["first"])
        yield from leaves(node["second"])


def test_every_panel_is_placed_once() -> None:
    layout = json.loads(LAYOUT.read_text("utf-8"))
    placed = list(leaves(layout["layout"]))
    for name in tuple(placed):
        for tab in layout["configById"][name].get("tabs", ()):
            placed += leaves(tab["layout"])
    assert sorted(placed) == sorted(layout["configById"])
