"""A session's log through the engine once more, and where it comes out otherwise."""
