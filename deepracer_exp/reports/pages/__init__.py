"""HTML pages: reports of logs and runs, comparisons, replays, live views."""
