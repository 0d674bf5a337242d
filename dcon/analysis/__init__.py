"""What a recorded session tells afterwards: ``dcon analyze``."""
