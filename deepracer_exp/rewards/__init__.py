"""Reward functions: found and checked (`source.load_reward_source`), and called (`reward.RewardFunction`)."""
