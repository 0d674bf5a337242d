"""Tables of the player's control: verbs, keys, columns, limits."""

from __future__ import annotations

from generate.markdown import attribute_docs, code, table
from pmutools.cli.play_keys import KEYS
from pmutools.timebase import NS
from pmutools.tools.player import control, control_server
from pmutools.tools.player.status import PacingStatus, PlayerStatus, PlayState, StreamStatus


def verbs() -> str:
    """What a player can be told."""
    return table(("verb", "meaning"), ((code(verb.usage), verb.meaning) for verb in control.VERBS))


def keys() -> str:
    """Keys of ``--interactive``."""
    rows = ((" ".join(code(word) for word in key.shown.split()), key.meaning) for key in KEYS)
    return table(("key", "meaning"), rows)


FIELDS = {
    "position_s": "Seconds into the source.",
    "length_s": "Of the source.",
    "loop": "Times that it was played whole.",
    "speed": "Asked for: source seconds per second.",
    "elapsed_s": "Wall time since it began to play.",
    "frames_per_s": "Leaving now.",
    "sent": "Frames, of all streams.",
    "pacing": "How late frames left: `p50_us`, `p99_us`, `max_us`, and `misses`, by over half a reporting interval.",
    "name": "Of the stream.",
    "idcode": "Of the stream.",
    "enabled": "Whether the operator lets it speak.",
    "clients": "How many get it.",
    "fates": "What became of its frames, by fate.",
}


def status() -> str:
    """Fields of the state."""
    rows = []
    for cls, prefix in ((PlayerStatus, ""), (StreamStatus, "streams[].")):
        says = FIELDS | attribute_docs(cls)
        says |= {"state": ", ".join(code(state.value) for state in PlayState)}
        rows += [(code(prefix + name), says[name]) for name in cls.__dataclass_fields__ if name != "streams"]
    assert set(PacingStatus.__dataclass_fields__) == {"p50_us", "p99_us", "max_us", "misses"}
    return table(("field", "holds"), rows)


def limits() -> str:
    """What a control client may do before it is sent away."""
    rows = (
        ("clients at a time", control_server.MAX_CLIENTS),
        ("bytes of a line", control.LINE_BYTES),
        ("characters of a thing to do", control.DO_CHARACTERS),
        ("lines in a row that are no request", control.PATIENCE - 1),
        (f"lines in {control.FLOOD_NS // NS} s", control.FLOOD_REQUESTS),
        ("seconds without taking what waits", control_server.STALL_NS // NS),
    )
    return table(("at most", ""), rows)


GENERATORS = {"control-verbs": verbs, "player-keys": keys, "player-status": status, "control-limits": limits}
