"""States, rules and datagrams of the watchdog, from its own tables."""

from __future__ import annotations

from dcon.sections import Watchdog
from dcon.watchdog import codec
from dcon.watchdog.core import TRANSITIONS, Trigger
from dcon.watchdog.latch import NAME
from dcon.watchdog.limits import BOUNDS, Limits
from dcon.watchdog.rules import BIT, CAUSES, OTHERS, RULES, Action, Rule
from generate.controller import diagram
from generate.markdown import attribute_docs, code, fenced, prose, table


def triggers() -> str:
    """What moves the state."""
    says = attribute_docs(Trigger)
    return table(("trigger", "when"), ((code(trigger), says[trigger.name]) for trigger in Trigger))


def actions() -> str:
    """What a rule does while it is up."""
    says = attribute_docs(Action)
    return table(("action", "what it does"), ((f"**{action}**", says[action.name]) for action in Action))


def _limit(rule: Rule) -> str:
    least = getattr(Limits(), rule.limit) if rule.limit else 0
    sign = "≥" if rule.reached else ">"
    return f"{sign} {least:g} {rule.unit}".strip() + (f" ({code(rule.limit)})" if rule.limit else "")


def _row(bits: str, name: str, rule: Rule, text: str) -> tuple[str, ...]:
    return bits, name, prose(rule.value.__doc__), _limit(rule), f"**{rule.action}**", text


def rules() -> str:
    """Every rule; those of the loops together where they are alike."""
    alike: dict[tuple[object, ...], list[Rule]] = {}
    for rule in RULES:
        if rule not in OTHERS:
            kind = rule.name.removeprefix(rule.cause)
            alike.setdefault((kind, rule.value, rule.limit, rule.action), []).append(rule)
    rows = []
    kinds = list(dict.fromkeys(kind for kind, *_ in alike))
    for (kind, *_), members in sorted(alike.items(), key=lambda entry: kinds.index(str(entry[0][0]))):
        loops = ", ".join(rule.cause for rule in members)
        first = members[0]
        text = first.text.replace(f"the {first.cause} loop", "the loop")
        bits = ", ".join(str(BIT[rule.cause].bit_length() - 1) for rule in members)
        rows.append(_row(bits, f"LOOP`{kind}`: {loops}", first, text))
    rows += [_row(str(BIT[rule.cause].bit_length() - 1), code(rule.name), rule, rule.text) for rule in OTHERS]
    shown = table(("bit of `causes`", "rule", "judges", "up", "action", "what the operator reads"), rows)
    last = (
        f"Bit {len(CAUSES) - 1}, {code(CAUSES[-1])}, is of no rule: a latch was found at the start, and not its causes."
    )
    return f"{shown}\n\n{last}"


def settings() -> str:
    """``[watchdog]``: with the bounds of its limits."""
    says, rows = attribute_docs(Watchdog), []
    for name in Watchdog.__dataclass_fields__:
        default = Watchdog.__dataclass_fields__[name].default
        shown = ",".join(default) if isinstance(default, tuple) else f"{default:g}" if name in BOUNDS else str(default)
        low, high = BOUNDS.get(name, ("", ""))
        bounds = f"{low:g} to {high:g}" if name in BOUNDS else ""
        rows.append((code(name), code(shown.lower() if isinstance(default, bool) else shown), bounds, says[name]))
    return table(("key", "default", "range", "meaning"), rows)


def datagrams() -> str:
    """The layouts, from the codec's own text."""
    _, layouts, rest = (codec.__doc__ or "").split("\n\n", 2)
    return fenced("\n".join(line.strip() for line in layouts.splitlines())) + "\n\n" + prose(rest)


GENERATORS = {
    "watchdog-diagram": lambda: diagram(TRANSITIONS, "OPEN", f"TRIPPED: {NAME} is there"),
    "watchdog-triggers": triggers,
    "watchdog-actions": actions,
    "watchdog-rules": rules,
    "watchdog-datagrams": datagrams,
    "settings-watchdog": settings,
}
