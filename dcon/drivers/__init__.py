"""Where the command goes: one small module a kind of output."""
