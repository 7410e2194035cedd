"""Policies raced under a protocol, and the fastest lap that a car could drive.

`plan.plan_evaluation` and `run_evaluation.evaluate_run` are the command; `evaluator.Evaluator` races a policy and gives
`results.Evaluation`. `film` records laps, `zigzag` measures them, `fastest.fastest_lap` searches for the fastest.
"""
