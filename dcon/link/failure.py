"""Why a child of the control process has ended, in its own words."""

from __future__ import annotations

from typing import NamedTuple

from pmutools.errors import PmuError, SettingsError, SourceError


class Failure(NamedTuple):
    """The front, or the aides, have ended, and why."""

    reason: str
    is_mistake: bool = False
    """Of a file that a user wrote: it would be the same again."""

    @classmethod
    def of(cls, error: PmuError) -> Failure:
        return cls(str(error), isinstance(error, SettingsError))

    @property
    def error(self) -> PmuError:
        return SettingsError(self.reason) if self.is_mistake else SourceError(self.reason)
