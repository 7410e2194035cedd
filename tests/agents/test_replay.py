import pytest
import torch
from tensordict import TensorDict

from deepracer_exp.agents.replay import Replay

CARS = 3


def batch(first: int, length: int, cut_off: tuple[tuple[int, int], ...] = ()) -> TensorDict:
    """Cars that see their number and the step: a transition is known by what is seen."""
    step = torch.arange(first, first + length, dtype=torch.float32).expand(CARS, length)
    car = torch.arange(CARS, dtype=torch.float32)[:, None].expand(CARS, length)
    done = torch.zeros(CARS, length, 1, dtype=torch.bool)
    for at_car, at_step in cut_off:
        done[at_car, at_step - first] = True
    following = {"reward": (10 * car + step)[..., None], "done": done, "terminated": torch.zeros_like(done)}
    seen = torch.stack([car, step], dim=-1)
    pixels = step.to(torch.uint8)[..., None, None, None].expand(CARS, length, 1, 2, 2)
    return TensorDict(
        {"observation": seen, "pixels": pixels, "action": -seen, "next": following}, [CARS, length]
    )


def filled(lengths: list[int], most_steps: int = 10**6, **options) -> Replay:
    replay = Replay(["observation", "pixels"], most_steps, 10**9, torch.Generator().manual_seed(3))
    first = 0
    for length in lengths:
        replay.extend(batch(first, length, **options))
        first += length
    return replay


def drawn(replay: Replay, size: int = 500) -> TensorDict:
    return replay.sample(size)


@pytest.mark.parametrize("most_steps", [10**6, 8 * CARS], ids=["grows", "is full"])
def test_what_is_seen_next_is_what_the_same_car_saw_a_step_later(most_steps):
    replay = filled([5, 1, 7, 4], most_steps)
    steps = drawn(replay)
    assert torch.equal(steps["next", "observation"], steps["observation"] + torch.tensor([0.0, 1.0]))
    assert torch.equal(steps["next", "pixels"], steps["pixels"] + 1)
    assert torch.equal(steps["action"], -steps["observation"])
    car, step = steps["observation"].unbind(-1)
    assert torch.equal(steps["next", "reward"].squeeze(-1), 10 * car + step)
    # The newest row waits for its successor; every other one that is kept can be drawn.
    kept = range(17 - (8 if most_steps == 8 * CARS else 17), 16)
    assert set(step.tolist()) == set(map(float, kept))
    assert len(replay) == len(kept) * CARS


def test_a_step_that_was_cut_off_is_never_drawn():
    replay = Replay(["observation"], 10**6, 10**9, torch.Generator().manual_seed(3))
    replay.extend(batch(0, 6, cut_off=((1, 2), (0, 5))))
    replay.extend(batch(6, 2))
    pairs = {tuple(pair) for pair in drawn(replay)["observation"].tolist()}
    assert len(pairs) == 7 * CARS - 2
    assert not pairs & {(1.0, 2.0), (0.0, 5.0)}


def test_it_holds_no_more_bytes_than_it_may():
    step_bytes = 2 * 4 + 4 + 2 * 4 + 4 + 2  # observation, picture, action, reward and two flags
    replay = Replay(["observation", "pixels"], 10**6, 50 * step_bytes, torch.Generator())
    for first in range(0, 200, 10):
        replay.extend(batch(first, 10))
    rows = 50 // CARS
    assert (replay.written_rows, replay.first_row) == (200, 200 - rows)
    assert sum(part.numel() * step_bytes for _, part in replay.parts(0)) <= 50 * step_bytes


@pytest.mark.parametrize("most_steps", [10**6, 8 * CARS], ids=["grows", "is full"])
def test_a_restored_one_draws_the_same_steps_as_the_original(most_steps):
    original = filled([5, 3], most_steps)
    parts = original.parts(0)
    original.extend(batch(8, 6))
    parts += original.parts(parts[-1][0] + len(parts[-1][1]))
    restored = Replay(["observation", "pixels"], most_steps, 10**9, torch.Generator().manual_seed(3))
    restored.load_state_dict(original.state_dict())
    restored.restore(parts)
    for first in (14, 20):
        assert (drawn(original) == drawn(restored)).all()
        for replay in (original, restored):
            replay.extend(batch(first, 6))
