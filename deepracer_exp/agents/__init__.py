"""Networks and algorithms; they know nothing of cars.

`build.build_agent` gives an algorithm with its networks (`algorithm.Algorithm`: `ppo.PPO`, `sac.SAC`),
`build.build_networks` the networks alone. `service_weights` takes the service's weights over, and gives ours back.
"""
