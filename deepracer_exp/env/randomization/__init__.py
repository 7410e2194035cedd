"""Randomization of cars, of their pictures, and of the physical car's ways."""
