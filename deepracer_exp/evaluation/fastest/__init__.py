"""The fastest lap of a car on a track: searched, driven by the simulated car, and kept for the next command."""
