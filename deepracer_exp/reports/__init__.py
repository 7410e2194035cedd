"""Tables of logs and runs, findings in them, charts, and the pages that show them."""
