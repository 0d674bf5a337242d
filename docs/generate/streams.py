"""Tables of the codec, the formats, the live end points and the log schema."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import fields
from enum import StrEnum
from types import SimpleNamespace
from typing import Any

from dcon.export.tables import TABLES
from generate.markdown import attribute_docs, code, fenced, first_sentence, mermaid, prose, table
from generate.structure import ROOT, constant
from pmutools.c37118.batch import Batch
from pmutools.c37118.config import PhasorChannel, Station, StationDetails, StreamConfig
from pmutools.c37118.constants import TimeQuality, command_name, time_quality_error_ns
from pmutools.c37118.framer import SkipReason
from pmutools.c37118.session import CLIENT_TABLES, SERVER, ClientEvent, ClientState, ClientTable, Outcome, transitions
from pmutools.flow import StampSource
from pmutools.formats import COMPRESSIONS, FORMATS
from pmutools.impair.outgoing import UNREPEATABLE, Fate, LedgerRow
from pmutools.net.dialogue import LinkKind
from pmutools.schema.messages import MESSAGES

WORDS = {
    SkipReason.NO_SYNC: "Bytes before the next SYNC.",
    SkipReason.BAD_TYPE: "0xAA followed by a frame type or version that there is not.",
    SkipReason.BAD_SIZE: "FRAMESIZE below 16 (18 for a command), or so large that it would hide proven frames.",
    SkipReason.BAD_CHK: "All there, but CHK does not hold.",
    SkipReason.TRUNCATED: "The input ends inside a frame.",
    StampSource.HARDWARE: "By the network card.",
    StampSource.KERNEL: "By the kernel, at the socket.",
    StampSource.USER: "By the program, after the system call.",
    StampSource.CAPTURE: "As the file says.",
    LinkKind.BOUND: "The socket is open.",
    LinkKind.CONNECTED: "The connection stands.",
    LinkKind.STREAMING: "Data have begun to come.",
    Outcome.STARTED: "Data go to this client from now on.",
    Outcome.STOPPED: "Data go to this client no longer.",
    Outcome.ANSWERED: "The frame asked for is sent back.",
    Outcome.UNKNOWN: "A code that the standard does not define, or leaves to users: silence.",
    Fate.SENT: "It left.",
    Fate.DISABLED: "By `disable`, or by the operator's switch.",
}
"""Members whose names say enough in code; every member has words either there or here."""


def members(kind: type[StrEnum], title: str) -> str:
    """The members of an enumeration, each with the words below it."""
    says = attribute_docs(kind)
    return table((title, "meaning"), ((code(item.value), says.get(item.name) or WORDS[item]) for item in kind))


def formats() -> str:
    """One row a file format."""
    rows = []
    for form in FORMATS:
        packed = " ".join(code(suffix) for suffix in COMPRESSIONS) if form.compressible else ""
        magics = " ".join(code(magic.hex(" ")) for magic in form.magics[:3]) + (" ..." if len(form.magics) > 3 else "")
        suffixes = " ".join(code(suffix) for suffix in form.suffixes)
        rows.append((form.kind, suffixes, packed, "yes" if form.written else "no", magics or "by suffix"))
    return table(("format", "suffix", "may be followed by", "written", "told by its first bytes"), rows)


def _name(event: ClientEvent) -> str:
    return str(event.value)


def _ends_everywhere(of: ClientTable) -> set[ClientEvent]:
    """Events that lead from every state but IDLE to IDLE: drawn they would hide all others."""
    busy = {state for state, _ in of} - {ClientState.IDLE}
    return {
        event for event in ClientEvent if all(getattr(of.get((s, event)), "state", 0) is ClientState.IDLE for s in busy)
    }


def client_diagram(name: str) -> str:
    """A client table as a state diagram, with the ways out of it in words."""
    of, labels = CLIENT_TABLES[name], defaultdict[tuple[str, str], list[str]](list)
    everywhere = _ends_everywhere(of)
    for state, event, step in transitions(of):
        if event not in everywhere:
            actions = ", ".join(action.value for action in step.actions)
            labels[state.name, step.state.name].append(_name(event) + (f" / {actions}" if actions else ""))
    lines = ["stateDiagram-v2", *(["    direction LR"] if len(labels) < 6 else []), "    [*] --> IDLE"]
    lines += [f"    {a} --> {b}: {'<br>'.join(texts)}" for (a, b), texts in labels.items()]
    words = " and ".join(code(_name(event)) for event in ClientEvent if event in everywhere)
    return f"{mermaid(lines)}\n\n{words} lead from every state to IDLE."


def client_tables() -> str:
    """All client tables: what each state does with each event."""
    parts = []
    for name, of in CLIENT_TABLES.items():
        rows = (
            (
                code(state.name),
                code(_name(event)),
                code(step.state.name),
                ", ".join(code(a.value) for a in step.actions),
            )
            for state, event, step in transitions(of)
        )
        parts.append(f"**{name}**\n\n" + table(("state", "event", "next state", "actions"), rows))
    return "\n\n".join(parts)


def server_table() -> str:
    """What a server does with each command."""
    rows = {}
    for (before, command), reply in SERVER.items():
        answer = f"{reply.frame.name} frame" if reply.frame is not None else "nothing"
        does = "" if reply.state is before else f"the stream is {reply.state.value} for this client"
        rows[command] = (
            code(f"{command.value:#06x}"),
            command_name(command),
            answer,
            rows.get(command, ("",) * 4)[3] or does,
        )
    return table(("CMD", "command", "sent back", "effect"), rows.values())


def time_quality() -> str:
    """MSG_TQ."""
    rows = []
    for item in TimeQuality:
        error_ns = time_quality_error_ns(item)
        rows.append((code(f"{item:X}"), item.name.lower(), "unknown" if error_ns is None else f"{error_ns:,} ns"))
    return table(("MSG_TQ", "name", "worst-case error"), rows)


def batch_columns() -> str:
    """The columns of a batch, with their element types."""
    kinds = {item.name: str(item.type) for item in fields(Batch)}
    rows = []
    for name, text in attribute_docs(Batch).items():
        kind = kinds[name].partition("[np.")[2].partition("]")[0].rstrip("_")
        rows.append((code(name), kind, text))
    return table(("column", "type", "holds"), rows)


def config_classes() -> str:
    """The configuration's classes by their docstrings."""
    rows = (
        (code(cls.__name__), first_sentence(cls.__doc__))
        for cls in (StreamConfig, Station, PhasorChannel, StationDetails)
    )
    return table(("class", "holds"), rows)


