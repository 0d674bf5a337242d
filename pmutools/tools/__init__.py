"""What the commands do: short compositions of a source, the work, and a sink. No printing, no exit codes."""
