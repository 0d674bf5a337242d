"""The options of a stream: which stages there are, how each is written, how later settings meet earlier ones.

One line of a value is one part of a stage. ``delay`` parts add up, ``corrupt`` and ``config`` parts follow each other,
a frame is lost, dropped or disabled if any part says so, the first ``segment`` part that applies decides; the other
stages have one part. A value replaces what was set before,
``none`` switches it off, a value that begins with ``+`` adds its parts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from pmutools.errors import SettingsError
from pmutools.impair.config_change import ConfigChange
from pmutools.impair.content import Corrupt
from pmutools.impair.delays import Delay
from pmutools.impair.gate import Disable
from pmutools.impair.grammar import parse_stage
from pmutools.impair.link import Rate, Slot
from pmutools.impair.losses import Loss
from pmutools.impair.reorder import Duplicate, Reorder
from pmutools.impair.segment import Segment
from pmutools.impair.selectors import Selector, selector
from pmutools.parsers import parsed_by

MOST_PARTS = 64
"""Of one option of one stream: what live control adds must not grow without bound."""


@dataclass(frozen=True, slots=True)
class Drop:
    when: Selector = field(metadata=parsed_by(selector))


@dataclass(frozen=True, slots=True)
class Stages:
    """What one stream goes through, in this order."""

    corrupt: tuple[Corrupt, ...] = ()
    config: tuple[ConfigChange, ...] = ()
    disable: tuple[Disable, ...] = ()
    drop: tuple[Drop, ...] = ()
    loss: tuple[Loss, ...] = ()
    duplicate: tuple[Duplicate, ...] = ()
    delay: tuple[Delay, ...] = ()
    reorder: tuple[Reorder, ...] = ()
    rate: tuple[Rate, ...] = ()
    slot: tuple[Slot, ...] = ()
    segment: tuple[Segment, ...] = ()
    texts: Mapping[str, str] = field(default_factory=dict, compare=False)
    """What is set, by option, as it can be written again."""

    def changed(self, option: str, setting: Setting) -> Stages:
        """With one option set (or added to); raises SettingsError for more than :data:`MOST_PARTS` parts."""
        parts = setting.onto(getattr(self, option))
        if len(parts) > MOST_PARTS:
            raise SettingsError(f"{option}: more than {MOST_PARTS} parts; set it anew, without '+'")
        texts = {name: text for name, text in self.texts.items() if name != option or setting.adds}
        if parts:
            texts[option] = "\n".join(filter(None, (texts.get(option, ""), setting.text)))
        return replace(self, **{option: parts}, texts=texts)


class Setting(NamedTuple):
    """The parts that a value gives an option, and whether they join those there already."""

    parts: tuple[Any, ...]
    adds: bool = False
    text: str = ""
    """The parts as they were written."""

    def onto(self, parts: tuple[Any, ...]) -> tuple[Any, ...]:
        """The parts after this setting, where ``parts`` were there."""
        return (*parts, *self.parts) if self.adds else self.parts


OPTIONS: dict[str, type[Any]] = {
    "corrupt": Corrupt,
    "config": ConfigChange,
    "disable": Disable,
    "drop": Drop,
    "loss": Loss,
    "duplicate": Duplicate,
    "delay": Delay,
    "reorder": Reorder,
    "rate": Rate,
    "slot": Slot,
    "segment": Segment,
}
SEVERAL = frozenset(("corrupt", "config", "disable", "drop", "loss", "delay", "segment"))
"""Options that may have more than one part."""


def parse_setting(option: str, text: str) -> Setting:
    """The value of ``option`` (a key of :data:`OPTIONS`); raises ValueError."""
    text = text.strip()
    if text.lower() == "none":
        return Setting(())
    adds = text.startswith("+")
    lines = [line for line in text.removeprefix("+").split("\n") if line.strip()]
    if not lines:
        raise ValueError("no value; write 'none' to switch the stage off")
    if option not in SEVERAL and (adds or len(lines) > 1):
        raise ValueError("only one of these a stream; give it once, without '+'")
    parts = tuple(parse_stage(OPTIONS[option], line) for line in lines)
    return Setting(parts, adds, "\n".join(line.strip() for line in lines))
