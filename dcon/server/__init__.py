"""The server: writes the session log, speaks with operators, and looks after what needs no 60 Hz."""
