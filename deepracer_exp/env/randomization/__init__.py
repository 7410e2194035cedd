"""Domain randomization of cars and their pictures, and towards the physical car."""
