"""pmutools: play, read, convert and characterize IEEE C37.118 PMU streams.

The package is layered; an import goes to a lower layer only (``tests/test_layers.py`` holds it):
ground floor -> ``c37118`` -> ``formats``, ``impair``, ``net``, ``grid``, ``modal`` -> ``tools`` -> ``cli``.
"""

__version__ = "0.1.0"
