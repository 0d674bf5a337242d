"""Modes from measurements: frequency and damping of a ringdown."""
