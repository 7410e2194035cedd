"""What is said of a reward function's text."""

from dataclasses import dataclass


@dataclass(frozen=True, order=True)
class Finding:
    """One place the AWS console would not take."""

    line: int
    """Counted from 1; 0: the file as a whole."""
    text: str

    def __str__(self) -> str:
        """Return the finding as one line."""
        return f"line {self.line}: {self.text}" if self.line else self.text
