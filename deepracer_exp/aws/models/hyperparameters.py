"""hyperparameters.json: the hyperparameters of a DeepRacer training."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from deepracer_exp.errors import BadInput

from .json_object import JsonObject

LOSS_TYPES = ("huber", "mean squared error")
EXPLORATION_TYPES = ("categorical", "e-greedy", "additive_noise")

# What the service's trainer accepts; the console accepts less.
_WHOLE = {
    "batch_size": (1, 10**6),
    "num_epochs": (1, 1000),
    "num_episodes_between_training": (1, 10**5),
    "epsilon_steps": (1, 10**12),
    "stack_size": (1, 1000),
    "term_cond_max_episodes": (1, 10**12),
}
_NUMBERS = {
    "lr": (1e-10, 1.0),
    "beta_entropy": (0.0, 1.0),
    "discount_factor": (0.0, 1.0),
    "e_greedy_value": (0.0, 1.0),
    "term_cond_avg_score": (-1e12, 1e12),
    "sac_alpha": (0.0, 1.0),
}
_WORDS = {"loss_type": LOSS_TYPES, "exploration_type": EXPLORATION_TYPES}
KEYS = (*_WHOLE, *_NUMBERS, *_WORDS)
CONSOLE_RANGES = {
    "batch_size": (32, 512),
    "num_epochs": (3, 10),
    "lr": (1e-8, 1e-3),
    "num_episodes_between_training": (1, 100),
}
"""Lowest and highest value that the console accepts, where its range is narrower than the trainer's.

The console also requires `batch_size` to be a power of two.
"""


@dataclass(frozen=True, kw_only=True)
class Hyperparameters:
    """One hyperparameters.json with every default of the service filled in."""

    batch_size: int = 64
    num_epochs: int = 10
    lr: float = 3e-4
    beta_entropy: float = 0.01
    discount_factor: float = 0.999
    loss_type: Literal["huber", "mean squared error"] = "mean squared error"
    num_episodes_between_training: int = 20
    exploration_type: Literal["categorical", "e-greedy", "additive_noise"] = "categorical"
    """Files of SAC have `additive_noise`."""
    e_greedy_value: float = 0.05
    epsilon_steps: int = 10_000
    stack_size: int = 1
    term_cond_max_episodes: int = 100_000
    """Training iterations, in spite of its name."""
    term_cond_avg_score: float = 100_000.0
    sac_alpha: float = 0.2
    set_keys: tuple[str, ...] = ()
    """Keys of the file, in its order; the service ignores those not in KEYS."""

    def beyond_console(self) -> tuple[str, ...]:
        """Return the keys whose values the trainer accepts but the console does not."""
        outside = [
            key for key, (low, high) in CONSOLE_RANGES.items() if not low <= getattr(self, key) <= high
        ]
        if self.batch_size.bit_count() != 1 and "batch_size" not in outside:
            outside.append("batch_size")
        return tuple(outside)


def read_hyperparameters(
    path: str | Path, raw: bytes | None = None, refused: list[str] | None = None
) -> Hyperparameters:
    """Read a hyperparameters.json.

    `raw` is the file's content if known. `refused` collects errors of single keys, which then get the service's
    defaults; with None they are raised.

    Missing keys get the service's defaults, numbers may be written as strings, unknown keys are ignored.

    Raises:
        BadInput: the file cannot be read or has values the service's trainer does not accept; one line with file, key,
            value and accepted values.

    Source of the rules: deepracer-simapp, markov/sagemaker_graph_manager.py.
    """
    file = JsonObject(path, "a hyperparameters.json", "a JSON object with batch_size, lr, ...", raw)
    values: dict[str, int | float | str] = {}
    set_keys = []
    for key, value in file.data.items():
        try:
            if key in _WHOLE:
                values[key] = file.whole(key, value, *_WHOLE[key])
            elif key in _NUMBERS:
                values[key] = file.number(key, value, *_NUMBERS[key])
            elif key in _WORDS:
                values[key] = file.choice(key, value, _WORDS[key])
        except BadInput as error:
            if refused is None:
                raise
            refused.append(error.without(path))
        else:
            set_keys.append(key)
    return Hyperparameters(**values, set_keys=tuple(set_keys))  # type: ignore[arg-type]


def hyperparameters_text(values: Hyperparameters) -> str:
    """Return the text of a hyperparameters.json with all keys, which `read_hyperparameters` reads back unchanged."""
    return json.dumps({key: getattr(values, key) for key in sorted(KEYS)}, indent=2) + "\n"
