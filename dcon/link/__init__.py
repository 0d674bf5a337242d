"""What the processes of the platform say to each other: codecs, and sockets that never wait."""
