"""The closed loop in virtual time: a simulated grid, its PMUs' frames as bytes, faults, and the controller."""
