"""The front: receives, stamps and parses PMU streams, and hands on what is of a configured source and IDCODE."""
