"""The commands of `deepracer-exp`: each makes a plan, imports what is heavy, and executes it."""
