"""``pmu info`` for a person: tables in the terminal."""

from __future__ import annotations

import textwrap

from rich.console import Console
from rich.markup import escape

from pmutools import timebase
from pmutools.c37118.config import Station
from pmutools.c37118.constants import Format
from pmutools.cli.shell import visible
from pmutools.tools.inventory import Inventory, StreamInventory

CHANNELS_SHOWN = 12


def show(inventory: Inventory) -> None:
    """Print an inventory to stdout."""
    console = Console(highlight=False, soft_wrap=True)
    counts = ", ".join(f"{count} {kind.name.lower()}" for kind, count in sorted(inventory.frames.items()))
    console.print(
        f"[bold]{escape(inventory.path)}[/]  {inventory.kind}, {inventory.bytes_in} bytes of payload: {counts} frames"
    )
    for stream in inventory.streams:
        _stream(console, stream)
    ignored = inventory.ignored_flows
    if ignored:
        console.print(
            f"other traffic: {ignored} flow{'s' * (ignored > 1)}, {inventory.ignored_bytes} bytes, not C37.118"
        )
    for reason, nbytes in inventory.skipped.items():
        console.print(f"[yellow]skipped[/]: {nbytes} bytes, {reason}")
    for name, count in inventory.defects.items():
        console.print(f"[yellow]defect[/]: {escape(name)}: {count}")


def _stream(console: Console, stream: StreamInventory) -> None:
    config, flow = stream.config, stream.flow
    where = f"{flow.source} > {flow.destination}" if flow.destination else flow.source
    console.print(f"\n[bold]stream {stream.idcode}[/]  {flow.transport} {escape(visible(where))}")
    rate = f"{float(config.rate):g} frames/s" if config.rate else "rate undefined"
    if (measured := stream.measured_hz) is not None:
        rate += f" (measured {measured:.3f})"
    console.print(
        f"  {rate}, TIME_BASE {config.time_base}, {config.kind.name}, data frames of {config.frame_size} bytes"
    )
    if stream.frames:
        span = (stream.last_ns - stream.first_ns) / timebase.NS
        console.print(f"  {stream.frames} frames over {span:.3f} s, {timebase.format_utc(stream.first_ns)} to")
        console.print(f"  {timebase.format_utc(stream.last_ns)}")
    for text in remarks(stream):
        console.print(f"  [yellow]*[/] {text}")
    for station in config.stations:
        _station(console, station)


def _station(console: Console, station: Station) -> None:
    facts = f"IDCODE {station.idcode}, {station.fnom_hz:g} Hz, {format_text(station.format)}"
    console.print(f"  [bold]{escape(visible(station.name))}[/]  {facts}")
    names = [
        _names("phasors", [f"{channel.name} ({channel.kind})" for channel in station.phasors]),
        _names("analogs", [channel.name for channel in station.analogs]),
        f"{len(station.digitals)} digital words" if station.digitals else "",
    ]
    text = "; ".join(filter(None, names)) or "no channels but frequency and ROCOF"
    for line in textwrap.wrap(text, 92):
        console.print(f"    {visible(line)}", markup=False)


def format_text(fmt: Format) -> str:
    """FORMAT in words, e.g. ``float polar, freq int, analog float``."""
    phasor = "float" if fmt & Format.PHASOR_FLOAT else "int"
    shape = "polar" if fmt & Format.POLAR else "rect"
    freq = "float" if fmt & Format.FREQ_FLOAT else "int"
    analog = "float" if fmt & Format.ANALOG_FLOAT else "int"
    return f"{phasor} {shape}, freq {freq}, analog {analog}"


def remarks(stream: StreamInventory) -> list[str]:
    """What an engineer should know about the stream, in words; empty for a clean one."""
    frames, slots = stream.frames, stream.slots
    others = f", {slots.conflicting} with other values" if slots.conflicting else ""
    found = [
        (slots.lost, f"{slots.lost} frames missing in {stream.gaps} gaps"),
        (slots.duplicated, f"{slots.duplicated} frames repeat a time stamp{others}"),
        (stream.reordered, f"{stream.reordered} frames came after later ones"),
        (stream.backwards, f"{stream.backwards} stamps go backwards"),
        (slots.stale, f"{slots.stale} frames are far from the stamps around them"),
        (slots.off_grid, f"{slots.off_grid} stamps are off the {float(stream.config.rate):g}/s grid"),
        (stream.config_changes, f"{stream.config_changes} configuration changes"),
        (stream.data_error, f"STAT says data error in {stream.data_error} of {frames} frames"),
        (stream.not_synchronised, f"STAT says not synchronised in {stream.not_synchronised} of {frames} frames"),
    ]
    texts = [text for count, text in found if count]
    unlocked = {f"{code:X}": count for code, count in stream.time_quality.items() if code}
    if unlocked:
        texts.append("time quality not locked: " + ", ".join(f"code {code} in {n}" for code, n in unlocked.items()))
    if not frames:
        texts.append("no data frames")
    return texts


def _names(what: str, names: list[str]) -> str:
    if not names:
        return ""
    more = f", and {len(names) - CHANNELS_SHOWN} more" if len(names) > CHANNELS_SHOWN else ""
    return f"{len(names)} {what}: {', '.join(names[:CHANNELS_SHOWN])}{more}"
