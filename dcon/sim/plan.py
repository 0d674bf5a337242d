"""What to simulate, and the initialisation file that says the same to the controller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from dcon.sim.faults import fault
from dcon.sim.probing import Split, split_probing
from pmutools import timebase
from pmutools.grid.pmu_model import PmuModel
from pmutools.grid.scenarios import Scenario, scenario
from pmutools.impair.profile import Profile

START_NS = timebase.parse_utc("2024-01-01T00:00:00Z")
FIRST_PORT = 4801
NOMINAL_HZ = 60.0
"""Of the grid, whatever the rate of its PMUs."""


@dataclass(frozen=True, slots=True)
class Plan:
    """One run of ``dcon simulate``. ``delay_ms`` is the total effective delay of the loop."""

    scenario: str = "cjb"
    plant: str = "modal"
    gain_mw_per_mhz: float = 9.0
    delay_ms: float = 82.0
    deadband_mhz: float = 0.0
    faults: tuple[str, ...] = ()
    """Faults by name, on the way from the PMUs to the controller."""
    profile: Profile = field(default_factory=Profile)
    """More of them, on top."""
    control: bool = True
    """False: the controller computes and logs, and drives nothing but a probing signal of the scenario."""
    align: bool = True
    interpolate_single_loss: bool = False
    duration_s: float | None = None
    noise_rad: float = 0.0
    seed: int = 1
    rate_hz: int = 60
    """Frames per second of every PMU; the controller's filter is designed for it."""

    @property
    def course(self) -> Scenario:
        return scenario(self.scenario)

    @property
    def split(self) -> Split:
        """The scenario, its probing signal apart: that is the controller's to drive."""
        return split_probing(self.course, open_loop=not self.control)

    @property
    def length_s(self) -> float:
        """As asked for, else until the scenario and every fault have been seen whole."""
        if self.duration_s is not None:
            return self.duration_s
        return max(self.course.duration_s, *(fault(name).shown_s for name in self.faults), 0.0)

    @property
    def impairment(self) -> Profile:
        """All faults together."""
        profile = Profile()
        for name in self.faults:
            profile = profile.then(fault(name).profile)
        return profile.then(self.profile)


def ini_of(
    pmus: Sequence[PmuModel],
    *,
    gain_mw_per_mhz: float,
    deadband_mhz: float,
    rate_hz: int = 60,
    urls: Sequence[str] | None = None,
    align: bool = True,
    interpolate_single_loss: bool = False,
    init_s: float = 20.0,
    pdci: str = "required = no",
    extra: str = "",
) -> str:
    """The initialisation file of a controller fed by emulated PMUs.

    ``pdci`` is what it says of the line, whose status they do not tell.
    """
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
        f"init_s = {init_s!r}",
    ]
    if gain_mw_per_mhz > 15:
        law.append(f"gain_max_mw_per_mhz = {gain_mw_per_mhz!r}")
    line = ["[pdci]", pdci]
    return "\n".join([*sections, "\n".join(law) + "\n", "\n".join(line) + "\n"]) + extra
