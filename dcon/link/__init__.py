"""What the processes of the real-time platform say to each other: pure codecs, and small helpers for their sockets."""
