"""The race: cars on their tracks under the service's rules.

`setup.build_setup` makes a `RaceSetup` of an experiment and `race.Race` drives it; `race_env.RaceEnv` is it for
TorchRL, `gym_env` for Gymnasium, `sb3` for Stable-Baselines3. `others` are boxes, bots and rivals; `randomization` is
what differs from car to car.
"""
