"""INI files whose every value knows its line, and dataclasses filled from their sections.

The initialisation file and the impairment profile share this reader. The text rules are those of ``configparser``
with ``interpolation=None`` and ``;`` comments after a value, but duplicates, unknown names and bad values are errors
naming file, line, section and key, and ``[DEFAULT]`` reaches one family of sections only.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeVar

from pmutools.errors import SettingsError
from pmutools.parsers import Parser, is_optional, settable, suggestion

T = TypeVar("T")


class Where(NamedTuple):
    """The place a user can find a value at: ``FILE:LINE: [section] key``, or an option's name as ``source``."""

    source: str
    line: int = 0
    section: str = ""
    key: str = ""

    def __str__(self) -> str:
        place = f"{self.source}:{self.line}" if self.line else self.source
        inside = " ".join(part for part in (f"[{self.section}]" if self.section else "", self.key) if part)
        return f"{place}: {inside}" if inside else place

    def error(self, problem: object) -> SettingsError:
        return SettingsError(f"{self}: {problem}")


class Entry(NamedTuple):
    """A value's text and its place."""

    text: str
    where: Where

    def read(self, parse: Parser[T]) -> T:
        """The parsed value; raises SettingsError with the place before the parser's words."""
        try:
            return parse(self.text)
        except SettingsError:
            raise
        except ValueError as error:
            raise self.where.error(error) from None


@dataclass(frozen=True, slots=True)
class Section:
    """``[kind argument]`` and its entries by lower-case key, in order."""

    name: str
    where: Where
    entries: Mapping[str, Entry] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        return self.name.partition(" ")[0]

    @property
    def argument(self) -> str:
        """What follows the kind: ``N1`` of ``[pmu N1]``."""
        return self.name.partition(" ")[2]


@dataclass(frozen=True, slots=True)
class Ini:
    """The sections of one file, in order."""

    source: str
    sections: tuple[Section, ...]

    def only(self, *names: str) -> None:
        """Raise SettingsError for a section not among ``names``; ``"pmu *"`` allows ``[pmu X]`` for any X."""
        families = {name[:-2] for name in names if name.endswith(" *")}
        for section in self.sections:
            known = section.kind in families if section.argument else section.name in names
            if not known:
                shown = [f"{name[:-2]} NAME" if name.endswith(" *") else name for name in names]
                written = f"{section.kind} NAME" if section.argument else section.name
                raise section.where.error(f"unknown section; {suggestion(written, shown)}")

    def family(self, kind: str) -> tuple[Section, ...]:
        """All ``[kind X]``."""
        return tuple(section for section in self.sections if section.kind == kind and section.argument)

    def section(self, name: str) -> Section:
        """``[name]``, empty where the file has none."""
        for section in self.sections:
            if section.name == name:
                return section
        return Section(name, Where(self.source, section=name))

    def changed(self, assignment: str, source: str = "--set") -> Ini:
        """With one value replaced or added: ``"SECTION.KEY=VALUE"``. Raises SettingsError for another form."""
        target, equals, text = assignment.partition("=")
        name, dot, key = target.strip().rpartition(".")
        if not (equals and dot and name and key):
            raise SettingsError(f"{source}: {assignment!r} is not SECTION.KEY=VALUE")
        if name == "DEFAULT":
            where = f"{source}: [DEFAULT] {key}"
            raise SettingsError(f"{where}: is merged into each [pmu NAME]; change it there: 'pmu NAME.{key}={text}'")
        old = self.section(name)
        entry = Entry(text.strip(), Where(source, section=name, key=key.lower()))
        new = replace(old, entries={**old.entries, key.lower(): entry})
        others = [new if section.name == name else section for section in self.sections]
        return replace(self, sections=tuple(others if new in others else [*others, new]))


_HEADER = re.compile(r"\[(.+)\]")
_OPTION = re.compile(r"(.*?)\s*[=:]\s*(.*)")
_COMMENT = re.compile(r"(?:^|(?<=\s));.*")


def parse_ini(text: str, source: str, *, defaults_for: str = "") -> Ini:
    """Sections of ``text``; ``[DEFAULT]`` is merged into the sections ``[defaults_for X]`` and only there.

    Keys are lower-cased, section names keep their case; an indented line continues the value above it. Raises
    SettingsError for a line that is none of these, and for a section or key given twice.
    """
    sections: dict[str, Section] = {}
    entries: dict[str, Entry] = {}
    lines: list[str] | None = None
    indent = 0
    values: list[tuple[dict[str, Entry], str, list[str]]] = []
    for number, line in enumerate(text.removeprefix("\ufeff").split("\n"), 1):
        bare = "" if line.lstrip().startswith("#") else _COMMENT.sub("", line)
        content = bare.strip()
        depth = len(bare) - len(bare.lstrip())
        if not content:
            if lines is not None and not line.strip():
                lines.append("")
        elif lines is not None and depth > indent:
            lines.append(content)
        elif header := _HEADER.fullmatch(content):
            name = " ".join(header[1].split())
            where = Where(source, number, name)
            if name in sections:
                raise where.error(f"section given twice, first on line {sections[name].where.line}; merge the two")
            entries, lines, indent = {}, None, depth
            sections[name] = Section(name, where, entries)
        elif not sections:
            raise Where(source, number).error(f"{content!r} stands before any section; add a [section] line above")
        elif (option := _OPTION.fullmatch(content)) and option[1] and not content.startswith("["):
            key, section = option[1].lower(), next(reversed(sections))
            where = Where(source, number, section, key)
            if key in entries:
                raise where.error(f"key given twice, first on line {entries[key].where.line}; keep one")
            lines, indent = [option[2]], depth
            entries[key] = Entry("", where)
            values.append((entries, key, lines))
        else:
            raise Where(source, number).error(f"{content!r} is neither [section] nor key = value")
    for owner, key, parts in values:
        owner[key] = owner[key]._replace(text="\n".join(parts).strip())
    return Ini(source, tuple(_with_defaults(sections, defaults_for)))


def _with_defaults(sections: Mapping[str, Section], family: str) -> Iterator[Section]:
    defaults = sections["DEFAULT"].entries if family and "DEFAULT" in sections else {}
    for name, section in sections.items():
        if family and name == "DEFAULT":
            continue
        inherits = section.kind == family and section.argument
        yield replace(section, entries={**defaults, **section.entries}) if inherits else section


def fill(cls: type[T], section: Section, **given: object) -> T:
    """An instance of the dataclass ``cls`` from a section's entries; ``given`` are fields that no text sets.

    Raises SettingsError for an unknown key (with the nearest known one), a value that does not parse, a required key
    that is missing, and a ValueError that ``cls`` itself raises (keys that clash).
    """
    known = settable(cls)
    values = dict(given)
    for key, entry in section.entries.items():
        if key not in known:
            raise entry.where.error(f"unknown key; {suggestion(key, known)}")
        values[known[key].name] = entry.read(known[key].metadata["parse"])
    for key, item in known.items():
        if item.name not in values and not is_optional(item):
            raise section.where.error(f"{key} is missing; add a line '{key} = ...'")
    try:
        return cls(**values)
    except SettingsError:
        raise
    except ValueError as error:
        raise section.where.error(error) from None
