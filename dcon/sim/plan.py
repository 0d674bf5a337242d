"""What to simulate, and the initialisation file that says the same to the controller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from pmutools import timebase
from pmutools.grid.pmu_model import PmuModel
from pmutools.grid.scenarios import Scenario, scenario
from pmutools.impair.profile import Profile

START_NS = timebase.parse_utc("2024-01-01T00:00:00Z")
FIRST_PORT = 4801


@dataclass(frozen=True, slots=True)
class Plan:
    """One run of ``dcon simulate``. ``delay_ms`` is the total effective delay of the loop."""

    scenario: str = "cjb"
    plant: str = "modal"
    gain_mw_per_mhz: float = 9.0
    delay_ms: float = 82.0
    deadband_mhz: float = 0.0
    profile: Profile = field(default_factory=Profile)
    """Faults on the way from the PMUs to the controller."""
    control: bool = True
    """False: the controller computes and logs, and drives nothing."""
    align: bool = True
    interpolate_single_loss: bool = False
    duration_s: float | None = None
    noise_rad: float = 0.0
    seed: int = 1
    rate_hz: int = 60

    @property
    def course(self) -> Scenario:
        return scenario(self.scenario)

    @property
    def length_s(self) -> float:
        return self.course.duration_s if self.duration_s is None else self.duration_s


def ini_of(
    pmus: Sequence[PmuModel],
    *,
    gain_mw_per_mhz: float,
    deadband_mhz: float,
    rate_hz: int = 60,
    urls: Sequence[str] | None = None,
    align: bool = True,
    interpolate_single_loss: bool = False,
    extra: str = "",
) -> str:
    """The initialisation file of a controller fed by emulated PMUs."""
    sections = [f"[DEFAULT]\nrate = {rate_hz}\nvoltage = VA,VB,VC\nnominal_kv = {pmus[0].nominal_kv:g}\n"]
    for number, pmu in enumerate(pmus):
        url = urls[number] if urls else f"udp://127.0.0.1:{FIRST_PORT + number}"
        sections.append(f"[pmu {pmu.name}]\nurl = {url}\nidcode = {pmu.idcode}\nside = {pmu.bus}\n")
    law = [
        "[controller]",
        f"gain_mw_per_mhz = {gain_mw_per_mhz!r}",
        f"deadband_mhz = {deadband_mhz!r}",
        f"align = {str(align).lower()}",
        f"interpolate_single_loss = {str(interpolate_single_loss).lower()}",
    ]
    if gain_mw_per_mhz > 15:
        law.append(f"gain_max_mw_per_mhz = {gain_mw_per_mhz!r}")
    return "\n".join([*sections, "\n".join(law) + "\n"]) + extra
