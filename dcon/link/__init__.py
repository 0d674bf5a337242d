"""What the processes of the platform say to each other: pure codecs, and the thin ends of sockets."""