def topics() -> str:
    """Every message of a session log and its fields."""
    parts = []
    for name, message in MESSAGES.items():
        rows = (
            (number, code(field.name), f"{field.type}{'[]' if field.repeated else ''}", field.unit, field.doc)
            for number, field in enumerate(message.fields, 1)
        )
        parts.append(
            f"### `{message.topic}`\n\n`pmutools.{name}`: {message.doc}\n\n"
            + table(("no.", "field", "type", "unit", "holds"), rows)
        )
    return "\n\n".join(parts)


def export_tables() -> str:
    """Columns of ``dcon export``."""
    session: Any = SimpleNamespace(pmus=("NAME",), instances=())
    parts = []
    for name, of in TABLES.items():
        columns = (
            f"{column.name} {column.type}{'' if column.nullable else ', never null'}" for column in of.columns(session)
        )
        parts.append(f"`--table {name}`\n\n" + fenced("\n".join(columns)))
    return "\n\n".join(parts)


LEDGER_WORDS = {
    "stream": "Name of the stream.",
    "index": "Zero-based, among the stream's data frames, over the source and its loops.",
    "copy": "0 for the frame itself, 1, 2 ... for duplicates.",
    "scheduled_ns": "When it was to leave, POSIX UTC.",
    "sent_ns": "When it left, POSIX UTC; null if it never did.",
    "tx_stamp_ns": "The kernel's stamp of its leaving, where there is one.",
    "fate": "What became of it, see above.",
    "faults": "What was done to it, as in `delay:12.3ms,corrupt:1bit`.",
    "nbytes": "Length on the wire.",
}


def ledger() -> str:
    """Columns of the player's ledger."""
    says = LEDGER_WORDS | attribute_docs(LedgerRow)
    rows = ((code(name), says[name], "no" if name in UNREPEATABLE else "yes") for name in LedgerRow._fields)
    return table(("column", "holds", "the same in every run"), rows)


def oracle_faults() -> str:
    """Where the tests know tshark to be wrong."""
    faults = constant(ROOT / "tests" / "support" / "oracle" / "faults.py", "FAULTS")
    return "\n".join(f"- {prose(text)}" for text in faults.values())


GENERATORS = {
    "oracle-faults": oracle_faults,
    "formats": formats,
    "skip-reasons": lambda: members(SkipReason, "reason"),
    "stamp-sources": lambda: members(StampSource, "stamp source"),
    "link-events": lambda: members(LinkKind, "event"),
    "server-outcomes": lambda: members(Outcome, "outcome"),
    "client-diagram-cfg3-first": lambda: client_diagram("cfg3-first"),
    "client-diagram-spontaneous": lambda: client_diagram("spontaneous"),
    "client-tables": client_tables,
    "server-table": server_table,
    "time-quality": time_quality,
    "config-classes": config_classes,
    "batch-columns": batch_columns,
    "topics": topics,
    "export-tables": export_tables,
    "fates": lambda: members(Fate, "fate"),
    "ledger": ledger,
}
