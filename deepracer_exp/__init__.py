"""Hundreds of AWS-DeepRacer-style racing experiments a day."""

__version__ = "0.1.0"
