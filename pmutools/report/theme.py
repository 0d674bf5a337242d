"""What reports look like: colours that colour-blind readers and grey printers can tell apart, and sizes.

The colours are those of Okabe and Ito; they never carry a meaning alone, words and shapes do too.
"""

from __future__ import annotations

INK, MUTED, GRID, PAPER = "#1b1f24", "#57606a", "#dfe3e8", "#ffffff"
BLUE, SKY, GREEN, ORANGE, VERMILION, PURPLE = "#0072b2", "#56b4e9", "#009e73", "#e69f00", "#d55e00", "#cc79a7"
SILENT, DOUBTFUL = "#c9ced6", "#f7e7b0"
"""Stretches of time: nothing came; frames that say they are not synchronised."""
CYCLE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, INK)
"""Of lines that stand beside each other; the next round is dashed."""
STEPS = ("#eef2f0", "#fee391", "#fec44f", "#fe9929", "#d95f0e", "#993404", "#3b1502")
"""Of a scale from good to bad: ever darker."""
SANS = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"
WIDE_PX, HALF_PX = 1100, 540
"""Width of a figure that fills the page, and of one of two side by side."""


def tint(color: str, share: float) -> str:
    """``color`` (#rrggbb) mixed with the paper: 0 is paper, 1 the colour."""
    mixed = (round(255 + share * (int(color[at : at + 2], 16) - 255)) for at in (1, 3, 5))
    return "#" + "".join(f"{part:02x}" for part in mixed)
