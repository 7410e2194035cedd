"""Boxes, bots and rivals: their places, crashes into them, and what policies and reward functions learn of them."""
