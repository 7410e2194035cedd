"""Stopping rules: they end a run whose training has nothing more to gain, and a report judges it by them."""
