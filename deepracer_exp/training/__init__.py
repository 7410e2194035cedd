"""Trainings: `plan.plan_training` and `run.run_training`; `trainer.Trainer` repeats its five phases.

`trainer.Callback` is the hook for everything else.
"""
