"""When a training has nothing more to gain: the rules that end a run, and by which a report judges it."""
