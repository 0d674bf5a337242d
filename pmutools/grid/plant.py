"""What every plant offers, and the plants by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple, Protocol

from pmutools.errors import SettingsError
from pmutools.grid.modal import FIVE_MODES, SEPARATED_FROM_ALBERTA, SEPARATED_FROM_BC, SINGLE_MODE, ModalPlant
from pmutools.grid.signals import Bus, Drive


class Plant(Protocol):
    """A power system driven by power that is constant over each step."""

    def advance(self, dt_s: float, drive: Drive) -> None:
        """Move on by ``dt_s`` (>= 0) under ``drive``."""

    def buses(self, drive: Drive) -> dict[str, Bus]:
        """What a PMU would see now, by bus name; ``north`` and ``south`` are always there."""


class PlantKind(NamedTuple):
    """A plant that can be built: ``build(condition)``, ``condition`` one of ``conditions``."""

    build: Callable[[str], Plant]
    conditions: tuple[str, ...]
    text: str


MODAL: Final = {
    "normal": SINGLE_MODE,
    "bc-us-separated": SEPARATED_FROM_BC,
    "bc-alberta-separated": SEPARATED_FROM_ALBERTA,
}
"""Modes of the plant ``modal`` by condition."""

PLANTS: Final = {
    "modal": PlantKind(
        lambda condition: ModalPlant(MODAL[condition]),
        tuple(MODAL),
        "North-South B mode alone, fitted to Table II; linear",
    ),
    "modal-five": PlantKind(lambda _: ModalPlant(FIVE_MODES), ("normal",), "five modes, one of them the HVDC line's"),
}


def build(name: str, condition: str = "normal") -> Plant:
    """The plant ``name`` in ``condition``. Raises SettingsError for one that there is not."""
    kind = PLANTS.get(name)
    if kind is None:
        raise SettingsError(f"no plant {name!r}: one of {', '.join(PLANTS)}")
    if condition not in kind.conditions:
        raise SettingsError(f"plant {name!r} has no condition {condition!r}: one of {', '.join(kind.conditions)}")
    return kind.build(condition)
