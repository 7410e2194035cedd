"""The commands of `deepracer-exp`: each makes a plan, imports what is heavy, and executes it.

`validation` says what a reward function rewards, `export` writes policies for the service, the car and ONNX.
"""
