"""The output process: the newest command that the watchdog lets through, to a device that is read back."""
