"""Charts as plain data: a function a figure, from a view of a log to a `figure.Chart`."""
