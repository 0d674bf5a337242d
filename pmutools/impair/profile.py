"""Impairment profiles: who suffers what, and when that changes. One grammar for files, options and live control.

::

    [run]
    seed = 7
    [stream N*, 101]          ; patterns of stream names or IDCODEs; sections apply in order
    delay = normal(16, 2) corr=30%
    corrupt = 1% field=stat when=every 7
              stat(do_not_use) when=5..8
    loss = trace(@lost.txt)   ; numbers from a file beside the profile
    [at 12.5]                 ; seconds of stream time
    do = disable N1 tcp=rst
         fault N2 loss=gemodel(1%, 20%)
         pause 5              ; a verb of the player's, see :mod:`pmutools.impair.verbs`
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from pmutools.errors import SourceError
from pmutools.impair.gate import Disable, Switch
from pmutools.impair.grammar import phrase
from pmutools.impair.stages import OPTIONS, Setting, Stages, parse_setting
from pmutools.impair.verbs import PLAYER, Values, player_values, refuse_unscheduled
from pmutools.parsers import bind, integer, parsed_by, seconds_ns, suggestion
from pmutools.settings import Entry, Section, Where, fill, parse_ini

ReadText = Callable[[str], str]


class StreamRule(NamedTuple):
    """One ``[stream PATTERN, ...]`` section, or one option."""

    patterns: tuple[str, ...]
    settings: tuple[tuple[str, Setting], ...]

    def matches(self, names: Iterable[str]) -> bool:
        return any(_fits(name.casefold(), pattern.casefold()) for name in names for pattern in self.patterns)

    def among(self, names: Iterable[str]) -> tuple[str, ...]:
        """Those of ``names`` that a pattern fits."""
        return tuple(name for name in names if self.matches((name,)))


def _fits(name: str, pattern: str) -> bool:
    """Whether a pattern fits; most are plain names, which need no search: an order may ask thousands of streams."""
    return fnmatchcase(name, pattern) if _WILD & set(pattern) else name == pattern


_WILD = frozenset("*?[")


class Action(NamedTuple):
    """Something to do: ``enable``, ``disable`` and ``fault`` concern streams, all others the player.

    ``rule`` says whom it concerns, and for ``fault`` what is set; ``switch``, of ``disable``, how a stream is silent.
    ``argument`` is what followed a player's verb, ``values`` the same read: see
    :func:`~pmutools.impair.verbs.player_values`.
    """

    verb: str
    rule: StreamRule | None = None
    argument: str = ""
    at_ns: int = 0
    values: Values = ()
    switch: Switch = Switch()


STREAM_VERBS = ("enable", "disable", "fault")
PLAYER_VERBS = tuple(PLAYER)


class Treatment(NamedTuple):
    """What one stream goes through, and the silences of single stations in it."""

    stages: Stages = Stages()
    stations: Mapping[str, tuple[Disable, ...]] = MappingProxyType({})

    def under(self, rule: StreamRule, names: Collection[str], stations: Collection[str] = ()) -> Treatment:
        """After a rule, for a stream known by ``names`` with these ``stations``.

        What a station's name addresses is done to the whole stream, but ``disable`` to that station alone.
        """
        stages, silences = self.stages, dict(self.stations)
        whole, found = rule.matches(names), rule.among(stations)
        for option, setting in rule.settings if whole or found else ():
            if option == "disable" and not whole:
                silences |= {station: setting.onto(silences.get(station, ())) for station in found}
            else:
                stages = stages.changed(option, setting)
                if option == "disable" and not setting.adds:
                    silences = {}
        return Treatment(stages, silences)


@dataclass(frozen=True, slots=True)
class Run:
    seed: int | None = field(default=None, metadata=parsed_by(integer(0, 2**64 - 1)))


@dataclass(frozen=True, slots=True)
class Profile:
    """Rules in order, later ones over earlier ones, and a timeline in order of stream time."""

    rules: tuple[StreamRule, ...] = ()
    timeline: tuple[Action, ...] = ()
    seed: int | None = None

    @property
    def player_timeline(self) -> tuple[Action, ...]:
        """What the timeline has the player do, in order of stream time."""
        return tuple(action for action in self.timeline if action.verb in PLAYER)

    def treatment(self, names: Collection[str], stations: Collection[str] = ()) -> Treatment:
        """What a stream goes through before the timeline changes it; arguments as of :meth:`Treatment.under`."""
        treatment = Treatment()
        for rule in self.rules:
            treatment = treatment.under(rule, names, stations)
        return treatment

    def then(self, other: Profile) -> Profile:
        """This profile with ``other`` (say, the command line's options) on top."""
        timeline = sorted((*self.timeline, *other.timeline), key=lambda action: action.at_ns)
        seed = self.seed if other.seed is None else other.seed
        return Profile(self.rules + other.rules, tuple(timeline), seed)

    def unmatched(self, streams: Iterable[Iterable[str]]) -> tuple[str, ...]:
        """Patterns of rules and timeline that fit none of the streams (each given by its names), each once.

        Most likely they are misspelt.
        """
        known = [tuple(names) for names in streams]
        rules = (*self.rules, *(action.rule for action in self.timeline if action.rule is not None))
        missed = (rule.patterns for rule in rules if not any(rule.matches(names) for names in known))
        return tuple(dict.fromkeys(map(", ".join, missed)))


def parse_profile(text: str, source: str, read: ReadText | None = None) -> Profile:
    """A profile from INI text; ``read`` gives the text of a file that ``@NAME`` names. Raises SettingsError."""
    ini = parse_ini(text, source)
    ini.only("run", "stream *", "at *")
    rules = tuple(_rule(section, read) for section in ini.family("stream"))
    timeline = [action for section in ini.family("at") for action in _actions(section, read)]
    timeline.sort(key=lambda action: action.at_ns)
    return Profile(rules, tuple(timeline), fill(Run, ini.section("run")).seed)


def read_profile_file(path: Path) -> Profile:
    """A profile from a file; raises SettingsError, and SourceError for a file that cannot be read."""
    return parse_profile(_text_of(path), str(path), lambda name: _text_of(path.parent / name))


def profile_of_options(options: Iterable[tuple[str, str]], read: ReadText | None = None) -> Profile:
    """A profile from (option, value) pairs of a command line; ``PATTERN@VALUE`` is for some streams only.

    An option given again for the same streams adds to the first. Raises SettingsError naming ``--option``.
    """
    rules, seen = list[StreamRule](), set[tuple[str, str]]()
    for option, text in options:
        where = Where(f"--{option}")
        pattern, value = _addressed(text)
        if (pattern, option) in seen and not value.startswith("+"):
            value = f"+{value}"
        seen.add((pattern, option))
        rules.append(StreamRule(_patterns(pattern), (_read_setting(option, Entry(value, where), read),)))
    return Profile(tuple(rules))


def parse_action(text: str, read: ReadText | None = None) -> Action:
    """``enable NAME``, ``disable NAME [release=] [tcp=]``, ``fault NAME OPTION=VALUE`` or one of the player's verbs.

    A NAME is a pattern, in double quotes where it holds a space before an option. Raises ValueError.
    """
    verb, _, rest = text.strip().partition(" ")
    verb, rest = verb.lower(), rest.strip()
    if verb in ("enable", "disable"):
        return _switched(verb, rest)
    if verb == "fault":
        match = _FAULT.fullmatch(rest)
        if match is None:
            raise ValueError(f"{text!r} is not of the form 'fault NAME OPTION=VALUE'")
        option = match[3].lower()
        try:
            setting = _setting(option, match[4], read)
        except ValueError as error:
            raise ValueError(f"{option}: {error}") from None
        return Action(verb, StreamRule(_patterns(match[1] or match[2]), (setting,)))
    if verb in PLAYER_VERBS:
        return Action(verb, argument=rest, values=player_values(verb, rest))
    raise ValueError(f"{verb!r} is nothing to do; {suggestion(verb, (*STREAM_VERBS, *PLAYER_VERBS))}")


def _switched(verb: str, text: str) -> Action:
    match = _SWITCH.fullmatch(text)
    if match is None:
        raise ValueError(f"{verb} whom? write '{verb} NAME'")
    if verb == "enable" and match[3]:
        raise ValueError(f"enable takes a name alone, not {match[3].strip()}")
    switch = bind(Switch, phrase(match[3]))
    return Action(verb, StreamRule(_patterns(match[1] or match[2]), ()), switch=switch)


_SWITCH = re.compile(r'(?:"([^"]+)"|([^"]+?))((?:\s+[a-z_]+=\S+)*)')
_ADDRESSED = re.compile(r"([^@()]+?)@(.+)", re.DOTALL)
_FAULT = re.compile(r'(?:"([^"]+)"|(\S+))\s+([A-Za-z]+)\s*=\s*(.*)', re.DOTALL)
_FILE = re.compile(r"(?<=[(,\s])@([^\s,()]+)")


def _addressed(text: str) -> tuple[str, str]:
    match = _ADDRESSED.fullmatch(text.strip())
    return (match[1], match[2]) if match else ("*", text)


def _patterns(text: str) -> tuple[str, ...]:
    return tuple(pattern.strip() for pattern in text.split(",") if pattern.strip())


def _rule(section: Section, read: ReadText | None) -> StreamRule:
    settings = tuple(_read_setting(option, entry, read) for option, entry in section.entries.items())
    return StreamRule(_patterns(section.argument), settings)


def _read_setting(option: str, entry: Entry, read: ReadText | None) -> tuple[str, Setting]:
    return entry.read(lambda text: _setting(option, text, read))


def _setting(option: str, text: str, read: ReadText | None) -> tuple[str, Setting]:
    if option not in OPTIONS:
        raise ValueError(f"no such fault; {suggestion(option, OPTIONS)}")
    return option, parse_setting(option, _with_files(text, read))


def _with_files(text: str, read: ReadText | None) -> str:
    """``@NAME`` replaced by the numbers in that file, which spaces, commas or line ends part; ``#`` comments."""

    def numbers(match: re.Match[str]) -> str:
        if read is None:
            raise ValueError(f"@{match[1]}: no file can be named here")
        try:
            text = read(match[1])
        except SourceError as error:
            raise ValueError(str(error)) from None
        lines = (line.partition("#")[0] for line in text.splitlines())
        return ",".join(number for line in lines for number in line.replace(",", " ").split())

    return _FILE.sub(numbers, text)


def _actions(section: Section, read: ReadText | None) -> Iterator[Action]:
    try:
        at_ns = seconds_ns(section.argument)
    except ValueError as error:
        raise section.where.error(f"{error}; write [at SECONDS]") from None
    if not section.entries:
        raise section.where.error("nothing to do; add a line 'do = disable NAME'")
    for key, entry in section.entries.items():
        if key != "do":
            raise entry.where.error(f"unknown key; {suggestion(key, ('do',))}")
        for line in entry.text.split("\n"):
            if line.strip():
                yield entry._replace(text=line).read(lambda text: _scheduled(text, read))._replace(at_ns=at_ns)


def _scheduled(text: str, read: ReadText | None) -> Action:
    action = parse_action(text, read)
    if action.verb in PLAYER:
        refuse_unscheduled(action.verb, action.values)
    return action


def _text_of(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: {getattr(error, 'strerror', None) or 'not a text file'}") from None
