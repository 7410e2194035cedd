"""How much of its budget a run has used."""

from deepracer_exp.config.running import BudgetConfig


class Budget:
    """The limits of a run; the first one reached ends it."""

    def __init__(self, config: BudgetConfig):
        self._limits = (
            ("env_steps", config.env_steps),
            ("iterations", config.iterations),
            ("wall_clock_s", config.wall_clock_s),
        )

    def used(self, env_steps: int, iterations: int, wall_clock_s: float) -> tuple[str, float]:
        """Return the limit that is nearest and the share of it that is used, 1 or more once it is reached."""
        spent = {"env_steps": env_steps, "iterations": iterations, "wall_clock_s": wall_clock_s}
        shares = [(name, spent[name] / limit) for name, limit in self._limits if limit is not None]
        return max(shares, key=lambda share: share[1])

    def __str__(self) -> str:
        """Return the limits in words, e.g. ``3,000,000 steps``."""
        units = {"env_steps": "steps", "iterations": "iterations", "wall_clock_s": "s"}
        words = [f"{limit:,.0f} {units[name]}" for name, limit in self._limits if limit is not None]
        return " or ".join(words)
