"""A scapy layer for C37.118 frames: dissect, show, build and fuzz them in packets on ports 4712 and 4713.

::

    from pmutools.c37118_scapy import C37118, learn
    IP(dst=host) / UDP() / C37118(type="command", idcode=7734, cmd="start_data")

FRAMESIZE, CHK, the version nibble and all counts are computed on build where they are None. Several frames in one
segment or datagram are successive layers; :meth:`C37118.tcp_reassemble` serves ``TCPSession`` and ``StreamSocket``.

What a data frame holds is in its configuration alone. A CFG-2 or CFG-3 dissected earlier, or one given to
:func:`learn`, makes the fields of ``blocks``, from the same layout as every other decoder; without one the body stays
in ``undecoded``. So does the body of a configuration whose counts lie, and any body of an unknown type.
"""

from pmutools.c37118_scapy.blocks import AnalogScaling, Cfg3Station, CfgStation, DataBlock, PhasorScaling, data_blocks
from pmutools.c37118_scapy.layer import C37118
from pmutools.c37118_scapy.registry import MAX_CONFIGS, config_of, forget, learn

__all__ = [
    "C37118",
    "MAX_CONFIGS",
    "AnalogScaling",
    "Cfg3Station",
    "CfgStation",
    "DataBlock",
    "PhasorScaling",
    "config_of",
    "data_blocks",
    "forget",
    "learn",
]
