"""`deepracer-exp validate`: a reward function called in many situations, on flawed laps, and in a short training."""
