import pytest
import torch
from tensordict import TensorDict

from deepracer_exp.agents.replay import Replay

CARS = 3
KEYS = ["observation", "pixels"]


def batch(first: int, length: int) -> TensorDict:
    """Cars that see their number and the step: a transition is known by what is seen."""
    step = torch.arange(first, first + length, dtype=torch.float32).expand(CARS, length)
    car = torch.arange(CARS, dtype=torch.float32)[:, None].expand(CARS, length)
    done = torch.zeros(CARS, length, 1, dtype=torch.bool)

    def seen(step: torch.Tensor) -> dict[str, torch.Tensor]:
        pixels = step.to(torch.uint8)[..., None, None, None].expand(CARS, length, 1, 2, 2)
        return {"observation": torch.stack([car, step], dim=-1), "pixels": pixels, "trace": step}

    following = {"reward": (10 * car + step)[..., None], "done": done, "terminated": done}
    before = seen(step)
    parts = before | {"action": -before["observation"], "next": seen(step + 1) | following}
    return TensorDict(parts, [CARS, length])


def filled(lengths: list[int], most_steps: int = 10**6, most_bytes: int = 10**9) -> Replay:
    replay = Replay(KEYS, most_steps, most_bytes, torch.Generator().manual_seed(3))
    first = 0
    for length in lengths:
        replay.extend(batch(first, length))
        first += length
    return replay


@pytest.mark.parametrize("rows", [17, 8, 3], ids=["grows", "is full", "is shorter than a batch"])
def test_the_newest_steps_of_all_cars_are_drawn_with_what_was_seen_then(rows):
    replay = filled([5, 1, 7, 4], rows * CARS)
    steps = replay.sample(500)
    car, step = steps["observation"].unbind(-1)
    assert set(zip(car.tolist(), step.tolist(), strict=True)) == {
        (float(car), float(step)) for car in range(CARS) for step in range(17 - rows, 17)
    }
    assert len(replay) == rows * CARS
    assert torch.equal(steps["next", "observation"], steps["observation"] + torch.tensor([0.0, 1.0]))
    assert torch.equal(steps["next", "pixels"], steps["pixels"] + 1)
    assert torch.equal(steps["action"], -steps["observation"])
    assert torch.equal(steps["next", "reward"].squeeze(-1), 10 * car + step)
    assert "trace" not in steps.keys() | steps["next"].keys()


def test_it_holds_no_more_bytes_than_it_may():
    step_bytes = 2 * (2 * 4 + 4) + 2 * 4 + 4 + 2  # observations and pictures, action, reward and two flags
    replay = filled([10] * 20, most_bytes=50 * step_bytes + 1)
    assert len(replay) == 50
    assert sum(value.nbytes for value in replay.sample(50).values(True, True)) == 50 * step_bytes


@pytest.mark.parametrize("lengths", [[], [5, 3], [5, 9, 6]], ids=["is empty", "grows", "is full"])
def test_a_restored_one_draws_the_same_steps_as_the_original(lengths):
    original = filled(lengths, 16 * CARS)
    restored = filled([], 16 * CARS)
    restored.load_state_dict(original.state_dict())
    for first in (20, 26, 32):
        for replay in (original, restored):
            replay.extend(batch(first, 6))
        assert (original.sample(500) == restored.sample(500)).all()
