"""The one table that every logged message is made from: protobuf descriptors, ``.proto`` text and documentation.

A field's number is its place in the list, so: append only, never reorder, never reuse, never change a type.
Readers of either age then read each other's logs (protobuf's own rule). Times are POSIX UTC in nanoseconds;
frequency is absolute; a number that is unknown is NaN; lists of one message run in parallel.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

FieldType = Literal["int64", "uint64", "int32", "uint32", "double", "bool", "string", "bytes"]

PACKAGE = "pmutools"
FILE_NAME = "pmutools.proto"


class Field(NamedTuple):
    """One field of a message; ``unit`` is empty where there is none."""

    name: str
    type: FieldType
    doc: str
    unit: str = ""
    repeated: bool = False


class MessageType(NamedTuple):
    """One message: where it is logged (``topic``), what it says, and its fields in order of their numbers."""

    topic: str
    doc: str
    fields: tuple[Field, ...]


_TICK = Field("tick_ns", "int64", "Tick that this belongs to.", "ns")

MESSAGES: dict[str, MessageType] = {
    "PmuFrame": MessageType(
        "/pmu/NAME/frame",
        "One data frame of one PMU, as received. Its configuration frame is an attachment that precedes it.",
        (
            Field("time_ns", "int64", "Time of measurement, from SOC and FRACSEC; 0 without a configuration.", "ns"),
            Field("arrival_ns", "int64", "Time of arrival; 0 where unknown.", "ns"),
            Field("tick_ns", "int64", "Control tick that consumed the frame; 0 for none.", "ns"),
            Field("stamp_source", "string", "Who took arrival_ns: hardware, kernel, kernel-batched, user, capture."),
            Field("wire", "bytes", "The C37.118 frame, every byte of it."),
            Field("time_base", "uint32", "Ticks of FRACSEC per second: how finely time_ns could be stamped.", "1/s"),
            Field("stat", "uint32", "STAT of the PMU's station."),
            Field("time_quality", "uint32", "Time quality byte: leap flags and MSG_TQ."),
            Field("v1_re", "double", "Positive-sequence voltage, real part.", "V"),
            Field("v1_im", "double", "Positive-sequence voltage, imaginary part.", "V"),
            Field("frequency_hz", "double", "FREQ of the PMU's station.", "Hz"),
            Field("rocof_hz_s", "double", "DFREQ of the PMU's station.", "Hz/s"),
            Field("phasor_re", "double", "All phasors of the frame in order, real parts.", "V or A RMS", True),
            Field("phasor_im", "double", "All phasors of the frame in order, imaginary parts.", "V or A RMS", True),
            Field("analog", "double", "All analogs of the frame in order.", "", True),
            Field("digital", "uint32", "All digital status words of the frame in order.", "", True),
            Field("station_stat", "uint32", "STAT of each station, where the frame has several.", "", True),
            Field("station_frequency_hz", "double", "FREQ of each station, where there are several.", "Hz", True),
            Field("station_rocof_hz_s", "double", "DFREQ of each station, where there are several.", "Hz/s", True),
        ),
    ),
    "Tick": MessageType(
        "/dcon/tick",
        "What one control tick decided. Names of PMUs, instances and flags are metadata of the channel.",
        (
            Field("tick_ns", "int64", "The tick's nominal time.", "ns"),
            Field("state", "string", "OFF, INIT, STANDBY, ARMED, ACTIVE, RAMPDOWN, FAULT or ESTOP."),
            Field("mode", "string", "open_loop or closed_loop."),
            Field("active", "int32", "Index of the active instance; -1 for none."),
            Field("active_instance", "string", "Name of the active instance; empty for none."),
            Field("gain_mw_per_mhz", "double", "Gain in force.", "MW/mHz"),
            Field("delta_f_mhz", "double", "Frequency difference north minus south of the active instance.", "mHz"),
            Field("command_mw", "double", "Command, computed and limited.", "MW"),
            Field("output_v", "double", "Voltage really driven; 0 in open loop.", "V"),
            Field("probe_mw", "double", "Probing signal beside the command.", "MW"),
            Field("flags", "uint64", "Supervisory flags, one bit a check."),
            Field("f_hz", "double", "Frequency of each PMU by the controller's own filter.", "Hz", True),
            Field("age_ms", "double", "Tick time minus stamp of each PMU's newest frame.", "ms", True),
        ),
    ),
    "Instance": MessageType(
        "/dcon/instance",
        "All controller instances at one tick, best priority first.",
        (
            _TICK,
            Field("state", "string", "DISABLED, INITIALISING, READY or HELD.", "", True),
            Field("active", "bool", "Whether this instance drives the output.", "", True),
            Field("delta_f_mhz", "double", "Frequency difference north minus south.", "mHz", True),
            Field("command_mw", "double", "What the instance alone would command.", "MW", True),
            Field("reason", "string", "Why it was last disabled; empty if it never was.", "", True),
        ),
    ),
    "Event": MessageType(
        "/dcon/event",
        "Something that happened at a tick: a change of state, a switch, a check that fired.",
        (
            _TICK,
            Field("name", "string", "What happened."),
            Field("subject", "string", 'To whom: a PMU, an instance, or "system" for the whole controller.'),
            Field("detail", "string", "Value, limit, or words for the operator."),
        ),
    ),
    "Setting": MessageType(
        "/dcon/setting",
        "An operator's order or a changed setting: an input of the tick it names.",
        (
            _TICK,
            Field("name", "string", "The order, e.g. arm, activate, disarm, gain."),
            Field("value", "double", "Its value; 0 where it takes none."),
            Field("text", "string", "What it concerns: of ack the flag; empty where it takes none."),
            Field("who", "string", "Who ordered it; empty where unknown."),
            Field("why", "string", "Why, in the operator's words; empty where unknown."),
        ),
    ),
    "Watchdog": MessageType(
        "/dcon/watchdog",
        "State of the independent watchdog.",
        (
            Field("time_ns", "int64", "When it was read.", "ns"),
            Field("relays_closed", "bool", "Whether the output reaches the converter."),
            Field("estop", "bool", "Emergency stop pressed."),
            Field("latched", "bool", "Tripped and waiting for a manual reset."),
            Field("reason", "string", "Causes that are up or latched by a trip, by name; empty for none."),
            Field("heartbeat", "string", "Components watched.", "", True),
            Field("heartbeat_age_ms", "double", "Age of each component's last heartbeat.", "ms", True),
            Field("silent", "bool", "It has said nothing for longer than it may: this is its last word."),
        ),
    ),
    "Timing": MessageType(
        "/dcon/timing",
        "How one tick ran. Never compared in a replay.",
        (
            _TICK,
            Field("compute_us", "double", "From the tick's start to its command.", "us"),
            Field("late_us", "double", "From the tick's nominal time to its start.", "us"),
        ),
    ),
    "Pdci": MessageType(
        "/dcon/pdci",
        "State of the DC line as last reported.",
        (
            _TICK,
            Field("time_ns", "int64", "Time of the report.", "ns"),
            Field("power_mw", "double", "Power, north to south.", "MW"),
            Field("in_service", "bool", "The line transmits and is not blocked."),
            Field("dcon_enabled", "bool", "The line's own controls accept the command."),
            Field("scheduled_mw", "double", "Scheduled power, north to south.", "MW"),
        ),
    ),
    "Flag": MessageType(
        "/dcon/flag",
        "A check that rose, fell or was acknowledged at a tick, as it stands since.",
        (
            _TICK,
            Field("name", "string", "The check."),
            Field("subject", "string", 'For whom: a PMU, an instance, or "system".'),
            Field("up", "bool", "Whether it is up."),
            Field("first_ns", "int64", "The tick in which it first rose.", "ns"),
            Field("last_ns", "int64", "The tick in which it last rose or fell.", "ns"),
            Field("times", "int64", "How often it rose."),
            Field("value", "double", "What was found when it last rose, in the check's unit."),
            Field("limit", "double", "The bound that the value broke."),
            Field("latched", "bool", "It disarmed or tripped, and keeps the controller from being armed."),
            Field("acknowledged", "string", "By whom, since it last rose; empty for nobody."),
        ),
    ),
    "Surroundings": MessageType(
        "/dcon/surroundings",
        "What a tick was told besides PMU frames: an input. A field counts only where told names it.",
        (
            _TICK,
            Field("told", "string", "Fields that are fitted; pdci stands for all of its own.", "", True),
            Field("gps_age_s", "double", "Since the controller's clock last had its GPS lock.", "s"),
            Field("watchdog_healthy", "bool", "The watchdog would keep its relays closed."),
            Field("estop_released", "bool", "The emergency stop is not pressed."),
            Field("readback_v", "double", "Output of the last tick, read back.", "V"),
            Field("overrun", "bool", "The last tick was late."),
            Field("response_gain", "double", "Response of the line to the command.", "MW/MW"),
            Field("response_lag_ms", "double", "Lag of the line behind the command.", "ms"),
            Field("server_age_s", "double", "Since the server was last heard.", "s"),
            Field("disk_free_percent", "double", "Free share of the disk that is logged to.", "%"),
            Field("unread", "int64", "Frames of each PMU that could not be read; empty for none.", "", True),
            Field("pdci_time_ns", "int64", "Time of the line's status.", "ns"),
            Field("pdci_power_mw", "double", "Power, north to south.", "MW"),
            Field("pdci_scheduled_mw", "double", "Scheduled power, north to south.", "MW"),
            Field("pdci_in_service", "bool", "The line transmits and is not blocked."),
            Field("pdci_dcon_enabled", "bool", "The line's own controls accept the command."),
            Field("relays_closed", "bool", "By the watchdog's word, the command passes."),
        ),
    ),
    "Counts": MessageType(
        "/dcon/counts",
        "What did not become what it was sent for: frames and datagrams, counted since the platform began.",
        (
            _TICK,
            Field("name", "string", "What was counted; a count that is not named is 0.", "", True),
            Field("value", "int64", "How many.", "", True),
        ),
    ),
    "Checkpoint": MessageType(
        "/dcon/checkpoint",
        "All that the controller remembered before a tick, now and then: a replay can begin with it.",
        (
            _TICK,
            Field("layout", "string", "What the numbers of memory are of: only a program with the same reads it."),
            Field("memory", "string", "Nested lists as JSON, with NaN and Infinity; every number is exact."),
        ),
    ),
}
