"""The race: cars on their tracks under the service's rules.

`setup.build_setup` makes a `RaceSetup` of an experiment and `race.Race` drives it, wrapped by `race_env.RaceEnv` for
TorchRL, `gym_env` for Gymnasium and `sb3` for Stable-Baselines3. `others` holds boxes, bots and rivals, `randomization`
the differences between cars.
"""
