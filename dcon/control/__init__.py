"""The controller in real time: PMU streams in over sockets, the 60 Hz loop, the command out, the session log."""
