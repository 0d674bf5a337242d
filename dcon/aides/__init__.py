"""The aides of the control process: three loops beside it that may wait, so that it need not.

- ``gps`` asks whoever disciplines this machine's clock (``[platform] time_source``) whether it has its lock;
- ``pdci`` takes the status of the DC line (``[pdci] url``);
- ``gui`` lets signed orders of operators pass.

Each tells the control process and beats to the watchdog every 100 ms. A loop itself never waits for longer: what may
take its time to answer (gpsd, chrony, Modbus) is asked in threads beside it. So a gpsd that hangs shows as a lock that
grows old, a line's device that hangs as a status that does, and a loop that hangs as a beat that is missing.

``python -m dcon.aides --ini FILE --run-dir DIR`` ends with its parent.
"""
