"""The pictures of the analysis guide, ``docs/img/analysis-*.png``; to make them anew::

    PYTHONPATH=.:tests python docs/generate/analysis.py

The sessions are simulated as the guide says. Chromium draws the page, matplotlib the rest.
"""

from __future__ import annotations

import shutil
import subprocess
from contextlib import chdir
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

from dcon.analysis.report import write_analysis
from dcon.sim.plan import Plan
from dcon.sim.simulate import simulate

IMAGES = Path(__file__).parents[1] / "img"
PLANS = {
    "open": Plan(control=False, noise_rad=5e-5),
    "closed": Plan(gain_mw_per_mhz=9, noise_rad=5e-5),
    "fault": Plan(gain_mw_per_mhz=12, noise_rad=5e-5, faults=("stream-stop",)),
}
FIGURES = {
    "comparison": "comparison",
    "03-ringdown-1": "ringdown",
    "03-timeline": "timeline",
    "03-signals": "signals",
}
"""Those that are shown, and by what name."""


def main() -> None:
    """Write the pictures; where there is no Chromium, not the page's."""
    with TemporaryDirectory() as folder:
        out = Path(folder)
        with chdir(out):  # the page shows the names of files as they were given
            paths = []
            for name, plan in PLANS.items():
                Path(name).mkdir()
                paths.append(f"{name}/session.mcap")
                simulate(plan, paths[-1])
            write_analysis(paths, Path())
        for name, shown in FIGURES.items():
            _save(out / "figures" / f"{name}.png", f"analysis-{shown}.png")
        if (browser := shutil.which("chromium")) is not None:
            picture = out / "page.png"
            options = ["--headless", "--no-sandbox", "--hide-scrollbars", "--virtual-time-budget=20000"]
            options += [f"--screenshot={picture}", "--window-size=1340,1500", f"--user-data-dir={out / 'profile'}"]
            subprocess.run([browser, *options, (out / "report.html").as_uri()], check=True, capture_output=True)
            _save(picture, "analysis-page.png")


def _save(picture: Path, name: str) -> None:
    Image.open(picture).convert("RGB").quantize(64).save(IMAGES / name, optimize=True)


if __name__ == "__main__":
    main()
