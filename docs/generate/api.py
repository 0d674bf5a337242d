"""The Python interface, from its classes."""

from __future__ import annotations

from generate.markdown import attribute_docs, code, prose, table
from pmutools.stream import StationValues, Stream, StreamBatch, StreamFrame


def attributes(cls: type) -> str:
    """What objects of a class offer, in the order of the code: attributes, properties, methods."""
    rows = [(code(name), text) for name, text in attribute_docs(cls).items()]
    for name, member in vars(cls).items():
        if name.startswith("_"):
            continue
        if isinstance(member, property):
            rows.append((code(name), prose(member.fget.__doc__)))
        elif callable(member):
            rows.append((code(f"{name}()"), prose(member.__doc__)))
    return table(("member", "is"), rows)


GENERATORS = {
    "api-stream": lambda: attributes(Stream),
    "api-frame": lambda: attributes(StreamFrame),
    "api-station": lambda: attributes(StationValues),
    "api-batch": lambda: attributes(StreamBatch),
}
