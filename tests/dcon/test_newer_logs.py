"""Logs of a newer program: what is known is read, and the rest is said, once, in words and in JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from mcap.reader import make_reader
from mcap.writer import Writer

import pmutools
from dcon.cli import dcon
from dcon.sim.plan import Plan
from dcon.sim.simulate import simulate
from pmutools.cli.shell import run
from pmutools.schema.descriptors import file_descriptor_set

Capsys = pytest.CaptureFixture[str]
COMMANDS = {"replay": [], "export": ["t.csv"], "analyze": ["--out", "report"]}
FIELD = b"\xa0\x06\x07"
"""Field 100, varint 7."""


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("session") / "session.mcap"
    simulate(Plan("ambient", duration_s=2.0), str(path))
    return path


def rewritten(
    session: Path,
    path: Path,
    *,
    version: str = "",
    topics: tuple[str, ...] = (),
    named: bool = False,
    field: bytes = b"",
) -> Path:
    """``session`` as a newer program would have written it; ``named`` has the schemas know of field 100."""
    descriptors = FileDescriptorSet.FromString(file_descriptor_set())
    if named:
        (tick,) = (message for message in descriptors.file[0].message_type if message.name == "Tick")
        kind, label = FieldDescriptorProto.TYPE_INT64, FieldDescriptorProto.LABEL_OPTIONAL
        tick.field.add(name="mood", number=100, type=kind, label=label)
    with session.open("rb") as source, path.open("wb") as target:
        reader, writer = make_reader(source), Writer(target)
        writer.start()
        for metadata in reader.iter_metadata():
            values = dict(metadata.metadata) | ({"version": version} if version else {})
            writer.add_metadata(metadata.name, values)
        for item in reader.iter_attachments():
            writer.add_attachment(item.create_time, item.log_time, item.name, item.media_type, item.data)
        channels: dict[str, int] = {}

        def channel(topic: str, name: str, metadata: dict[str, str]) -> int:
            if topic not in channels:
                schema = writer.register_schema(name, "protobuf", descriptors.SerializeToString())
                channels[topic] = writer.register_channel(topic, "protobuf", schema, metadata)
            return channels[topic]

        for topic in topics:
            writer.add_message(channel(topic, "pmutools.Future", {}), 0, b"", 0)
        for schema, of, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            data = message.data + (field if schema.name == "pmutools.Tick" else b"")
            number = channel(of.topic, schema.name, dict(of.metadata))
            writer.add_message(number, message.log_time, data, message.publish_time)
        writer.finish()
    return path


def told(capsys: Capsys, command: str, path: Path, *more: str) -> tuple[int, str, str]:
    code = run(dcon(), [command, str(path), *COMMANDS[command], *more])
    return code, *capsys.readouterr()


NEWER = {
    "a version": (
        {"version": "99.0.1"},
        "written by version 99.0.1",
        {"version": "99.0.1", "topics": [], "fields": []},
    ),
    "topics": (
        {"topics": ("/dcon/future", "/dcon/fate")},
        "topics /dcon/fate, /dcon/future",
        {"version": None, "topics": ["/dcon/fate", "/dcon/future"], "fields": []},
    ),
    "a field that its schema names": (
        {"named": True, "field": FIELD},
        "fields Tick.mood",
        {"version": None, "topics": [], "fields": ["Tick.mood"]},
    ),
    "all at once": (
        {"version": "1.0", "topics": ("/dcon/future",), "named": True, "field": FIELD},
        "written by version 1.0; topics /dcon/future; fields Tick.mood",
        {"version": "1.0", "topics": ["/dcon/future"], "fields": ["Tick.mood"]},
    ),
}


@pytest.mark.parametrize(
    ("command", "case"),
    [*((command, case) for command in ("replay", "export") for case in NEWER), ("analyze", "all at once")],
)
def test_what_is_not_known_is_said_and_the_rest_is_read(
    command: str,
    case: str,
    session: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Capsys,
) -> None:
    made, said, keys = NEWER[case]
    monkeypatch.chdir(tmp_path)
    path = rewritten(session, tmp_path / "newer.mcap", **made)
    code, out, err = told(capsys, command, path, "--json")
    warning = f"warning: {path} holds what version {pmutools.__version__} does not know ({said}); the rest is read"
    assert code == 0 and err.count("warning: ") == 1 and warning in err.splitlines()
    found = json.loads(out)
    assert found["newer"] == ([{"files": [str(path)], **keys}] if command == "analyze" else keys)
    if command == "analyze":
        assert json.loads(Path("report/analysis.json").read_text())["newer"] == found["newer"]
        assert said in Path("report/report.html").read_text()
    if command == "replay":
        assert (found["ticks"], found["different"], found["stopped"]) == (120, 0, None)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_field_that_no_schema_names(
    command: str, session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    path = rewritten(session, tmp_path / "newer.mcap", field=FIELD)
    code, _, err = told(capsys, command, path)
    assert code == 0 and "does not know (fields Tick.100); the rest is read" in err


@pytest.mark.parametrize(
    ("command", "version"),
    [
        *(("export", version) for version in (pmutools.__version__, "0.0.9", "of the day")),
        ("replay", ""),
        ("analyze", ""),
    ],
)
def test_nothing_is_said_of_a_log_that_is_not_newer(
    command: str, version: str, session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    path = rewritten(session, tmp_path / "log.mcap", version=version)
    code, out, err = told(capsys, command, path, "--json")
    assert code == 0 and "warning" not in err and not json.loads(out)["newer"]
